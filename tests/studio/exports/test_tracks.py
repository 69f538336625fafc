"""Tracks of the stream's ids through births and deaths."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.studio.exports.tracks import extract_tracks, write_tracks
from tests.assertions import assert_close
from tests.scenes.changing_splats import rig, splats, write_stream


def test_extract_tracks__positions_are_those_of_the_gaussians(tmp_path):
    states = write_stream(tmp_path / "s.morgs")
    write_tracks(tmp_path / "tracks.npz", extract_tracks(StreamReader(tmp_path / "s.morgs")))
    tracks = np.load(tmp_path / "tracks.npz")
    assert tracks["ids"].tolist() == list(range(42))
    assert tracks["frames"].tolist() == [0, 1, 2, 3]
    for t, state in enumerate(states):
        alive = np.isin(tracks["ids"], state.ids)
        np.testing.assert_array_equal(
            tracks["positions"][t, alive], state.gaussians.numpy()["means"]
        )
        np.testing.assert_array_equal(
            tracks["confidence"][t, alive], np.asarray(state.gaussians.confidence)
        )
        assert np.isnan(tracks["positions"][t, ~alive]).all()
        assert np.isnan(tracks["confidence"][t, ~alive]).all()
    # The first died in frame 2, the last two were born there.
    assert np.isnan(tracks["positions"][:, 0, 0]).tolist() == [False, False, True, True]
    assert np.isnan(tracks["positions"][:, -1, 0]).tolist() == [True, True, False, False]
    # The second moved by 0.1 per frame, up to the codec's quantisation steps of a tenth of a pixel,
    # or 0.007.
    assert_close(np.diff(tracks["positions"][:, 1, 0]), 0.1, atol=0.007)


def test_extract_tracks__new_sets_of_gaussians_get_new_ids(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", rig(), 10) as writer:
        for t in range(2):
            writer.write(keyframe_packet(splats(3), t, rig()))
    tracks = extract_tracks(StreamReader(tmp_path / "s.morgs"))
    assert tracks.ids.tolist() == [0, 1, 2, 3, 4, 5]
    assert np.isnan(tracks.positions[:, :, 0]).tolist() == [
        [False] * 3 + [True] * 3,
        [True] * 3 + [False] * 3,
    ]


def test_extract_tracks__rejects_a_stream_without_frames(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", rig(), 10):
        pass
    with pytest.raises(ValueError, match="at least one frame was expected, got none"):
        extract_tracks(StreamReader(tmp_path / "s.morgs"))
