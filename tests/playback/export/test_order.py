"""An order of the Gaussians by place that stays the same."""

import numpy as np

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.playback.export.clips import by_place
from tests.scenes.changing_splats import rig, splats, write_stream


def rows(gaussians):
    """Return the place of each Gaussian in the order, by its base colour, which does not change."""
    return {color.tobytes(): k for k, color in enumerate(gaussians.numpy()["sh_coeffs"][:, 0])}


def test_by_place__yields_the_gaussians_of_every_frame_in_one_order(tmp_path):
    write_stream(tmp_path / "s.morgs", keyframe_interval=2)
    stream = StreamReader(tmp_path / "s.morgs")
    previous_rows = None
    for (frame, ordered), (expected, gaussians) in zip(by_place(stream), play(stream), strict=True):
        assert frame == expected
        assert rows(ordered).keys() == rows(gaussians).keys()
        if previous_rows is not None:
            shared = [color for color in previous_rows if color in rows(ordered)]
            assert len(shared) >= 39
            assert np.all(np.diff([rows(ordered)[color] for color in shared]) > 0)
        previous_rows = rows(ordered)


def test_by_place__puts_neighbours_side_by_side(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", rig(), 10) as writer:
        for t in range(2):
            writer.write(keyframe_packet(splats(2000, 0, seed=t), t, rig()))
    for _, gaussians in by_place(StreamReader(tmp_path / "s.morgs")):
        steps = np.linalg.norm(np.diff(gaussians.numpy()["means"], axis=0), axis=1)
        # Random pairs in this box are 1.06 apart.
        assert np.median(steps) < 0.25


def test_by_place__yields_frames_without_gaussians(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", rig(), 10) as writer:
        for t, count in enumerate((0, 5, 0)):
            writer.write(keyframe_packet(splats(count), t, rig()))
    assert [len(gaussians) for _, gaussians in by_place(StreamReader(tmp_path / "s.morgs"))] == [
        0,
        5,
        0,
    ]
