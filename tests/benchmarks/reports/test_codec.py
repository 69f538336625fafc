"""The codec's report: every figure from the streams that it leaves behind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.codec import CodecReportConfig, markdown_table, plot_codec, report_codec
from benchmarks.reports.plots import markdown
from morgs_mi.config import StreamConfig
from morgs_mi.fit.config import FitConfig
from morgs_mi.method.config import MotionConfig

ROOT = Path(__file__).parents[3]
QUICK = CodecReportConfig(
    qualities=(4, 40),
    stream=StreamConfig(
        fit=FitConfig(sh_degree=0, num_gaussians=150, first_frame_steps=20, epochs=2), motion=MotionConfig(key_views=1)
    ),
)


def test_coarser_streams_are_smaller_and_lzma_is_larger(fitted_clip: Path, tmp_path: Path) -> None:
    stages = []
    result = report_codec([fitted_clip / "capture"], tmp_path, QUICK, lambda *stage: stages.append(stage))
    (found,) = result["clips"]
    rows = found["rows"]
    assert [row["quality"] for row in rows] == [4, 40, 1000]
    assert stages[-1] == ("Fitting capture", 3, 3)
    for row in rows:
        assert row["file"] == (tmp_path / "capture" / f"{row['quality']:g}" / "stream.morgs").stat().st_size
        assert row["later"] < row["lzma"] < row["raw"]
        assert row["loss"] == pytest.approx(rows[-1]["psnr"]["later"] - row["psnr"]["later"])
        # What a packet holds beside its flags; of a handful of numbers, the entropy says little.
        assert 0 <= sum(row["bytes_by_group"].values()) < 1.1 * row["later"]
        assert 0 <= row["moved"] < 300
        assert min(row[name] for name in ("encode_ms", "decode_ms", "lzma_ms")) > 0
    for name in ("first", "later", "file"):
        sizes = [row[name] for row in rows]
        assert sizes == sorted(sizes), name
    assert np.isfinite(rows[0]["loss"])
    assert rows[-1]["moved"] > 0
    assert sum(rows[-1]["bytes_by_group"].values()) > 0.3 * rows[-1]["later"]
    table = markdown_table(found).splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(rows)
    before = {path: path.read_bytes() for path in tmp_path.rglob("stream.morgs")}
    (again,) = report_codec([fitted_clip / "capture"], tmp_path, replace(QUICK, resume=True))["clips"]
    assert {path: path.read_bytes() for path in before} == before, "nothing was fitted again"
    assert [row["psnr"] for row in again["rows"]] == [row["psnr"] for row in rows]
    plot_codec(result, tmp_path / "codec.png")
    assert (tmp_path / "codec.png").stat().st_size > 10_000


def test_bad_settings_get_a_sentence(fitted_clip: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`captures` must name at least one folder"):
        report_codec([], tmp_path, QUICK)
    with pytest.raises(ValueError, match="expected a capture of two frames or more, got 1"):
        report_codec([fitted_clip / "capture"], tmp_path, replace(QUICK, frames=1))
    with pytest.raises(ValueError, match="`qualities` must be positive and below the reference's 1000"):
        CodecReportConfig(qualities=(2000,))


def groups_table(result: dict) -> str:
    rows = [(clip["name"], next(row for row in clip["rows"] if row["quality"] == 1)) for clip in result["clips"]]
    names = list(rows[0][1]["bytes_by_group"])
    return markdown(
        ["", *names], [[name, *(f"{row['bytes_by_group'][key] / 1e3:.1f}" for key in names)] for name, row in rows]
    )


def speed_table(result: dict) -> str:
    titles = ("Gaussians", "moving", "kB", "encode ms", "decode ms", "error, px RMS", "largest")
    cells = [
        [f"{row['gaussians']}", f"{row['moving']}", f"{row['bytes'] / 1e3:.0f}"]
        + [f"{row[name]:.0f}" for name in ("encode_ms", "decode_ms")]
        + [f"{row[name]:.3f}" for name in ("error_px_rms", "error_px_max")]
        for row in result["rows"]
    ]
    return markdown(titles, cells, left=0)


def test_documentation_quotes_the_committed_figures() -> None:
    text = (ROOT / "docs/stream.md").read_text(encoding="utf-8")
    report, speed = (
        json.loads((ROOT / f"benchmarks/results/{name}.json").read_text(encoding="utf-8"))
        for name in ("codec_report", "codec_speed")
    )
    assert groups_table(report) in text
    assert speed_table(speed) in text
    for clip in report["clips"]:
        assert markdown_table(clip) in text
