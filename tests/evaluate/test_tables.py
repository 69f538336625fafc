"""Tables of a judgement: they fit a terminal and hold the figures."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.tables import evaluation_summary, evaluation_tables, figure
from tests.moving_splats import write_stream


@pytest.fixture(scope="module")
def result(fitted_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    path = tmp_path_factory.mktemp("tables") / "s.morgs"
    write_stream(path, {"test_view": 0}, shift=1)
    return evaluate_stream(path, fitted_clip / "capture")


def test_tables_fit_eighty_columns(result: dict) -> None:
    console = Console(width=200, record=True)
    for table in evaluation_tables(result):
        console.print(table)
    lines = [line.rstrip() for line in console.export_text().splitlines()]
    assert max(map(len, lines)) <= 80
    rows = {line.split("  ")[0].strip(): line.split()[-3:] for line in lines}
    assert rows["PSNR, dB"] == [
        figure(v, 2) for v in (result["psnr"]["mean"], result["psnr_moving"], result["psnr_still"])
    ]
    assert rows["FLIP"] == [figure(result["flip" + region], 4) for region in ("", "_moving", "_still")]
    assert "LPIPS" not in rows, "no network was given"
    assert any(line.endswith(figure(result["mtv"]["input"], 3)) for line in lines)


def test_sentences_hold_what_no_table_does(result: dict) -> None:
    text = " ".join(evaluation_summary(result))
    for value, digits in ((result["psnr_slope"], 4), (result["playback"]["fps"], 0), (result["motion_3d"]["angle"], 1)):
        assert figure(value, digits) in text


def test_unknown_figures_are_dashes() -> None:
    assert (figure(None, 2), figure(float("nan"), 2), figure(1 / 3, 2)) == ("-", "-", "0.33")
