"""Scores of point tracks on cases with answers computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.studio.measures.track_scores import (
    DYNAMIC_3D_GAUSSIANS,
    MVTRACKER,
    TAPVID3D,
    Comparison,
    Protocol,
    score,
    score_tracks,
)


def case(
    errors: list[list[float]], visible: list[str], tracked: list[str] | None = None, query: int = 0
) -> Comparison:
    """Return tracks that are off by `errors` [P, T] in x; "1" in a row marks a frame with a visible
    point.
    """
    truth = np.zeros((*np.shape(errors), 3))
    offset = np.array(errors)[..., None] * (1, 0, 0)
    masks = [
        np.array([[c == "1" for c in row] for row in rows])
        for rows in (visible, tracked or visible)
    ]
    return Comparison(
        truth, truth + offset, *masks, np.ones(truth.shape[:2], bool), np.full(len(truth), query)
    )


ONE = Protocol("one threshold", (10,), 50)


def test_score__of_exact_tracks_is_perfect() -> None:
    video = case([[0, 0, 0]], ["111"])
    scores = score(DYNAMIC_3D_GAUSSIANS, [video], 1, extent=2)
    assert (
        scores.num_tracks,
        scores.average_jaccard,
        scores.delta_avg,
        scores.occlusion_accuracy,
    ) == (1, 1, 1, 1)
    assert (scores.median_error, scores.median_error_percent, scores.survival, scores.bound) == (
        0,
        0,
        1,
        1,
    )


def test_score__jaccard_of_a_hand_made_track() -> None:
    """Frames after the query: a hit; too far; visible but missed; hidden and missed; hidden but
    claimed.

    Visible are three, within 10 cm two of them. True positives: 1. False positives: the one too
    far, and the hidden one that is claimed. J = 1 / (3 + 2); the visibility is right in frames 1, 2
    and 4.
    """
    video = case([[0, 0.05, 0.2, 0.05, 0, 0]], ["111100"], ["111001"])
    scores = score(ONE, [video], 1, extent=1)
    assert scores.average_jaccard == pytest.approx(1 / 5)
    assert scores.delta_avg == pytest.approx(2 / 3)
    assert scores.occlusion_accuracy == pytest.approx(3 / 5)
    # Errors at visible frames from the query on: 0, 5, 20, 5 cm.
    assert scores.median_error == pytest.approx(0.05)


def test_score__a_point_at_the_threshold_is_not_within_it() -> None:
    video = case([[0, 0.125]], ["11"])
    assert score(Protocol("", (12.5,), 50), [video], 1, 1).delta_avg == 0
    assert score(Protocol("", (12.6,), 50), [video], 1, 1).delta_avg == 1


def test_score__averages_over_thresholds() -> None:
    """An error of 3 cm is within 4, 8 and 16 of 1, 2, 4, 8, 16 cm, and of all of 5, 10, 20, 40 cm.

    J_d is 1 where it is within and 0 elsewhere.
    """
    video = case([[0, 0.03]], ["11"])
    for protocol, share in ((DYNAMIC_3D_GAUSSIANS, 3 / 5), (MVTRACKER, 1)):
        scores = score(protocol, [video], 1, 1)
        assert (scores.delta_avg, scores.average_jaccard) == pytest.approx((share, share))


def test_score__scale_converts_thresholds_and_leaves_errors_in_world_units() -> None:
    """With units of millimetres, an error of 30 units is 3 cm; the extent is 600 units."""
    scores = score(DYNAMIC_3D_GAUSSIANS, [case([[0, 30]], ["11"])], 0.001, extent=600)
    assert scores.delta_avg == pytest.approx(3 / 5)
    assert (scores.median_error, scores.median_error_percent) == pytest.approx((15, 2.5))
    assert scores.survival == 1
    assert score(DYNAMIC_3D_GAUSSIANS, [case([[0, 501]], ["11"])], 0.001, 600).survival == 0.5


def test_score__survival_is_the_share_of_frames_before_the_first_visible_failure() -> None:
    """Track 1 fails in the last of 4 frames from its query on; track 2 fails where it is hidden;
    track 3 never.
    """
    errors = [[9, 0, 0, 0, 0.6], [0, 0, 0, 0.6, 0], [0, 0, 0, 0.5, 0]]
    video = case(errors, ["11111", "11101", "11111"], query=1)
    assert score(ONE, [video], 1, 1).survival == pytest.approx((3 / 4 + 1 + 1) / 3)


def test_score__tracks_are_averaged_each_with_its_own_median() -> None:
    """Medians of the visible errors: 0, 1, 2 cm -> 1; 0, 8 cm -> 4 (the third frame is hidden)."""
    video = case([[0, 0.01, 0.02], [0, 0.08, 5]], ["111", "110"])
    scores = score(ONE, [video], 1, 1)
    assert scores.median_error == pytest.approx(0.025)
    assert scores.delta_avg == 1
    assert scores.survival == 1


def test_score__ignores_frames_before_the_query_and_tracks_without_a_second_visible_frame() -> None:
    video = case([[9, 9, 0, 0], [9, 9, 9, 9]], ["1111", "1110"], query=2)
    scores = score(ONE, [video], 1, 1)
    assert (scores.num_tracks, scores.delta_avg, scores.median_error) == (1, 1, 0)
    assert score(ONE, [case([[0, 0]], ["10"])], 1, 1).num_tracks == 0


def test_score__tapvid3d_scales_pixels_by_depth_over_focal_length() -> None:
    """A pixel is 2 cm wide: an error of 5 cm is within 4, 8 and 16 px but not within 1 and 2 (2 and
    4 cm).
    """
    video = replace(case([[0.05]], ["1"]), pixel=np.array([[0.02]]))
    scores = score(TAPVID3D, [video], 1, 1)
    assert (scores.delta_avg, scores.average_jaccard) == pytest.approx((3 / 5, 3 / 5))
    assert np.isnan([scores.median_error, scores.survival]).all(), (
        "the benchmark does not define them"
    )


def test_score__tapvid3d_counts_all_points_of_a_video_together_and_averages_videos() -> None:
    """The first video has 3 visible points, 2 of them exact and 1 far; the second one has an exact
    one.

    Frames before the query count too. Per track the first video would have 1 and 0, hence 1/2 and
    not 2/3.
    """
    first = replace(case([[0, 0], [99, 99]], ["11", "01"], query=1), pixel=np.ones((2, 2)))
    second = replace(case([[0, 0]], ["10"]), pixel=np.ones((1, 2)))
    scores = score(TAPVID3D, [first, second], 1, 1)
    assert scores.delta_avg == pytest.approx((2 / 3 + 1) / 2)
    # True positives 2, visible 3, false positives 1, the far one.
    assert score(TAPVID3D, [first], 1, 1).average_jaccard == pytest.approx(2 / 4)


def test_score__without_visibility_all_points_count_and_there_is_no_occlusion_accuracy() -> None:
    video = replace(case([[0, 0.05, 9]], ["000"]), visible=None)
    scores = score(ONE, [video], 1, 1)
    assert scores.delta_avg == 0.5
    # True positives 1, visible 2, false positives 1.
    assert scores.average_jaccard == pytest.approx(1 / 3)
    assert np.isnan(scores.occlusion_accuracy)


def test_score__bound_is_the_share_of_points_with_a_living_gaussian() -> None:
    video = replace(case([[0, 0, 0, 0]], ["1111"]), alive=np.array([[True, True, False, False]]))
    assert score(ONE, [video], 1, 1).bound == pytest.approx(1 / 3)


def test_score_tracks__moving_are_those_with_a_path_longer_than_10_cm() -> None:
    """The third point moves only where it is hidden."""
    video = case([[0.01] * 3, [0.02] * 3, [0.03] * 3], ["111", "111", "101"])
    path = np.array([(0, 0, 0), (0, 0.08, 0.12), (0, 9, 0)])
    truth = path[..., None] * (0, 1, 0)
    video = replace(video, truth=truth, found=truth + video.found)
    rows = score_tracks(MVTRACKER, [video], 1, 1)
    assert (rows.protocol, rows.thresholds) == ("MVTracker", "5, 10, 20, 40 cm")
    assert (rows.all.num_tracks, rows.moving.num_tracks) == (3, 1)
    assert rows.moving.median_error == pytest.approx(0.02)
    assert rows.all.median_error == pytest.approx(0.02)
    assert score_tracks(MVTRACKER, [video], 0.5, 1).moving.num_tracks == 0
