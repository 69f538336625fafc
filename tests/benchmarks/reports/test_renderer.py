"""The renderer's report: its errors are those of the settings, and the documentation quotes what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports import __main__ as cli
from benchmarks.reports.renderer import RendererReportConfig, ball, markdown_table
from tests import tolerances as tol

ROOT = Path(__file__).parents[3]
SMALL = ["--gaussians", "400", "--width", "48", "--height", "32", "--median-scale", "0.1"]
SMALL += ["--pixels", "200", "--repeats", "1"]


def test_a_ball_is_the_same_for_the_same_seed_and_in_view():
    (first, camera), (again, _) = ball(3, 50, 64, 48, 0.02, 1), ball(3, 50, 64, 48, 0.02, 1)
    assert all(np.array_equal(v, again.numpy()[k]) for k, v in first.numpy().items())
    means = first.numpy()["means"]
    assert np.linalg.norm(means, axis=1).max() <= 1 + 1e-6
    assert ((means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2] > 1.9).all()


@pytest.mark.parametrize("name", ["gaussians", "pixels", "repeats"])
def test_nothing_cannot_be_measured(name):
    with pytest.raises(ValueError, match=f"`{name}` must be at least 1, got 0"):
        RendererReportConfig(**{name: 0})


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The command's figures for a small scene."""
    folder = tmp_path_factory.mktemp("report")
    path, plot = folder / "report.json", folder / "report.png"
    pytest.importorskip("matplotlib")
    assert cli.main(["renderer", *SMALL, "--json", str(path), "--plot", str(plot)]) == 0
    assert plot.stat().st_size > 1000
    return json.loads(path.read_text())


def test_every_knob_has_the_default_once(reported):
    knobs = [row["knob"] for row in reported["rows"]]
    assert set(knobs) == {"alpha_min", "stop_transmittance", "block", "reproducible"}
    assert sorted(row["knob"] for row in reported["rows"] if row["default"]) == sorted(set(knobs))
    assert all(row["step_ms"] > 0 and row["step_ratio"] > 0 for row in reported["rows"])
    assert {"scene", "machine", "versions"} <= reported.keys()


def test_what_is_cut_off_is_what_is_wrong(reported):
    rows = {(row["knob"], row["value"]): row for row in reported["rows"]}
    cuts = [rows["alpha_min", value] for value in ("1/16320", "1/2040", "1/255", "4/255", "16/255")]
    errors = [row["image"]["rms"] for row in cuts]
    assert errors == sorted(errors)
    assert errors[-1] > 10 * errors[0]
    for row in reported["rows"]:
        stopped = float(row["value"]) if row["knob"] == "stop_transmittance" else 1e-4
        # Colours reach 1 and a little more; what lies behind the stop is hidden, the rest is rounding.
        assert row["rounding"]["image"]["max"] < 1.5 * stopped + tol.IMAGE_ABS, (row["knob"], row["value"])
    never = rows["stop_transmittance", "0"]["rounding"]["gradients"]
    assert max(error["relative_l2"] for error in never.values()) < tol.GRADIENT_REL
    assert min(error["cosine"] for error in never.values()) > 1 - 1e-6


def test_documentation_quotes_the_committed_figures():
    result = json.loads((ROOT / "benchmarks/results/renderer_report.json").read_text(encoding="utf-8"))
    assert markdown_table(result) in (ROOT / "docs/experiments/renderer-accuracy.md").read_text(encoding="utf-8")
