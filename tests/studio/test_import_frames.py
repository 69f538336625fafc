"""Import: Gaussians with and without identities, the default camera, and messages for frames that
do not fit.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.ply import write_ply
from morgs_mi.studio.import_frames import find_frames, import_frames, matched_rows, same_gaussians
from tests.assertions import assert_close
from tests.cli.conftest import run
from tests.scenes.changing_splats import splats

__all__ = ["run"]

T = 5
N = 300


def moving(frame: int, seed: int = 0) -> Gaussians:
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


def shuffled(gaussians: Gaussians, seed: int = 1) -> Gaussians:
    return gaussians.select(np.random.default_rng(seed).permutation(len(gaussians)))


def write_frames(folder: Path, frames: list[Gaussians]) -> Path:
    folder.mkdir()
    for t, gaussians in enumerate(frames):
        write_ply(folder / f"frame{t}.ply", gaussians)
    return folder


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return write_frames(tmp_path / "clip", [moving(t) for t in range(T)])


def test_import_frames__keeps_the_ids_of_the_same_gaussians(clip, tmp_path):
    result = import_frames([clip], tmp_path / "out", 25, CodecConfig(keyframe_interval=2))
    assert (result.path, result.num_frames, result.num_keyframes) == (
        tmp_path / "out" / "stream.morgs",
        T,
        1,
    )
    stream = StreamReader(result.path)
    assert (stream.fps, stream.metadata["num_frames"]) == (25, T)
    kinds = [(kind, frame) for kind, frame, _ in stream.index()]
    key = PacketKind.KEYFRAME
    change = PacketKind.RESIDUAL
    assert kinds == [
        (key, 0),
        (change, 1),
        (change, 2),
        (key, 2),
        (change, 3),
        (change, 4),
        (key, 4),
    ]
    pixel = 5 / stream.cameras[0].K[0, 0]  # at the distance of the camera
    for coded in coded_frames(stream):
        np.testing.assert_array_equal(coded.ids, np.arange(N))
        raw = coded.gaussians.numpy()
        expected = moving(coded.frame).numpy()
        assert_close(raw["means"], expected["means"], atol=0.2 * pixel)
        errors = np.abs(
            raw["motion"] - 0.1 * (coded.frame > 0) * (np.arange(N) < N // 2)[:, None] * [1, 0, 0]
        )
        assert errors.max() < 0.4 * pixel
    _, gaussians = list(play(stream))[3]
    np.testing.assert_array_equal(stream.seek(3).gaussians.means, gaussians.means)


@pytest.mark.parametrize("later", [shuffled(moving(1)), splats(N, 0), splats(0)])
def test_import_frames__begins_a_new_set_of_other_gaussians(tmp_path, later):
    clip = write_frames(tmp_path / "clip", [moving(0), later, moving(2)])
    result = import_frames([clip], tmp_path / "s.morgs")
    assert result.num_keyframes == 3
    frames = [gaussians for _, gaussians in play(StreamReader(tmp_path / "s.morgs"))]
    assert [len(gaussians) for gaussians in frames] == [N, len(later), N]
    assert_close(frames[1].numpy()["means"], later.numpy()["means"], atol=2e-3)


def test_import_frames__keeps_ids_where_gaussians_are_added_and_removed(tmp_path):
    def part(frame: int, rows: np.ndarray) -> Gaussians:
        return moving(frame).select(rows)

    everything = np.arange(N)
    even = np.arange(0, N, 2)
    # The rows of each frame: it grows at the end, loses rows, and gets some back in the middle.
    shown = [everything[:200], everything[:260], everything, np.setdiff1d(everything, even[5:25])]
    shown.append(np.union1d(shown[3], even[10:20]))
    clip = write_frames(tmp_path / "clip", [part(t, rows) for t, rows in enumerate(shown)])
    assert import_frames([clip], tmp_path / "s.morgs").num_keyframes == 1
    number: dict[int, int] = {}  # id by row of `moving`
    for coded, rows in zip(coded_frames(StreamReader(tmp_path / "s.morgs")), shown, strict=True):
        assert len(coded) == len(rows)
        raw = coded.gaussians.numpy()
        expected = moving(coded.frame).numpy()
        distances = np.linalg.norm(raw["means"][:, None] - expected["means"][rows], axis=2)
        assert distances.min(axis=1).max() < 2e-3
        nearest = rows[distances.argmin(axis=1)]
        id_of_row = {int(row): int(number) for row, number in zip(nearest, coded.ids, strict=True)}
        lasting = id_of_row.keys() & number.keys()
        assert {row: id_of_row[row] for row in lasting} == {row: number[row] for row in lasting}
        assert len(lasting) == min(len(number), len(rows) - (10 if coded.frame == 4 else 0))
        number = id_of_row


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (np.r_[0:40, 45:100, 100:110], np.r_[0:40, 45:100, [-1] * 10]),
        (np.r_[0:30, 105:110, 30:100], np.r_[0:30, [-1] * 5, 30:100]),
    ],
    ids=["loses and grows", "grows inside"],
)
def test_matched_rows__follow_the_order_of_both_frames(rows, expected):
    matches = matched_rows(moving(0).select(np.arange(100)), moving(1).select(rows))
    np.testing.assert_array_equal(matches, expected)


def test_matched_rows__finds_none_among_equal_gaussians():
    copies = splats(1).select(np.zeros(50, int))
    assert matched_rows(copies, copies.select(np.arange(49))) is None


@pytest.mark.parametrize(
    ("current", "same"),
    [
        (moving(3), True),
        (moving(0).select(np.roll(np.arange(N), 1)), False),
        (moving(0).select(np.roll(np.arange(N), -1)), False),
        (moving(0).select(np.r_[0:200, 250:300, 200:250]), False),
    ],
    ids=["moved", "shifted back", "shifted on", "partly shifted"],
)
def test_same_gaussians__compares_rows(current, same):
    assert same_gaussians(moving(0), current) is same


def test_same_gaussians__accepts_equal_rows():
    one = splats(1)
    assert same_gaussians(one, replace(one, means=one.numpy()["means"] + 5))
    copies = splats(1).select(np.zeros(50, int))
    assert same_gaussians(copies, copies)


def test_find_frames__orders_by_number(tmp_path):
    names = ["f9.ply", "f10.ply", "f100.ply", "f1.ply"]
    for name in [*names, "notes.txt", "cameras.json", "._f1.ply", ".DS_Store", "Thumbs.db"]:
        (tmp_path / name).touch()
    assert [path.name for path in find_frames([tmp_path])] == [
        "f1.ply",
        "f9.ply",
        "f10.ply",
        "f100.ply",
    ]
    paths = [tmp_path / name for name in names]
    assert find_frames(paths) == paths


@pytest.mark.parametrize(
    ("create", "named", "message"),
    [
        ([], ["missing"], "missing: expected frames .* found none; check the path"),
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
        (
            ["a.ply", "b.obj"],
            ["a.ply", "b.obj"],
            "b.obj: expected one folder, or files whose names end in",
        ),
        (["a.ply"], ["a.ply", "."], "expected one folder, or files whose names end in"),
        (
            [],
            [],
            r"import_frames\(\): expected a folder with files whose names end in .*, got none",
        ),
    ],
)
def test_find_frames__names_what_does_not_fit(tmp_path, create, named, message):
    for name in create:
        (tmp_path / name).touch()
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        find_frames([tmp_path / name for name in named])


def test_import_frames__leaves_nothing_where_a_frame_is_broken(clip, tmp_path):
    broken = clip / "frame3.ply"
    broken.write_bytes(broken.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"frame3\.ply: expected a complete PLY file"):
        import_frames([clip], tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_import_frames__refuses_to_replace_a_stream(clip, tmp_path):
    import_frames([clip], tmp_path / "s.morgs")
    old_bytes = (tmp_path / "s.morgs").read_bytes()
    with pytest.raises(FileExistsError, match="expected a new stream, got a file that exists"):
        import_frames([clip], tmp_path / "s.morgs")
    assert (tmp_path / "s.morgs").read_bytes() == old_bytes


def test_import_frames__reads_gaussians_without_extent(tmp_path):
    (tmp_path / "0.splat").write_bytes(2 * (bytes(24) + bytes([9, 9, 9, 9, 255, 128, 128, 128])))
    assert import_frames([tmp_path], tmp_path / "out").num_frames == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": np.full((2, 3), 1e30)}, r"0\.ply: .* in 2 of 2 Gaussians \(centre of 0, 1\)"),
        (
            {"means": np.array([[-9e11] * 3, [9e11] * 3])},
            r"Camera\('front'\).*the pose must be finite, with numbers",
        ),
    ],
)
def test_import_frames__names_the_file_of_huge_numbers(tmp_path, change, message):
    write_ply(tmp_path / "0.ply", replace(splats(2, 0), **change))
    with pytest.raises(ValueError, match=f"^{tmp_path}.*{message}"):
        import_frames([tmp_path], tmp_path / "out")


@pytest.mark.parametrize("place", [0, 1, 2])
def test_import_frames__accepts_an_empty_frame(tmp_path, place):
    frames = [moving(t) for t in range(3)]
    frames[place] = splats(0)
    import_frames([write_frames(tmp_path / "clip", frames)], tmp_path / "s.morgs")
    counts = [len(gaussians) for _, gaussians in play(StreamReader(tmp_path / "s.morgs"))]
    assert counts == [0 if t == place else N for t in range(3)]


def test_import_frames__leaves_out_invalid_gaussians_if_asked_to(tmp_path, caplog):
    frames = [moving(t) for t in range(3)]
    means = frames[1].numpy()["means"]
    means[[4, 7], 1] = np.nan, np.inf
    clip = write_frames(tmp_path / "clip", [frames[0], replace(frames[1], means=means), frames[2]])
    with pytest.raises(ValueError, match=r"frame1\.ply: .* in 2 of 300 Gaussians .*--drop-invalid"):
        import_frames([clip], tmp_path / "s.morgs")
    assert cli.main(["import", str(clip), str(tmp_path / "s.morgs"), "--drop-invalid"]) == 0
    assert [len(gaussians) for _, gaussians in play(StreamReader(tmp_path / "s.morgs"))] == [
        N,
        N - 2,
        N,
    ]
    assert "frame1.ply: 2 of 300 Gaussians are left out" in caplog.text


def test_import_frames__refuses_frames_without_gaussians(tmp_path):
    clip = write_frames(tmp_path / "clip", [splats(0)])
    with pytest.raises(ValueError, match="expected at least one Gaussian, got none"):
        import_frames([clip], tmp_path / "s.morgs")


def test_import__reads_what_export_writes(clip, tmp_path, run):
    assert (
        run("import", *sorted(clip.iterdir()), tmp_path / "a", "--fps", 24, "--quality", 4)[0] == 0
    )
    assert run("export", "ply", tmp_path / "a", tmp_path / "compressed-ply")[0] == 0
    status, output, _ = run("import", tmp_path / "compressed-ply", tmp_path / "b", "--axes", "z-up")
    assert (
        status,
        output.startswith(f"{tmp_path}/b/stream.morgs: 5 frames, one set of Gaussians, "),
    ) == (0, True)
    assert run("export", "gltf", tmp_path / "b")[0] == 0
    assert run("render", tmp_path / "b", tmp_path / "png", "--camera", "front")[0] == 0
    for args, part in (
        ([clip], "expected FRAMES and OUT, got fewer"),
        ([clip, tmp_path / "c", "--fps", 0], "--fps must be a number in [1e-6, 1e6], got 0.0"),
        ([clip, tmp_path / "c", "--quality", -1], "--quality must be above 0, got -1"),
    ):
        status, _, error = run("import", *args)
        assert (status, part in error, "Traceback" in error) == (1, True, False)
    assert not (tmp_path / "c").exists()
