"""Import: Gaussians with and without identities, the default camera, and messages for frames that
do not fit.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from plyfile import PlyData
from scipy.spatial import KDTree

from morgs_mi.cli.main import main
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.extras.imports.import_frames import (
    find_frames,
    import_frames,
)
from morgs_mi.io.ply import write_ply
from morgs_mi.testing import assert_close
from tests.cli.commands import assert_refused
from tests.cli.conftest import run
from tests.scenes.changing_splats import splats

__all__ = ["run"]

T = 5
N = 300


def moving(frame, seed=0):
    """Return splats of which a half moves by 0.1 per frame and becomes larger."""
    start = splats(N, 1, seed)
    moves = (np.arange(N) < N // 2)[:, None]
    raw = start.numpy()
    means = raw["means"] + 0.1 * frame * moves * np.float32([1, 0, 0])
    return replace(
        start,
        means=means,
        log_scales=raw["log_scales"] + 0.02 * frame * moves,
        logit_confidence=None,
    )


def write_frames(folder, frames):
    folder.mkdir()
    for t, gaussians in enumerate(frames):
        write_ply(folder / f"frame{t}.ply", gaussians)
    return folder


@pytest.fixture
def clip(tmp_path):
    return write_frames(tmp_path / "clip", [moving(t) for t in range(T)])


def test_import_frames__keeps_the_ids_of_the_same_gaussians(clip, tmp_path):
    result = import_frames([clip], tmp_path / "out", 25, CodecConfig(keyframe_interval=2))
    path = tmp_path / "out" / "stream.morgs"
    assert (result.path, result.num_frames, result.num_keyframes) == (path, T, 1)
    stream = StreamReader(path)
    assert (stream.fps, stream.metadata["num_frames"]) == (25, T)
    key = PacketKind.KEYFRAME
    change = PacketKind.RESIDUAL
    kinds = [key, change, change, key, change, change, key]
    expected_index = [*zip(kinds, [0, 1, 2, 2, 3, 4, 4], strict=True)]
    assert [(kind, frame) for kind, frame, _ in stream.index()] == expected_index
    pixel = 5 / stream.cameras[0].K[0, 0]  # at the distance of the camera
    states = [*coded_frames(stream)]
    for coded in states:
        assert_array_equal(coded.ids, np.arange(N))
        raw = coded.gaussians.numpy()
        expected = moving(coded.frame).numpy()["means"]
        assert_close(raw["means"], expected, atol=0.2 * pixel)
        motion = expected - moving(max(coded.frame - 1, 0)).numpy()["means"]
        assert_close(raw["motion"], motion, atol=0.4 * pixel)
    assert_array_equal(stream.seek(3).gaussians.means, states[3].gaussians.means)


@pytest.mark.parametrize(
    "frames",
    [
        [moving(0), moving(1).select(np.random.default_rng(1).permutation(N)), moving(2)],
        [moving(0), splats(N, 0), moving(2)],
        [moving(0), splats(0), moving(2)],
        [splats(0), moving(1)],
    ],
    ids=["shuffled", "another degree", "empty", "empty first"],
)
def test_import_frames__begins_a_new_set_of_other_gaussians(tmp_path, frames):
    result = import_frames([write_frames(tmp_path / "clip", frames)], tmp_path / "s.morgs")
    assert result.num_keyframes == len(frames)
    played = [gaussians for _, gaussians in play(StreamReader(tmp_path / "s.morgs"))]
    for frame, expected in zip(played, frames, strict=True):
        assert_close(frame.numpy()["means"], expected.numpy()["means"], atol=2e-3)


def test_import_frames__keeps_ids_where_gaussians_are_added_and_removed(tmp_path):
    everything = np.arange(N)
    even = np.arange(0, N, 2)
    # The rows of each frame: it grows at the end, loses rows, and gets some back in the middle.
    shown = [everything[:200], everything[:260], everything, np.setdiff1d(everything, even[5:25])]
    shown.append(np.union1d(shown[3], even[10:20]))
    frames = [moving(t).select(rows) for t, rows in enumerate(shown)]
    clip = write_frames(tmp_path / "clip", frames)
    assert import_frames([clip], tmp_path / "s.morgs").num_keyframes == 1
    old_ids = np.full(N, -1)  # by row of `moving`, -1 where it is not shown
    for coded, rows in zip(coded_frames(StreamReader(tmp_path / "s.morgs")), shown, strict=True):
        assert len(coded) == len(rows)
        tree = KDTree(moving(coded.frame).numpy()["means"][rows])
        distances, nearest = tree.query(coded.gaussians.numpy()["means"])
        assert distances.max() < 2e-3
        ids = np.full(N, -1)
        ids[rows[nearest]] = coded.ids
        lasting = (ids >= 0) & (old_ids >= 0)
        assert_array_equal(ids[lasting], old_ids[lasting])
        births = np.setdiff1d(coded.ids, old_ids)
        assert len(births) == len(rows) - lasting.sum()
        old_ids = ids


def test_find_frames__orders_by_number(tmp_path):
    names = ["f9.ply", "f10.ply", "f100.ply", "f1.ply"]
    for name in [*names, "notes.txt", "cameras.json", "._f1.ply", ".DS_Store", "Thumbs.db"]:
        (tmp_path / name).touch()
    paths = [tmp_path / name for name in names]
    assert find_frames([tmp_path]) == [paths[k] for k in (3, 0, 1, 2)]
    assert find_frames(paths) == paths


@pytest.mark.parametrize(
    ("create", "selected", "message"),
    [
        ([], ["missing"], "missing: expected one folder of frames, .* found none; check the path"),
        (
            ["a.txt"],
            ["."],
            "expected a folder with files whose names end in .compressed.ply, .ply, .*, got none",
        ),
        (
            ["a.ply", "a.splat"],
            ["."],
            "expected frames of one format, got a.splat and a.ply; name the files",
        ),
        (["a.ply"], ["a.ply", "."], "expected one folder of frames, or files .* found none"),
    ],
)
def test_find_frames__names_what_does_not_fit(tmp_path, create, selected, message):
    for name in create:
        (tmp_path / name).touch()
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        find_frames([tmp_path / name for name in selected])


def test_import_frames__leaves_nothing_where_a_frame_is_broken_and_replaces_no_stream(
    clip, tmp_path
):
    path = import_frames([clip], tmp_path / "s.morgs").path
    old_bytes = path.read_bytes()
    with pytest.raises(FileExistsError, match="expected a new stream, got a file that exists"):
        import_frames([clip], path)
    assert path.read_bytes() == old_bytes
    broken = clip / "frame3.ply"
    broken.write_bytes(broken.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"frame3\.ply: expected a complete PLY file"):
        import_frames([clip], tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_import_frames__reads_gaussians_without_extent(tmp_path):
    (tmp_path / "0.splat").write_bytes(2 * (bytes(24) + bytes([9, 9, 9, 9, 255, 128, 128, 128])))
    assert import_frames([tmp_path], tmp_path / "out").num_frames == 1


@pytest.mark.parametrize(
    ("gaussians", "message"),
    [
        (
            replace(splats(2, 0), means=np.full((2, 3), 1e30)),
            r"frame0\.ply: .* in 2 of 2 Gaussians \(centre of 0, 1\)",
        ),
        (
            replace(splats(2, 0), means=np.array([[-9e11] * 3, [9e11] * 3])),
            r"Camera\('front'\).*the pose must be finite, with numbers",
        ),
        (splats(0), "expected at least one Gaussian, got none"),
    ],
)
def test_import_frames__names_the_file_of_unsuitable_gaussians(tmp_path, gaussians, message):
    with pytest.raises(ValueError, match=f"^{tmp_path}.*{message}"):
        import_frames([write_frames(tmp_path / "clip", [gaussians])], tmp_path / "out")


def test_import_frames__leaves_out_invalid_gaussians_if_asked_to(tmp_path, caplog):
    clip = write_frames(tmp_path / "clip", [moving(t) for t in range(3)])
    file = PlyData.read(clip / "frame1.ply", mmap=False)
    file["vertex"]["y"][[4, 7]] = np.nan, np.inf
    file.write(clip / "frame1.ply")
    with pytest.raises(ValueError, match=r"frame1\.ply: .* in 2 of 300 Gaussians .*--drop-invalid"):
        import_frames([clip], tmp_path / "s.morgs")
    assert main(["import", str(clip), str(tmp_path / "s.morgs"), "--drop-invalid"]) == 0
    counts = [len(gaussians) for _, gaussians in play(StreamReader(tmp_path / "s.morgs"))]
    assert counts == [N, N - 2, N]
    assert "frame1.ply: 2 of 300 Gaussians are left out" in caplog.text


def test_import__reads_what_export_writes(clip, tmp_path, run):
    first = tmp_path / "a"
    again = tmp_path / "b"
    assert run("import", *sorted(clip.iterdir()), first, "--fps", 24, "--quality", 4)[0] == 0
    assert run("export", "ply", first, tmp_path / "compressed-ply")[0] == 0
    status, output, _ = run("import", tmp_path / "compressed-ply", again, "--axes", "z-up")
    assert status == 0
    assert output.startswith(f"{again}/stream.morgs: 5 frames, 1 set of Gaussians, ")
    assert run("export", "gltf", again)[0] == 0
    assert run("render", again, tmp_path / "png", "--camera", "front")[0] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "expected FRAMES and OUT, got fewer"),
        (("OUT", "--fps", 0), "`fps` must be a number in [1e-6, 1e6], got 0.0"),
        (("OUT", "--quality", -1), "`quality` must be above 0, got -1"),
    ],
)
def test_import__refuses(clip, tmp_path, run, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert_refused(run("import", clip, *options), message)
    assert not Path("OUT").exists()


def test_import_frames__names_the_remedy_of_a_format_that_is_not_read(tmp_path):
    (tmp_path / "a.spz").touch()
    with pytest.raises(
        ValueError, match=r"a\.spz: expected one folder, or files .*splat-transform"
    ):
        import_frames([tmp_path / "a.spz"], tmp_path / "out")
