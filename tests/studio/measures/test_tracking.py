"""Point tracks in an evaluation: synthetic captures and captures with annotations of TAPVid-3D."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import Tracks, load_tracks, save_tracks
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, residual_packet
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.results import Evaluation
from morgs_mi.evaluate.tables import evaluation_tables
from tests.scenes.annotations import STARTS, STEP, annotated
from tests.scenes.captures import COUNT
from tests.scenes.gaussians import isotropic
from tests.scenes.moving_splats import EXACT, FRAMES, write_stream

PROTOCOLS = ["TAPVid-3D", "Dynamic 3D Gaussians", "MVTracker"]


def evaluated(folder: Path, step: float) -> Evaluation:
    """Return the evaluation of a stream of small splats on the annotated points, which move by
    `step` per frame.
    """
    capture = load_capture(annotated(folder / "juggle", ("1",)))
    states = [isotropic(STARTS + t * step * np.array([1, 0, 0]), 0.03, 0.95) for t in range(COUNT)]
    with StreamWriter(folder / "s.morgs", capture.cameras, 30, {"test_view": None}) as writer:
        writer.write(packet := keyframe_packet(states[0], 0, capture.cameras, EXACT))
        coded = decode(None, packet)
        for state in states[1:]:
            writer.write(packet := residual_packet(coded, state, None, capture.cameras, EXACT))
            coded = decode(coded, packet)
    return evaluate_stream(folder / "s.morgs", folder / "juggle")


def test_evaluate_tracks__of_the_annotated_motion_is_perfect(tmp_path: Path) -> None:
    result = evaluated(tmp_path, STEP)
    assert [row.protocol for row in result.tracking] == PROTOCOLS
    for row in result.tracking:
        assert (row.all.num_tracks, row.all.delta_avg, row.all.bound) == (3, 1, 1)
    assert all(
        row.all.average_jaccard == row.all.occlusion_accuracy == 1 for row in result.tracking[1:]
    )
    # The third point is annotated as hidden in frame 0, where the stream shows it: 1 of 12 points.
    assert result.tracking[0].all.occlusion_accuracy == pytest.approx(11 / 12)


def test_evaluate_tracks__of_a_static_stream_has_the_errors_of_the_motion(tmp_path: Path) -> None:
    """The points move by 3 cm a frame and the stream does not.

    After the query, points 1 and 2 are off by 3, 6, 9 cm and point 3 by 3, 6 cm. Of 1, 2, 4, 8, 16
    cm these are within 3, 2, 1, of 5, 10, 20, 40 cm within 4, 3, 3. With the query the medians are
    4.5, 4.5 and 3 cm.
    """
    result = evaluated(tmp_path, 0)
    shares = [row.all.delta_avg for row in result.tracking[1:]]
    assert shares[0] == pytest.approx(np.mean([6 / 15, 6 / 15, 5 / 10]))
    assert shares[1] == pytest.approx(np.mean([10 / 12, 10 / 12, 7 / 8]))
    for row in result.tracking[1:]:
        assert row.all.median_error == pytest.approx((0.045 + 0.045 + 0.03) / 3, abs=1e-6)
        assert row.all.survival == 1
        assert row.moving.num_tracks == 0, "no path is longer than 10 cm"


def test_evaluate_tracks__scales_thresholds_by_the_length_of_a_unit(tmp_path: Path) -> None:
    """With 10 m per unit, errors are 30 to 90 cm: only 40 cm holds one, and a survival of 50 cm
    ends in frame 2.
    """
    annotated(tmp_path / "juggle", ())
    (tmp_path / "juggle" / "capture.json").write_text('{"meters_per_unit": 10}')
    result = evaluated(tmp_path, 0)
    _, dynamic, tracker = result.tracking
    assert (dynamic.all.delta_avg, tracker.all.delta_avg) == (
        0,
        pytest.approx(np.mean([1 / 12, 1 / 12, 1 / 8])),
    )
    assert dynamic.all.survival == pytest.approx(np.mean([2 / 4, 2 / 4, 2 / 3]))
    assert dynamic.moving.num_tracks == 3
    (tmp_path / "juggle" / "capture.json").write_text('{"meters_per_unit": 0}')
    with pytest.raises(
        ValueError, match=r"`meters_per_unit` must be a number in \[1e-12, 1e12\], got 0"
    ):
        evaluate_stream(tmp_path / "s.morgs", tmp_path / "juggle")


def test_evaluate_stream__reports_point_tracks_of_a_synthetic_capture(
    fitted_clip: Path, tmp_path: Path
) -> None:
    """The clip stores no visibility: there is no occlusion accuracy."""
    result = evaluate_stream(fitted_clip)
    assert [row.protocol for row in result.tracking] == PROTOCOLS
    for row in result.tracking:
        assert (row.all.num_tracks, row.all.average_jaccard, row.all.delta_avg) == (3, 1, 1)
        assert np.isnan(row.all.occlusion_accuracy)
    assert result.tracking[1].all.median_error == pytest.approx(0, abs=1e-5)
    stored = json.loads(json.dumps(result.as_dict()["tracking"]))
    assert [row["protocol"] for row in stored] == PROTOCOLS
    assert stored[1]["all"]["survival"] == 1
    assert stored[1]["thresholds"] == "1, 2, 4, 8, 16 cm"
    table = list(evaluation_tables(result))[-1]
    console = Console(width=200, record=True)
    console.print(table)
    lines = [line.rstrip() for line in console.export_text().splitlines()]
    assert max(map(len, lines)) <= 80
    assert any(
        line.split() == ["MVTracker", "3", "100.0", "100.0", "-", "0.0000", "0.00", "100.0"]
        for line in lines
    )


def test_evaluate_stream__compares_the_visibility_of_tracked_points(
    fitted_clip: Path, tmp_path: Path
) -> None:
    """Points count as visible that lie in the image of a view with nothing in front."""
    shutil.copytree(fitted_clip / "capture", tmp_path / "capture")
    tracks = load_tracks(tmp_path / "capture" / "truth")
    masks = {}
    for camera in load_capture(tmp_path / "capture").cameras:
        pixels, _ = camera.project(tracks.points)
        masks[camera.name] = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    save_tracks(tmp_path / "capture" / "truth", Tracks(tracks.points, tracks.ids, masks))
    write_stream(tmp_path / "s.morgs", {"test_view": 0})
    perfect = evaluate_stream(tmp_path / "s.morgs", tmp_path / "capture")
    assert all(
        row.all.occlusion_accuracy == row.all.average_jaccard == 1 for row in perfect.tracking
    )
    # Hidden in the truth of every frame but the first two: the stream claims to see the points.
    hidden = {name: mask & (np.arange(FRAMES) < 2) for name, mask in masks.items()}
    save_tracks(tmp_path / "capture" / "truth", Tracks(tracks.points, tracks.ids, hidden))
    scores = evaluate_stream(tmp_path / "s.morgs", tmp_path / "capture").tracking[1].all
    assert (scores.occlusion_accuracy, scores.average_jaccard) == (0.5, 0.5)
    assert scores.delta_avg == 1
