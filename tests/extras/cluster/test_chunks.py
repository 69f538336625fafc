"""Chunks: the joined stream is an ordinary one, and what dies or is interrupted meanwhile leaves
no trace.
"""

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.platform.bounded import read_json

pytest.importorskip("distributed", reason="comes with the extra `cluster`")


from morgs_mi.capture.capture import load_capture
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.extras.cluster.chunks import ChunkedRun
from morgs_mi.extras.cluster.tasks import ChunkConfig
from morgs_mi.extras.cluster.workers import open_client
from morgs_mi.fit.fit_config import ShortFitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.runs.fit_files import FILES
from tests.scenes.coded_clip import history
from tests.scenes.recording import CONFIG, write_recording

FRAMES = 10
STARTS = (0, 3, 7)
# A keyframe that is re-emitted within a chunk, and one that falls on a boundary.
SETTINGS = replace(CONFIG, codec=replace(CONFIG.codec, keyframe_interval=3))
CHUNKS = ChunkConfig(3, passes=2, epochs=1, overlap=2)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return load_capture(write_recording(tmp_path_factory.mktemp("capture"), FRAMES))


@pytest.fixture(scope="module")
def client():
    with open_client(count=2) as opened:
        yield opened


@pytest.fixture(autouse=True)
def short_tasks(monkeypatch):
    """Tasks that end within the chunks."""
    monkeypatch.setattr("morgs_mi.extras.cluster.chunks.TASK_FRAMES", 2)


def fit(capture, out, client, **options):
    metadata = {"config": SETTINGS, "chunks": CHUNKS} | options
    resume = metadata.pop("resume", False)
    return ChunkedRun(capture, out, client, **metadata).fit(resume)


@pytest.fixture(scope="module")
def whole(capture, client, tmp_path_factory):
    """A fit in three chunks, undisturbed, with tasks of another length than the tests'."""
    out = tmp_path_factory.mktemp("whole")
    fit(capture, out, client)
    return out


def stream_of(out):
    return (out / "stream.morgs").read_bytes()


def rows_of(out):
    rows = read_json(out / "report.json")["frames"]
    return [
        {name: value for name, value in row.items() if name not in ("seconds", "memory")}
        for row in rows
    ]


@pytest.mark.slow
def test_ChunkedRun__of_one_is_the_fit_in_one_process(capture, client, tmp_path):
    fit(capture, tmp_path / "one", client, chunks=ChunkConfig(1))
    stream_capture(capture, tmp_path / "plain", SETTINGS)
    assert stream_of(tmp_path / "one") == stream_of(tmp_path / "plain")
    assert rows_of(tmp_path / "one") == rows_of(tmp_path / "plain")
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == sorted(FILES)


@pytest.mark.slow
def test_ChunkedRun__joins_them_to_an_ordinary_stream(whole):
    reader = StreamReader(whole / "stream.morgs")
    assert reader.closed()
    assert sorted(path.name for path in whole.iterdir()) == sorted(FILES)
    first = {frame: kind for kind, frame, _ in reversed(reader.index())}
    assert [frame for frame, kind in sorted(first.items()) if kind == PacketKind.KEYFRAME] == list(
        STARTS
    )
    states = list(coded_frames(reader))
    assert [coded.frame for coded in states] == list(range(FRAMES))
    for state in states:
        assert history([reader.seek(state.frame)]) == history([state])
    report = read_json(whole / "report.json")
    assert [row["frame"] for row in report["frames"]] == list(range(FRAMES))
    assert 1 <= len(report["workers"]) <= 2
    sets = [set[int]() for _ in STARTS]
    for state in states:
        sets[np.searchsorted(STARTS, state.frame, "right") - 1] |= set(state.lasting_ids.tolist())
    assert len(set().union(*sets)) == sum(map(len, sets)), "no id is in two chunks"


def when_fitted(count, action):
    """Return a function that acts once, as soon as so many frames are fitted."""
    actions = [action]

    def on_stage(stage, done, total):
        if stage == "Fitting frames" and done >= count and actions:
            actions.pop()()

    return on_stage


def interrupt():
    raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 5])
def test_ChunkedRun__interrupted_and_resumed_is_the_same(capture, client, whole, tmp_path, count):
    with pytest.raises(KeyboardInterrupt):
        fit(capture, tmp_path, client, on_stage=when_fitted(count, interrupt))
    fit(capture, tmp_path, client, resume=True)
    assert stream_of(tmp_path) == stream_of(whole)
    assert rows_of(tmp_path) == rows_of(whole)
    again = fit(capture, tmp_path, client, resume=True, on_stage=when_fitted(0, interrupt))
    assert len(again) == FRAMES, "nothing is fitted twice"


@pytest.mark.slow
# After the first frame of a chunk alone, and within a packet.
@pytest.mark.parametrize(("frame", "more"), [(4, 0), (8, 40)])
def test_ChunkedRun__resumes_after_the_beginning_of_a_chunk(
    capture, client, whole, tmp_path, frame, more
):
    with pytest.raises(KeyboardInterrupt):
        fit(capture, tmp_path, client, on_stage=when_fitted(FRAMES, interrupt))
    for path in (tmp_path / "chunks").glob("*.morgs"):
        offset = next((at for _, number, at in StreamReader(path).index() if number >= frame), None)
        if offset is not None:
            os.truncate(path, offset + more)
    fit(capture, tmp_path, client, resume=True)
    assert stream_of(tmp_path) == stream_of(whole)
    assert rows_of(tmp_path) == rows_of(whole)


@pytest.mark.slow
def test_ChunkedRun__with_a_killed_process_is_the_same(capture, client, whole, tmp_path):
    def kill():
        """Kill a worker's process; its nanny starts a new one."""
        os.kill(list(client.run(os.getpid).values())[-1], signal.SIGKILL)

    fit(capture, tmp_path, client, on_stage=when_fitted(4, kill))
    assert stream_of(tmp_path) == stream_of(whole)


def test_ChunkedRun__refuses_too_many(capture, client, tmp_path):
    message = r"`chunks` must be 1 to 5 for 10 frames, 2 for each, got 6"
    with pytest.raises(ValueError, match=message):
        fit(capture, tmp_path / "out", client, chunks=ChunkConfig(6))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_ChunkedRun__does_not_resume_other_settings(capture, client, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        fit(capture, tmp_path, client, on_stage=when_fitted(2, interrupt))
    with pytest.raises(
        ValueError,
        match=r"0\.morgs: expected to resume a fit with metadata\.config\.seed = 0, got 1",
    ):
        fit(capture, tmp_path, client, config=replace(SETTINGS, seed=1), resume=True)
    with pytest.raises(
        ValueError, match=r"expected to resume a fit with metadata\.chunks\.starts = \[0, 3, 7\]"
    ):
        fit(capture, tmp_path, client, chunks=replace(CHUNKS, count=2), resume=True)


@pytest.mark.slow
def test_ChunkedRun__keeps_an_earlier_fit_until_the_chunks_are_joined(
    capture, client, whole, tmp_path, monkeypatch
):
    out = shutil.copytree(whole, tmp_path / "out")
    other = replace(SETTINGS, seed=1)
    with pytest.raises(KeyboardInterrupt):
        fit(capture, out, client, config=other, on_stage=when_fitted(FRAMES, interrupt))
    assert {name: (out / name).read_bytes() for name in FILES} == {
        name: (whole / name).read_bytes() for name in FILES
    }
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda path, **options: path.exists() and interrupt())
        with pytest.raises(KeyboardInterrupt):
            fit(capture, out, client, config=other, resume=True)
    fit(capture, out, client, config=other, resume=True)
    assert StreamReader(out / "stream.morgs").metadata["config"]["seed"] == 1
    assert len(rows_of(out)) == FRAMES


@pytest.mark.slow
def test_ChunkedRun__triangulates_points_where_there_are_few(
    capture, client, tmp_path, monkeypatch
):
    few = replace(capture, points=capture.points[:3], point_colors=capture.point_colors[:3])
    monkeypatch.setattr("morgs_mi.runs.fit_capture.with_points", lambda *_: capture)
    fit(
        few,
        tmp_path / "few",
        client,
        chunks=ChunkConfig(1),
        config=StreamConfig(SETTINGS.fit, SETTINGS.motion),
    )
    assert (
        len(next(coded_frames(StreamReader(tmp_path / "few" / "stream.morgs"))))
        == SETTINGS.fit.num_gaussians
    )


@pytest.mark.slow
def test_ChunkedRun__refines_cameras_once(capture, client, tmp_path, monkeypatch):
    held_out = load_capture(capture.path, test_view=0)
    changes = np.full((len(held_out.train_views), 11), 1e-3)  # images have too few features
    monkeypatch.setattr(
        "morgs_mi.extras.calibration.refine.RefinementProblem.matched", lambda _: (changes, 100)
    )
    config = replace(SETTINGS, fit=replace(SETTINGS.fit, refine_cameras="on"))
    fit(held_out, tmp_path / "three", client, config=config)
    stream = StreamReader(tmp_path / "three" / "stream.morgs")
    row = rows_of(tmp_path / "three")[0]
    assert row["validation"]["refinement"]["taken"]
    assert not np.array_equal(stream.cameras[1].viewmat, capture.cameras[1].viewmat)
    stream_capture(held_out, tmp_path / "plain", config)
    plain = StreamReader(tmp_path / "plain" / "stream.morgs")
    assert stream.metadata["distortions"] == plain.metadata["distortions"]
    assert np.array_equal(stream.cameras[1].viewmat, plain.cameras[1].viewmat)


@pytest.mark.slow
def test_ChunkedRun__has_the_same_balance_of_the_cameras_in_all_chunks(capture, client, tmp_path):
    how = ShortFitConfig(gaussians=40, steps=4, rounds=1)
    config = replace(SETTINGS, fit=replace(SETTINGS.fit, exposure="on", short_fits=how))
    fit(capture, tmp_path / "three", client, config=config)
    rows = rows_of(tmp_path / "three")
    balance = [exposure["gain"] for exposure in rows[0]["exposures"]]
    assert max(max(gain) for gain in balance) > 1.001
    for row in rows[1:]:
        for exposure, first in zip(row["exposures"], balance, strict=True):
            assert_allclose(exposure["gain"], first, atol=0.05, err_msg=f"frame {row['frame']}")


@pytest.fixture
def cluster():
    """A process with a scheduler and two workers, which prints the scheduler's address."""
    script = (
        "import sys\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=':0', "
        "silence_logs=50) as it:\n"
        "        print(it.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=-1, stdout=-1, text=True
    ) as process:
        yield process
        process.communicate()


@pytest.mark.slow
def test_ChunkedRun__names_a_lost_scheduler_and_is_resumed(
    capture, client, whole, cluster, tmp_path, monkeypatch
):
    monkeypatch.setattr("morgs_mi.extras.cluster.workers.TIMEOUT", 2)
    lost = when_fitted(4, cluster.kill)
    with (
        pytest.raises(
            ConnectionError,
            match=r"tcp://[\d.:]+: expected a scheduler that answers, .* lost; start it again",
        ),
        open_client(cluster.stdout.readline().strip()) as other,
    ):
        fit(capture, tmp_path, other, on_stage=lost)
    fit(capture, tmp_path, client, resume=True)
    assert stream_of(tmp_path) == stream_of(whole)
