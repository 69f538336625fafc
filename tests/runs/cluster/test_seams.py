"""Seams: the start of a segment, and the cross-fade to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, reemitted_keyframe
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.seams import Moment, Overlap, SegmentConfig, cross_fade, fit_seam_frame
from morgs_mi.stream_loop import StreamLoop
from tests.assertions import assert_close
from tests.scenes.coded_clip import CAMERAS, cloud
from tests.scenes.recording import CONFIG, recording

COUNT = 60
CHANGED = ("log_scales", "quats", "logit_opacities", "sh_coeffs")


def segment(seed: int, first_id: int = 0) -> list[CodedFrame]:
    """Three frames of a segment in which nothing moves; its Gaussians have ids from `first_id` on."""
    coded = decode(None, keyframe_packet(cloud(COUNT), 3))
    other, raw = cloud(COUNT, seed=seed).numpy(), coded.gaussians.numpy()
    for name in CHANGED:
        raw[name] = other[name]
    ids = (first_id + np.arange(COUNT)).astype(np.uint32)
    coded = replace(coded, gaussians=replace(coded.gaussians, **raw), ids=ids, next_id=first_id + COUNT)
    return [replace(coded, frame=frame) for frame in (4, 5, 6)]


def faded(ending: list[CodedFrame], beginning: list[CodedFrame], shared_ids: int = COUNT) -> list[CodedFrame]:
    before = reemitted(replace(ending[0], frame=3))
    found = cross_fade(before, Overlap(ending, beginning, shared_ids), CAMERAS, CodecConfig())
    return [coded for _, coded in found]


def reemitted(coded: CodedFrame) -> CodedFrame:
    """Return the state of a decoder that is given the Gaussians of `coded`."""
    grid = decode(None, keyframe_packet(coded.gaussians, coded.frame, CAMERAS)).grid
    return decode(None, reemitted_keyframe(replace(coded, grid=grid)))


def test_cross_fade__interpolates_the_gaussians_of_both_segments() -> None:
    ending, beginning = segment(0), segment(1)
    states = faded(ending, beginning)
    assert [len(coded) for coded in states] == 3 * [COUNT]
    old, new = (s[0].gaussians.numpy()["sh_coeffs"] for s in (ending, beginning))
    for coded, share in zip(states, (0.15625, 0.5, 0.84375), strict=True):
        assert_close(coded.gaussians.numpy()["sh_coeffs"], old + share * (new - old), atol=0.02)


def test_cross_fade__approaches_also_what_is_less_than_a_step_away() -> None:
    """Which would otherwise appear at the seam."""
    ending, config = reemitted(segment(0)[0]), CodecConfig()
    step = config.birth_precision * ending.grid.steps("means")
    means = ending.gaussians.numpy()["means"] + (0.7 * step).astype(np.float32)
    beginning = replace(ending, gaussians=replace(ending.gaussians, means=means))
    before, count = replace(ending, frame=-1), 20
    found = cross_fade(before, Overlap(count * [ending], count * [beginning], COUNT), CAMERAS, config)
    *_, (_, last) = found
    assert np.all(np.abs(last.gaussians.numpy()["means"] - means) < 0.3 * step)


def test_cross_fade__leaves_what_is_the_same_in_both_segments() -> None:
    same = [replace(reemitted(coded), frame=coded.frame) for coded in segment(0)]
    for coded in faded(same, same):
        np.testing.assert_array_equal(coded.grid.values, reemitted(same[0]).grid.values)


def test_cross_fade__draws_all_others_with_a_part_of_their_optical_depth() -> None:
    ending, beginning = segment(0), segment(1, first_id=COUNT)
    for coded, share in zip(faded(ending, beginning), (0.15625, 0.5, 0.84375), strict=True):
        opacities = np.asarray(coded.gaussians.opacities).reshape(2, COUNT)
        for found, whole, part in zip(opacities, (ending, beginning), (1 - share, share), strict=True):
            expected = 1 - (1 - np.asarray(whole[0].gaussians.opacities)) ** part
            assert_close(found, expected, atol=0.02)


def test_cross_fade__continues_each_gaussian_that_moves_or_dies() -> None:
    ending, beginning = segment(0), segment(1, first_id=COUNT)
    ending[2] = replace(ending[2], gaussians=ending[2].gaussians.select(np.arange(1, COUNT)), ids=ending[2].ids[1:])
    states = faded(ending, beginning)
    assert [len(coded) for coded in states] == [2 * COUNT, 2 * COUNT, 2 * COUNT - 1]
    np.testing.assert_array_equal(states[2].ids, states[1].ids[1:])
    np.testing.assert_array_equal(states[1].ids, states[0].ids)


def test_fit_seam_frame__leaves_what_is_static_as_it_is() -> None:
    capture = recording()
    settings = replace(CONFIG, fit=replace(CONFIG.fit, num_gaussians=400))
    loop = StreamLoop(capture.cameras, capture.points, capture.point_colors, settings)
    images = [frame.images for frame in capture.partial_frames(0, 5)]
    for frame in images[:2]:
        loop.push(frame)
    base = loop.state.coded
    assert base is not None
    config = SegmentConfig(passes=2, epochs=1)
    coded, report = fit_seam_frame(loop.setup, loop.state, Moment(4, images[4]), config)
    assert (coded.frame, report.frame) == (4, 4)
    _, then, now = np.intersect1d(base.ids, coded.ids, return_indices=True)
    same = np.all(base.grid.values[then] == coded.grid.values[now], axis=1)
    assert 0.1 < same.mean() < 1
    assert decode(None, reemitted_keyframe(coded)).next_id >= base.next_id, "ids go on"


def test_fit_config__has_other_seeds_and_rates_for_each_pass() -> None:
    first, second = (SegmentConfig().fit_config(CONFIG, number) for number in (0, 1))
    assert first.seed != second.seed
    assert first.fit.rates.scales == pytest.approx(2 * CONFIG.fit.rates.scales)


def test_overlap_config__has_more_epochs_and_the_same_other_settings() -> None:
    given = StreamConfig(fit=FitConfig(epochs=3))
    found = SegmentConfig().overlap_config(given)
    assert found.fit.epochs == 6
    assert replace(found, fit=given.fit) == given
