"""Report on the codec: figures compared with the streams that it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.codec import CodecReportConfig, CodecResult, markdown_table, plot_codec, report_codec
from morgs_mi.config import StreamConfig
from morgs_mi.core.files import json_finite
from morgs_mi.fit.config import FitConfig
from morgs_mi.method.config import MotionConfig
from morgs_mi.render.config import RenderConfig
from tests.benchmarks.reports.here import Here

QUICK = CodecReportConfig(
    qualities=(4, 40),
    stream=StreamConfig(
        fit=FitConfig(sh_degree=0, num_gaussians=150, first_frame_steps=20, epochs=2), motion=MotionConfig(key_views=1)
    ),
)


@pytest.fixture(scope="module")
def reported(fitted_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[CodecResult, Path, list]:
    """Return a result, the folder of its streams, and the reported stages."""
    folder, stages = tmp_path_factory.mktemp("codec"), []
    result = report_codec([fitted_clip / "capture"], folder, QUICK, lambda *stage: stages.append(stage))
    return result, folder, stages


def test_report_codec__finds_coarser_streams_smaller_and_lzma_larger(reported) -> None:
    result, folder, stages = reported
    (found,) = result.clips
    rows = found.rows
    assert [row.quality for row in rows] == [4, 40, 1000]
    assert stages[-1] == ("Fitting capture", 3, 3)
    for row in rows:
        assert row.file == (folder / "capture" / f"{row.quality:g}" / "stream.morgs").stat().st_size
        assert row.later < row.lzma < row.raw
        assert row.loss == pytest.approx(rows[-1].psnr.later - row.psnr.later)
        # The contents of a packet without its flags; the entropy of a few numbers is only approximate.
        assert 0 <= sum(row.bytes_by_group.values()) < 1.1 * row.later
        assert 0 <= row.moved < 300
        assert min(row.encode_ms, row.decode_ms, row.lzma_ms) > 0
    for name in ("first", "later", "file"):
        sizes = [getattr(row, name) for row in rows]
        assert sizes == sorted(sizes), name
    assert np.isfinite(rows[0].loss)
    assert rows[-1].moved > 0
    assert sum(rows[-1].bytes_by_group.values()) > 0.3 * rows[-1].later


def test_report_codec__reuses_complete_streams(reported, fitted_clip: Path) -> None:
    result, folder, _ = reported
    before = {path: path.read_bytes() for path in folder.rglob("stream.morgs")}
    (again,) = report_codec([fitted_clip / "capture"], folder, replace(QUICK, resume=True)).clips
    assert {path: path.read_bytes() for path in before} == before, "nothing was fitted again"
    assert [row.psnr for row in again.rows] == [row.psnr for row in result.clips[0].rows]


def test_codec_result__is_read_from_its_json(reported) -> None:
    result, *_ = reported
    assert CodecResult.from_dict(json.loads(json.dumps(json_finite(result.as_dict())))).clips == result.clips


def test_markdown_table_and_plot_codec__show_every_row(reported, tmp_path: Path) -> None:
    result, *_ = reported
    table = markdown_table(result.clips[0]).splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(result.clips[0].rows)
    plot_codec(result, tmp_path / "codec.png")
    assert (tmp_path / "codec.png").stat().st_size > 10_000


def test_report_codec__of_workers_is_that_of_one_process(fitted_clip: Path, tmp_path: Path) -> None:
    stream = replace(QUICK.stream, render=RenderConfig(reproducible=True))
    config = replace(QUICK, qualities=(4,), frames=2, stream=stream)
    for name, workers in (("alone", None), ("workers", Here())):
        report_codec([fitted_clip / "capture"], tmp_path / name, config, workers=workers)
    alone, found = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("stream.morgs")}
        for folder in (tmp_path / "alone", tmp_path / "workers")
    )
    assert found == alone


def test_report_codec__refuses_bad_settings(fitted_clip: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`captures` must name at least one folder"):
        report_codec([], tmp_path, QUICK)
    with pytest.raises(ValueError, match="expected a capture of two frames or more, got 1"):
        report_codec([fitted_clip / "capture"], tmp_path, replace(QUICK, frames=1))
    with pytest.raises(ValueError, match="`qualities` must be positive and below the reference's 1000"):
        CodecReportConfig(qualities=(2000,))
