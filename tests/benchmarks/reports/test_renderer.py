"""Report on the renderer: errors of the settings."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.reports import __main__ as cli
from benchmarks.workloads import ball
from tests import tolerances as tol

SMALL = ["--gaussians", "400", "--width", "48", "--height", "32", "--repeats", "1"]


def test_ball__depends_on_the_seed_and_is_in_view():
    first, camera = ball(3, 50, 64, 48, 0.02, 1)
    again, _ = ball(3, 50, 64, 48, 0.02, 1)
    assert all(np.array_equal(v, again.numpy()[k]) for k, v in first.numpy().items())
    means = first.numpy()["means"]
    assert np.linalg.norm(means, axis=1).max() <= 1 + 1e-6
    assert ((means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2] > 1.9).all()


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The rows of the command for a small scene."""
    folder = tmp_path_factory.mktemp("report")
    path = folder / "report.json"
    plot = folder / "report.png"
    pytest.importorskip("matplotlib")
    assert cli.main(["renderer", *SMALL, "--json", str(path), "--plot", str(plot)]) == 0
    assert plot.stat().st_size > 1000
    value = json.loads(path.read_text())
    assert {"scene", "machine", "versions"} <= value.keys()
    return value["rows"]


@pytest.mark.slow
def test_renderer__has_the_default_once_per_option(reported):
    knobs = [row["knob"] for row in reported]
    assert set(knobs) == {"alpha_min", "stop_transmittance", "block", "reproducible"}
    assert sorted(row["knob"] for row in reported if row["default"]) == sorted(set(knobs))
    assert all(min(row["step_ms"], row["step_ratio"]) > 0 for row in reported)


@pytest.mark.slow
def test_renderer__errors_are_those_of_the_cut_offs(reported):
    rows = {(row["knob"], row["value"]): row for row in reported}
    cuts = [rows["alpha_min", value] for value in ("1/16320", "1/2040", "1/255", "4/255")]
    errors = [row["image"]["rms"] for row in cuts]
    assert errors == sorted(errors)
    assert errors[-1] > 10 * errors[0]
    for row in reported:
        stopped = float(row["value"]) if row["knob"] == "stop_transmittance" else 1e-4
        # Colours reach slightly more than 1; the error results from the stop and from rounding.
        assert row["rounding"]["image"]["max"] < 1.5 * stopped + tol.IMAGE_ABS, (
            row["knob"],
            row["value"],
        )
    no_stop = rows["stop_transmittance", "0"]["rounding"]["gradients"]
    assert max(error["relative_l2"] for error in no_stop.values()) < tol.GRADIENT_REL
