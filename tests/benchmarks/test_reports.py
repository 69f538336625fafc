"""Reports at a tiny size, and the measures that their claims rest on."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import tyro

from benchmarks.reports.tracks import track_scores
from morgs_mi import RenderConfig, SynthConfig, load_capture, synthesize
from morgs_mi.capture.truth import Tracks, save_tracks
from morgs_mi.codec.frame_source import FrameState
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.files import write_json
from morgs_mi.runs.fit_capture import stream_capture
from tests.quick import quick
from tests.scenes.moving_splats import moved

SEED = "--seeds 1 --clips CLIPS"
FIELD = f"{SEED} --epochs 2 --num-gaussians 60 --first-frame-steps 3 --plot OUT/a.png"
OUTLINES = "--capture CLIPS/random-1 --silhouettes CLIPS/outlines.json"
REPORTS = {
    "far_cameras": f"{OUTLINES} --downscale 1 --gaussians 60 --steps 3 --fit-seeds 0",
    "field": FIELD,
    "held_out": "CLIPS/fit",
    "needed": "--sets random-41 --clips CLIPS --recordings CLIPS --most 4",
    "tracks": "CLIPS/fit",
}


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """A folder with a tiny clip by the names of several, and its fit."""
    folder = tmp_path_factory.mktemp("clips")
    size = SynthConfig(cameras=5, frames=3, width=48, height=36, spp=1)
    clip = synthesize("spheres", folder / "random-1", size)
    (folder / "random-41").symlink_to(clip)
    square = [[18, 12], [30, 12], [30, 24], [18, 24]]
    outlines = {f"cam{view:02d}": square for view in range(5)}
    write_json(folder / "outlines.json", {"silhouettes": outlines})
    stream_capture(load_capture(clip), folder / "fit", quick())
    write_json(folder / "fit/eval.json", evaluate_stream(folder / "fit").as_dict())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", REPORTS)
def test_reports__write_rows(name, clips, tmp_path):
    text = f"{REPORTS[name]} --json OUT/out.json"
    args = text.replace("CLIPS", str(clips)).replace("OUT", str(tmp_path)).split()
    report = import_module(f"benchmarks.reports.{name}")
    options = tyro.cli(report.Options, args=args)
    options.run()
    result = read_json(tmp_path / "out.json")
    assert {"machine", "versions", "commit", "date"} <= result.keys()
    assert result["fits"]


def test_track_scores__of_gaussians_at_rest_beside_moving_points(fitted_clip, tmp_path):
    """After the first frame, errors of 15 and 30 cm: of five thresholds only 16 cm holds one."""
    points = np.stack([moved(3 * frame).numpy()["means"] for frame in range(3)], 1)
    save_tracks(tmp_path, Tracks(points, np.zeros(5, np.int32), {"cam1": np.ones((5, 3), bool)}))
    capture = replace(load_capture(fitted_clip / "capture", test_view=0), truth=tmp_path)
    states = [FrameState(frame, np.arange(5, dtype=np.uint32), moved(0)) for frame in range(3)]
    scores = track_scores(states, capture, RenderConfig())
    assert scores["average_jaccard"] == pytest.approx(1 / 15)
    assert scores["delta_avg"] == pytest.approx(1 / 10)
    assert scores["median_error"] == pytest.approx(0.15)
