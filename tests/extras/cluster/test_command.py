"""`morgs-mi fit --chunks`: chunks side by side, interrupted and continued."""

from dataclasses import astuple

import pytest

from morgs_mi.cli.main import main
from morgs_mi.codec.reader import StreamReader
from morgs_mi.extras.cluster.chunks import ChunkedRun
from morgs_mi.extras.cluster.tasks import ChunkConfig
from tests.quick import OPTIONS
from tests.scenes.recording import write_recording


@pytest.mark.slow
def test_fit__fits_chunks_side_by_side_and_names_what_stands_when_interrupted(
    tmp_path, monkeypatch, capsys, caplog
):
    pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    short = ChunkConfig(passes=1, epochs=1)
    monkeypatch.setattr(ChunkConfig.__init__, "__defaults__", astuple(short))
    clip = write_recording(tmp_path / "clip", 4)
    out = tmp_path / "out"
    add = ChunkedRun.add_part

    def add_and_stop(fit, part):
        add(fit, part)
        raise KeyboardInterrupt

    args = ["fit", str(clip), str(out), *OPTIONS, "--chunks", "2"]
    with monkeypatch.context() as patch:
        patch.setattr(ChunkedRun, "add_part", add_and_stop)
        assert main(args) == 130
    assert (
        capsys.readouterr().err.splitlines()[-1]
        == f"Interrupted. {out / 'chunks'} holds 2 frames; continue with `--resume`."
    )
    assert main([*args, "--resume"]) == 0
    assert "stream.morgs: 4 frames" in capsys.readouterr().out
    assert not any(record.name.startswith("distributed") for record in caplog.records)
    assert len({frame for _, frame, _ in StreamReader(out / "stream.morgs").index()}) == 4
    assert main([*args[:-1], "3"]) == 1
    assert "`chunks` must be 1 to 2 for 4 frames, 2 for each, got 3; " in capsys.readouterr().err


def test_fit__refuses_no_chunks_before_it_reads_a_capture(capsys):
    assert main(["fit", "missing", "out", "--chunks", "0"]) == 1
    assert capsys.readouterr().err.startswith("`chunks` must be ")
