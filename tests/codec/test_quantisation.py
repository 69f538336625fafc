"""Steps of the quantised numbers: bounded errors, extremes, and the bytes that they take."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.packets import (
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.attributes import BY_NAME
from morgs_mi.core.gaussians import Gaussians
from tests.scenes.coded_clip import CAMERAS, cloud, jittered


def test_residual_packet__errors_stay_within_the_tolerance():
    """The error is at most half a step for a new Gaussian, a step for a moved one, half a step for
    its base colour.
    """
    config = CodecConfig(birth_precision=2)
    start = cloud(400)
    state = decode(None, keyframe_packet(start, 0, CAMERAS, config))
    assert np.abs(state.grid.real("quats")).max() < 1.1, "relative to the largest component"
    target = jittered(start, np.random.default_rng(1))
    new_state = decode(state, residual_packet(state, target, None, CAMERAS, config))
    for true, result, error, color_error in (
        (start, state, 0.5, 0.5),
        (target, new_state, 2.0, 1.0),
    ):
        exact = true.numpy()
        coded = result.gaussians.numpy()
        for camera in CAMERAS:
            pixels, coded_pixels = (camera.project(raw["means"])[0] for raw in (exact, coded))
            # At most, the errors of three coordinates add up.
            bound = error * BY_NAME["means"].error * np.sqrt(3)
            assert np.abs(pixels - coded_pixels).max() < bound
        sh = np.abs(exact["sh_coeffs"] - coded["sh_coeffs"])
        assert 0.2821 * sh[:, 0].max() < 1.001 * color_error * BY_NAME["sh_dc"].error
        assert sh[:, 1:].max() < 1.001 * error * BY_NAME["sh_dc"].error
        opacity = np.abs(np.asarray(true.opacities) - np.asarray(result.gaussians.opacities))
        assert opacity.max() < 1.001 * error * BY_NAME["logit_opacities"].error
        cosine = np.abs((exact["quats"] * coded["quats"]).sum(1))
        cosine = cosine / np.linalg.norm(exact["quats"], axis=1)
        # The steps are chosen for about 5 px: far below a tenth of a pixel at the ends of an axis.
        assert np.rad2deg(2 * np.arccos(np.minimum(cosine, 1))).max() < 8 * error
        assert opacity.max() > 0.7 * error * BY_NAME["logit_opacities"].error, "the bound is near"


def test_codec_config__more_quality_takes_more_bytes_and_has_smaller_errors():
    gaussians = cloud(400)
    changed_gaussians = jittered(gaussians, np.random.default_rng(1))
    sizes = []
    errors = []
    for quality in (0.25, 1, 4, 1000):
        config = CodecConfig(quality=quality)
        state = decode(None, keyframe_packet(gaussians, 0, CAMERAS, config))
        packet = residual_packet(state, changed_gaussians, None, CAMERAS, config)
        sizes.append(len(packet.encoded))
        errors.append(
            np.abs(
                decode(state, packet).gaussians.numpy()["means"]
                - changed_gaussians.numpy()["means"]
            ).max()
        )
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)
    # A thousandth of 0.04 px of 0.03 units.
    assert errors[-1] < 2e-6


@pytest.mark.parametrize("target", [2000, 8000])
def test_residual_packet__stays_below_its_target_size_and_comes_near_it(target):
    """Offsets count towards it."""
    state = decode(None, keyframe_packet(cloud(1500), 0, CAMERAS))
    rng = np.random.default_rng(1)
    changed_gaussians = jittered(state.gaussians, rng, share=1)
    config = CodecConfig(target_size=target)
    packet = residual_packet(state, changed_gaussians, None, CAMERAS, config)
    sizes = [packet.arrays[name].nbytes for name in ("code", "offset") if name in packet.arrays]
    # It has steps of 2^(1/4), up to a fifth of the bytes where few numbers are left.
    assert 0.75 * target < sum(sizes) <= target
    assert min(sizes) > 400
    assert len(decode(state, packet)) == 1500


def test_residual_packet__stores_changes_of_a_step_and_colours_of_half_a_step():
    config = CodecConfig(birth_precision=1)
    state = decode(None, keyframe_packet(cloud(), 0, CAMERAS, config))
    raw = {name: value.astype(np.float64) for name, value in state.gaussians.numpy().items()}
    for i, steps in ((7, 10.0), (8, 1.0), (9, 0.98)):
        raw["means"][i] += steps * state.grid.steps("means")[i]
    for i, steps in ((17, 0.51), (18, 0.49)):
        raw["sh_coeffs"][i, 0] += steps * state.grid.steps("sh_dc")[i]
    result = decode(state, residual_packet(state, Gaussians(**raw), None, CAMERAS, config))
    assert np.flatnonzero((result.grid.values != state.grid.values).any(1)).tolist() == [7, 8, 17]
    assert np.flatnonzero(result.gaussians.numpy()["motion"].any(1)).tolist() == [7, 8]


def test_residual_packet__follows_a_turn_of_any_angle():
    """The component that is not stored was the largest at birth; later it may vanish."""
    angles = np.linspace(0, 2 * np.pi, 40)
    one_axis = cloud(1)
    state = decode(None, keyframe_packet(replace(one_axis, quats=[[1, 0, 0, 0]]), 0, CAMERAS))
    for angle in angles:
        q = np.array([np.cos(angle / 2), 0.6 * np.sin(angle / 2), 0, 0.8 * np.sin(angle / 2)])
        packet = residual_packet(state, replace(state.gaussians, quats=q[None]), None, CAMERAS)
        state = decode(state, packet)
        assert abs(state.gaussians.numpy()["quats"][0] @ q) > np.cos(np.deg2rad(2))


def test_keyframe_packet__codes_extremes_as_exactly_as_float32():
    """Close to a lens steps are tiny, and large, distant or bright Gaussians would need unbounded
    integers.
    """
    raw = cloud(40).numpy()
    raw["means"][:8] = CAMERAS[0].position + 1.001 * CAMERAS[0].near * CAMERAS[0].viewmat[2, :3]
    raw["log_scales"][:4] = 12, -30, 0
    raw["means"][8:12] = -1e9
    raw["sh_coeffs"][12:16] = -1e8
    extreme = Gaussians(**raw)
    first = decode(None, keyframe_packet(extreme, 0, CAMERAS))
    for name in ("means", "log_scales", "sh_coeffs"):
        exact, code = (
            np.asarray(getattr(g, name)).astype(np.float64) for g in (extreme, first.gaussians)
        )
        largest = np.abs(exact).reshape(40, -1).max(1).reshape(40, *[1] * (exact.ndim - 1))
        # Of the other Gaussians; twice, because steps come in octaves.
        usual = 2 * np.abs(code[16:] - exact[16:]).max()
        assert np.all(np.abs(code - exact) <= np.maximum(2.0**-23 * largest, usual)), name

    # A Gaussian that is born close and small and flies off stops at the limit of its integers.
    gone = replace(first.gaussians, means=first.gaussians.means + np.float32(1e30))
    for config in (CodecConfig(), CodecConfig(birth_precision=1), CodecConfig(target_size=1)):
        second = decode(first, residual_packet(first, gone, cameras=CAMERAS, config=config))
        assert np.asarray(second.gaussians.means).min() > 100
        assert np.array_equal(decode(None, reemitted_keyframe(second)).digest, second.digest)
