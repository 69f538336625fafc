"""Scores of held-out views from the files of a fit and of its evaluation."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.reports.held_out import first_frames, later_frames, scores_of
from morgs_mi.capture.capture import load_capture
from morgs_mi.core.files import write_json
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.runs.fit_capture import stream_capture
from tests.scenes.recording import CONFIG


@pytest.mark.slow
def test_scores_of__has_the_scores_of_each_view_and_frame(clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "spheres"
    stream_capture(load_capture(clip, test_view=[0, 3]), out, CONFIG)
    result = evaluate_stream(out)
    write_json(out / "eval.json", result.as_dict())
    scores = scores_of(out)
    assert (scores["recording"], scores["training_views"]) == ("spheres", 3)
    assert list(scores["views"]) == list(result.views)
    assert [frame["num_bytes"] for frame in scores["frames"]] == [
        frame.num_bytes for frame in result.frames
    ]
    assert scores["frames"][0]["active"] is None
    assert 0 <= scores["frames"][1]["active"] <= 1
    means = [
        sum(view[key] for view in scores["views"].values()) / 2 for key in ("psnr", "psnr_matched")
    ]
    table = first_frames([scores])
    assert all(f"{mean:.2f}" in table for mean in means)
    assert later_frames([scores]).count("| spheres |") == 3
    assert later_frames([{**scores, "frames": scores["frames"][:1]}]).count("| spheres |") == 0
