"""Tables of an evaluation: they fit a terminal and hold the figures."""

import pytest
from rich.console import Console

from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.tables import evaluation_summary, evaluation_tables, figure
from tests.scenes.moving_splats import write_stream


@pytest.fixture(scope="module")
def result(fitted_clip, tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "s.morgs"
    write_stream(path, {"test_view": 0}, shift=1)
    return evaluate_stream(path, fitted_clip / "capture")


def text_of(result):
    """Return the tables of an evaluation as printed."""
    console = Console(width=200, record=True)
    for table in evaluation_tables(result):
        console.print(table)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


def test_evaluation_tables__fit_eighty_columns(result):
    lines = text_of(result).splitlines()
    assert max(map(len, lines)) <= 80
    rows = {line.split("  ")[0].strip(): line.split()[-3:] for line in lines}
    assert rows["PSNR, dB"] == [
        figure(v, 2)
        for v in (result.scores.psnr, result.scores.psnr_moving, result.scores.psnr_still)
    ]
    nearest = figure(result.scores.psnr_nearest, 2)
    assert rows["PSNR, nearest image copied"] == [nearest, "-", "-"]
    assert "LPIPS" not in rows, "no network was given"
    assert any(line.endswith(figure(result.variation.input, 3)) for line in lines)


def test_evaluation_tables__have_a_row_for_each_of_several_views(fitted_clip, tmp_path):
    write_stream(tmp_path / "s.morgs", {"test_view": None}, shift=1)
    several = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    lines = text_of(several).splitlines()
    assert max(map(len, lines)) <= 80
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    for name, scores in (*several.views.items(), ("mean", several.scores)):
        expected = (
            (scores.psnr, 2),
            (scores.psnr_matched, 2),
            (scores.ssim, 4),
            (scores.motion_error, 2),
        )
        assert rows[name] == [figure(*value) for value in expected]


def test_evaluation_summary__holds_the_figures_that_no_table_has(result):
    text = " ".join(evaluation_summary(result))
    motion = result.motion_3d
    for value, digits in ((result.psnr_slope, 4), (result.playback.fps, 0), (motion.angle, 1)):
        assert figure(value, digits) in text
