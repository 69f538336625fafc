"""The sampled float64 reference compared with the tests' reference, which loops over everything."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.reports import reference64
from benchmarks.reports.reference64 import ATTRIBUTES, Reference64
from morgs_mi import Camera, RenderConfig
from tests import reference

CONFIG = RenderConfig(alpha_min=1 / 255, alpha_max=0.7)  # a cap that some pixels reach


def scene(degree: int) -> tuple[dict[str, np.ndarray], Camera]:
    rng = np.random.default_rng(3)
    raw = {
        "means": rng.uniform((-1.3, -0.8, -0.5), (1.3, 0.8, 0.5), (9, 3)),
        "log_scales": rng.uniform(np.log(0.1), np.log(0.5), (9, 3)),
        "quats": rng.normal(size=(9, 4)),
        "logit_opacities": rng.uniform(-1.5, 3, 9),
        "sh_coeffs": rng.normal(size=(9, (degree + 1) ** 2, 3)) * 0.5,
    }
    raw["means"][0] = (0, 0, -9)  # behind the camera
    camera = Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 13, 9)
    return raw, Camera(np.float32(camera.K), np.float32(camera.viewmat).astype(np.float64), 13, 9)


def slow(raw: dict[str, np.ndarray], camera: Camera) -> np.ndarray:
    image = reference.rasterize(
        raw,
        np.float64(camera.K),
        camera.viewmat,
        13,
        9,
        alpha_min=CONFIG.alpha_min,
        alpha_max=CONFIG.alpha_max,
    )
    return np.concatenate([image["color"], image["alpha"]], axis=2)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("pairs", [1_000_000, 50], ids=["at once", "in chunks"])
def test_reference64__renders_like_the_reference_of_the_tests(degree, pairs, monkeypatch):
    monkeypatch.setattr(reference64, "PAIRS", pairs)
    raw, camera = scene(degree)
    expected = slow(raw, camera)
    pixels = np.random.default_rng(1).permutation(np.argwhere(np.ones((13, 9))))[:80]
    colors = Reference64(raw, camera, CONFIG).render(pixels)
    assert np.abs(colors - expected[pixels[:, 1], pixels[:, 0]]).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_reference64__gradients_agree_with_complex_steps_through_everything(degree):
    raw, camera = scene(degree)
    rng = np.random.default_rng(2)
    pixels = rng.permutation(np.argwhere(np.ones((13, 9))))[:60]
    weight = rng.normal(size=(60, 4))

    def loss(values):
        return np.sum(slow(values, camera)[pixels[:, 1], pixels[:, 0]] * weight)

    expected = reference.complex_step(loss, raw, list(ATTRIBUTES))
    gradients = Reference64(raw, camera, CONFIG).gradients(pixels, weight)
    for name in ATTRIBUTES:
        assert gradients[name].shape == raw[name].shape
        assert np.abs(expected[name]).max() > 0
        assert (
            np.abs(gradients[name] - expected[name]).max() < 1e-11 * np.abs(expected[name]).max()
        ), name
