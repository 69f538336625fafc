"""Report on optical flow: errors compared with the flow's."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from benchmarks.reports import __main__ as cli
from benchmarks.reports.flow import errors_table, measure
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import load_truth
from morgs_mi.evaluate.metrics import endpoint_error
from morgs_mi.method.flow import observe_flow
from morgs_mi.method.flow_sources.files import write_flow
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A clip of two cameras and two frames."""
    folder = tmp_path_factory.mktemp("clip") / "spheres"
    synthesize("spheres", folder, SynthConfig(cameras=2, frames=2, width=96, height=72, spp=4))
    return folder


@pytest.fixture(scope="module")
def perfect(clip):
    """The clip's true flow as files: backward exact, forward approximated by the backward motion."""
    flow = clip.parent / "flow"
    for camera in ("cam00", "cam01"):
        motion = load_truth(clip / "truth", camera, 1).motion
        for direction, frame, sign in (("backward", 1, -1), ("forward", 0, 1)):
            (flow / camera / direction).mkdir(parents=True)
            write_flow(flow / camera / direction / f"{frame:04d}.flo", sign * motion)
    return flow


def test_measure__finds_no_error_in_the_true_flow(clip, perfect):
    (row,) = measure(load_capture(clip), (f"files:{perfect}",), 2)["rows"]
    for errors in (row["all"], row["moving"]):
        assert errors["error"] == errors["reliable_error"] == 0
        assert errors["within_1px"] == 1


def test_measure__errors_are_those_of_the_flow_observation(clip):
    capture = load_capture(clip)
    found = measure(capture, ("dis",), 1)
    assert [found[name] for name in ("name", "width", "height", "pairs")] == ["spheres", 96, 72, 1]
    frames, errors = list(capture.frames()), []
    for view, camera in enumerate(capture.cameras):
        truth = load_truth(clip / "truth", camera.name, 1)
        flow = observe_flow(frames[1].images[view], frames[0].images[view])
        moving = truth.mask
        errors.append(
            {
                "error": endpoint_error(flow.motion, truth.motion, moving),
                "within_1px": np.mean(np.linalg.norm(flow.motion - truth.motion, axis=-1)[moving] < 1),
                "reliable": flow.reliable[moving].mean(),
                "reliable_error": endpoint_error(flow.motion, truth.motion, moving & flow.reliable),
            }
        )
    # Figures are rounded to four digits; the report uses either of the two cameras.
    moving = found["rows"][0]["moving"]
    assert any(all(abs(moving[name] - each[name]) < 1e-4 for name in moving) for each in errors)


def test_flow_command__writes_tables_json_and_plot(clip, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    path, plot = tmp_path / "flow.json", tmp_path / "flow.png"
    methods = ["--methods", "dis-ultrafast", "dis"]
    assert cli.main(["flow", str(clip), str(clip), *methods, "--json", str(path), "--plot", str(plot)]) == 0
    value = json.loads(path.read_text())
    rows = value["clips"][0]["rows"]
    assert errors_table(rows) in capsys.readouterr().out
    assert [row["method"] for row in rows] == methods[1:]
    assert all(row["ms"] > 0 for row in rows)
    assert {"settings", "machine", "versions"} <= value.keys()
    assert plot.stat().st_size > 1000


def test_flow_command__refuses_a_clip_without_truth(clip, tmp_path, capsys):
    shutil.copytree(clip, tmp_path / "clip", ignore=shutil.ignore_patterns("truth"))
    assert cli.main(["flow", str(tmp_path / "clip")]) == 1
    assert "with ground truth, got 2 frames and no folder truth" in capsys.readouterr().err
    assert cli.main(["flow"]) == 1
    assert "must name at least one" in capsys.readouterr().err
