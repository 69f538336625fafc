"""Motion masks: nothing where nothing moves, the object where one does."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.method.confidence import (
    MASK_METHODS,
    flow_mask,
    flow_threshold,
    mask_refiner,
    refine_mask,
    vote_superpixels,
)
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import observe_flow, observe_key_views
from morgs_mi.method.flow_sources.registry import FramePair
from tests.method.moving_disc import moving_disc

CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("size", [(120, 160), (240, 320)])
@pytest.mark.parametrize("method", MASK_METHODS)
def test_static_pair_gives_an_empty_mask_under_camera_noise(method, size):
    previous, image, _ = moving_disc(*size, shift=(0, 0), noise=CAMERA_NOISE)
    assert not observe_flow(image, previous, mask_method=method).mask.any()


@pytest.mark.parametrize("shift", [(6, -4), (1, 0)])
@pytest.mark.parametrize("method", MASK_METHODS)
def test_moving_disc_is_found(method, shift):
    previous, image, disc = moving_disc(240, 320, shift, CAMERA_NOISE)
    mask = observe_flow(image, previous, mask_method=method).mask
    # DIS spreads motion by up to half a patch, 4 px: the bound is a disc of 48 px radius grown by that much.
    assert overlap(mask, disc) > (48 / 52) ** 2 - 0.1
    assert mask[disc].mean() > 0.95


def test_refinement_recovers_an_object_from_a_part_of_it():
    _, image, disc = moving_disc(240, 320, (3, 0), CAMERA_NOISE)
    part = disc.copy()
    part[120:140] = False
    assert overlap(refine_mask(image, part), disc) > 0.95 > overlap(part, disc)


def test_union_never_loses_flow():
    previous, image, _ = moving_disc(120, 160, (3, 2))
    cue = observe_flow(image, previous, mask_method="grabcut")
    assert not (flow_mask(cue.motion, cue.reliable) & ~cue.mask).any()


def test_without_refinement_the_mask_is_the_flows():
    previous, image, _ = moving_disc(120, 160, (3, 2))
    cue = observe_flow(image, previous, mask_method="none")
    np.testing.assert_array_equal(cue.mask, flow_mask(cue.motion, cue.reliable))


def test_superpixels_give_up_what_the_flow_smeared_over_an_edge():
    _, image, disc = moving_disc(240, 320, (3, 0), CAMERA_NOISE)
    smeared = cv2.dilate(disc.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    voted = vote_superpixels(image, smeared)
    assert overlap(voted, disc) > 0.9 > overlap(smeared, disc)
    assert voted[disc].mean() > 0.98


def test_superpixels_give_up_specks():
    _, image, _ = moving_disc(240, 320, (0, 0))
    specks = np.zeros((240, 320), bool)
    specks[10:230:12, 10:310:12] = True
    assert not vote_superpixels(image, specks).any()


def test_masks_are_those_of_the_method_that_the_settings_name():
    previous, image, _ = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    pair = {7: FramePair(image, previous)}
    for method in MASK_METHODS:
        cue = observe_key_views(pair, MotionConfig(mask_method=method), with_masks=True)[7]
        moves = flow_mask(cue.motion, cue.reliable)
        np.testing.assert_array_equal(cue.mask, mask_refiner(method)(image, moves))
    assert observe_key_views(pair, MotionConfig(), with_masks=False)[7].mask is None


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (40, 30), (700, 20)])
@pytest.mark.parametrize("fill", ["nothing", "speck", "all", "half"])
@pytest.mark.parametrize("refine", [refine_mask, vote_superpixels])
def test_refinement_takes_any_mask(refine, size, fill):
    image = np.random.default_rng(0).random((*size, 3))
    mask = np.full(size, fill == "all")
    if fill == "half":
        mask[: size[0] // 2] = True
    mask[size[0] // 2, size[1] // 2] |= fill == "speck"
    refined = refine(image, mask)
    assert refined.shape == size
    assert refined.dtype == bool
    if fill == "nothing":
        assert not refined.any()
    if fill == "all":
        assert refined.all()


@pytest.mark.parametrize("method", MASK_METHODS)
def test_refinement_is_repeatable(method):
    _, image, disc = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    refine = mask_refiner(method)
    np.testing.assert_array_equal(refine(image, disc), refine(image, disc))
    np.testing.assert_array_equal(refine((image * 255 + 0.5).astype(np.uint8), disc), refine(image, disc))


def test_threshold_follows_width_and_noise():
    assert flow_threshold(np.zeros((4, 1352, 2))) == 0.5
    assert flow_threshold(np.zeros((4, 2704, 2))) == 1.0
    assert flow_threshold(np.zeros((4, 160, 2))) == 0.2
    noisy = np.random.default_rng(0).normal(0, 1, (100, 100, 2))
    # Rayleigh: median 1.18, MAD 0.45; 1 % of it lies above 3.
    assert flow_threshold(noisy) == pytest.approx(1.18 + 4 * 0.45, rel=0.05)


def test_unreliable_pixels_are_static():
    motion = np.zeros((8, 8, 2))
    motion[:2] = 9
    reliable = np.ones((8, 8), bool)
    reliable[0] = False
    assert flow_mask(motion, reliable).sum() == 8


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: flow_mask(np.zeros((4, 4))), r"\[H, W, 2\], got \(4, 4\)"),
        (lambda: flow_mask(np.zeros((4, 4, 2)), np.ones((3, 4), bool)), r"got \(3, 4\)"),
        (lambda: refine_mask(np.zeros((4, 4, 3)), np.ones((3, 4), bool)), r"got \(4, 4, 3\)"),
        (lambda: vote_superpixels(np.zeros((4, 4, 3)), np.ones((3, 4), bool)), r"got \(4, 4, 3\)"),
        (lambda: MotionConfig(mask_method="sam"), r"one of none, grabcut, .*DECODER.onnx, got 'sam'"),
        (lambda: MotionConfig(mask_method="sam2:encoder.onnx"), r"got 'sam2:encoder.onnx'"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_documented_figures_are_those_of_the_committed_result():
    root = Path(__file__).parents[2]
    clips = json.loads((root / "benchmarks/results/masks.json").read_text(encoding="utf-8"))["clips"]
    text = (root / "docs/masks.md").read_text(encoding="utf-8")

    def cell(row: dict) -> str:
        return f"{row['iou']:.2f} ({row['found']:.2f}, {row['true']:.2f})"

    lines = [[f"`{clip['name']}`" for clip in clips]]
    lines += [[cell(clip["masks"][method]) for clip in clips] for method in (*MASK_METHODS, "lifted")]
    for start in ("lifted", "as before"):
        for method in clips[0]["loops"][start]:
            rows = [clip["loops"][start][method]["held_out"] for clip in clips]
            lines.append([f"{cell(row)}, {row['psnr_moving']:.2f} dB" for row in rows])
    for line in lines:
        assert f"| {' | '.join(line)} |" in text
