"""Report on the codec: figures compared with the streams that it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.codec import Options, measure, quality_table
from morgs_mi.capture.capture import load_capture
from tests.quick import quick

QUICK = Options(
    captures=(),
    qualities=(4, 40),
    stream=quick(num_gaussians=150, first_frame_steps=20, epochs=2),
)


@pytest.fixture(scope="module")
def reported(fitted_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Options, dict]:
    """Return the options and the figures of a report."""
    options = replace(QUICK, out=tmp_path_factory.mktemp("codec"))
    return options, measure(load_capture(fitted_clip / "capture"), options)


@pytest.mark.slow
def test_measure__finds_coarser_streams_smaller_and_lzma_larger(reported) -> None:
    _, clips = reported
    rows = clips["rows"]
    assert [row["quality"] for row in rows] == [4, 40, 1000]
    for row in rows:
        assert row["later"] < row["lzma"]
        assert row["loss"] == pytest.approx(rows[-1]["psnr"]["later"] - row["psnr"]["later"])
        assert min(row["encode_ms"], row["lzma_ms"]) > 0
    sizes = [row["later"] for row in rows]
    assert sizes == sorted(sizes)
    assert np.isfinite(rows[0]["loss"])


@pytest.mark.slow
def test_options__write_tables_json_and_plot(fitted_clip, tmp_path, capsys) -> None:
    options = replace(QUICK, out=tmp_path / "codec")
    path = tmp_path / "codec.json"
    plot = tmp_path / "codec.png"
    replace(options, captures=(fitted_clip / "capture",), json=path, plot=plot).run()
    result = json.loads(path.read_text())
    (again,) = result["clips"]
    assert {"settings", "machine", "versions", "commit"} <= result.keys()
    assert quality_table([again]) in capsys.readouterr().out
    assert plot.stat().st_size > 10_000


def test_options__refuse_no_captures() -> None:
    with pytest.raises(ValueError, match="`captures` must name at least one folder"):
        QUICK.run()
