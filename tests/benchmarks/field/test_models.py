"""The motion models of other publications in the fit, and their settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.field.anchors import AnchorConfig, anchored_motion
from benchmarks.field.hicom import HicomConfig, coherent_motion
from benchmarks.field.motion_grid import GridConfig, motion_grid
from benchmarks.field.transformation_cache import CacheConfig, transformation_cache
from morgs_mi.method.motion_model import MOTION_MODELS, MotionModel, motion_model
from tests.scenes.ball import opaque_ball
from tests.scenes.shifted_ball import EXTENT, PLAIN, fit_shifted, motion_error, psnr_of

# Settings that suit a ball of 400 Gaussians.
SMALL = {
    "hicom": HicomConfig(cells=(1.0, 0.3), translation_rate=2e-3),
    "cache": CacheConfig(levels=2, coarsest=1.0),
    "grid": GridConfig(cells=(1.0, 0.3), translation_rate=2e-3),
    "anchors": AnchorConfig(levels=2, gaussians=40, translation_rate=2e-3),
}
OTHER: dict[str, dict[str, Any]] = {
    "hicom": {"cells": (0.3, 0.1), "translation_rate": 1e-3, "rotation_rate": 0.0},
    "cache": {
        "levels": 3,
        "coarsest": 0.5,
        "table": 100,
        "features": 2,
        "hidden": 8,
        "spread": 0.1,
        "displacement": 0.3,
        "rate": 1e-4,
        "table_rate": 0.0,
    },
    "grid": {
        "cells": (0.3, 0.1),
        "translation_step": 1e-2,
        "rotation_step": 0.1,
        "translation_rate": 1e-3,
        "rotation_rate": 0.0,
        "scale": 0.5,
        "scale_rate": 1.0,
        "rate_weight": 1.0,
    },
    "anchors": {
        "levels": 1,
        "gaussians": 80,
        "ratio": 2,
        "translation_step": 0.0,
        "rotation_step": 0.0,
        "translation_rate": 1e-3,
        "rotation_rate": 0.0,
    },
}


def model_of(config: Any) -> MotionModel:
    match config:
        case HicomConfig():
            return coherent_motion(opaque_ball(), EXTENT, config)
        case CacheConfig():
            return transformation_cache(opaque_ball(), EXTENT, np.random.default_rng(0), config)
        case GridConfig():
            return motion_grid(opaque_ball(), EXTENT, config)
    return anchored_motion(opaque_ball(), EXTENT, config)


for _name, _config in SMALL.items():
    MOTION_MODELS.register(f"small-{_name}")(
        lambda *_, config=_config: lambda *__: model_of(config)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_fit_later_frame__finds_the_motion_that_gaussians_share(name):
    """With as many steps, the motion of a rigid body is nearer to the truth than the motion of free
    Gaussians.
    """
    free = fit_shifted(PLAIN)
    shared = [fit_shifted(replace(PLAIN, model=f"small-{name}")) for _ in range(2)]
    assert motion_error(shared[0]) < 0.7 * motion_error(free)
    assert psnr_of(shared[0]) > psnr_of(free)
    other = shared[1].gaussians.numpy()
    assert all(np.array_equal(x, other[n]) for n, x in shared[0].gaussians.numpy().items()), (
        "it repeats to the bit"
    )


@pytest.mark.parametrize("name", ["hicom", "cache", "grid", "grid-slow", "anchors"])
def test_motion_model__has_the_models_by_name(name):
    factory = motion_model(replace(PLAIN, model=name))
    assert factory is not None
    model = factory(opaque_ball(), EXTENT, np.random.default_rng(0))
    assert model.parameters.keys() == model.rates.keys()
    assert model.motion(model.parameters)[0].shape == (400, 3)


def behaviour(config: Any) -> list[np.ndarray]:
    """Return start, rates, motions and losses of a model at random parameters."""
    model = model_of(config)
    rng = np.random.default_rng(1)
    drawn = {
        n: np.float32(rng.normal(0, 0.01, tuple(x.shape))) for n, x in model.parameters.items()
    }
    p = {name: mi.TensorXf(value) for name, value in drawn.items()}
    starts = [np.asarray(value) for value in model.parameters.values()]
    return [
        *starts,
        np.array([*model.rates.values()]),
        *map(np.asarray, (*model.motion(p), *model.losses(p).values())),
    ]


@pytest.mark.parametrize("name", OTHER)
def test_motion_model__every_setting_acts(name):
    usual = behaviour(SMALL[name])
    for setting, value in OTHER[name].items():
        changed = behaviour(replace(SMALL[name], **{setting: value}))
        assert any(not np.array_equal(a, b) for a, b in zip(usual, changed, strict=True)), setting
