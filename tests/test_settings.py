"""Every setting acts: another value of any field changes the stream of a small clip. And every
range is checked.
"""

import re
from dataclasses import astuple, fields, is_dataclass, replace
from typing import get_args

import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt, MultipleOf

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.platform.config import types_of
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.ball_and_wall import cameras, points_and_colors, recorded

BASE = StreamConfig(
    fit=FitConfig(
        sh_degree=1,
        num_gaussians=160,
        first_frame_steps=30,
        confidence_steps=6,
        epochs=6,
        density=DensityConfig(
            rounds=2, births=0.05, max_gaussians=400, min_error=0, split_scale=0.03
        ),
    ),
    motion=MotionConfig(key_views=2, mask_interval=2),
    codec=CodecConfig(),
)


# Values that act on a clip this small, where the default rule (not x, x + 1, 3 x) gives none.
VALUES = {
    "motion.flow_method": "dis-ultrafast",
    "fit.dropout": 0.3,
    "fit.density.max_gaussians": 150,
    "fit.density.split_scale": 1.0,
    "fit.density.min_opacity": 0.4,
    "motion.flow.fine_width": 32,
    "render.stop_transmittance": 0.5,
    "render.alpha_max": 0.5,
    "render.background": (0.1, 0.2, 0.3),
    "render.block_width": 4,
    "render.block_height": 8,
}
# Fields that cannot change this stream, each with the reason and the test that shows that it acts.
ELSEWHERE = {
    "fit.first_frame_seconds": "Gaussians and steps are given here: tests/fit/test_budget.py",
    "fit.camera_priors": "the recorder refines cameras: tests/extras/calibration/test_bundle.py",
    "fit.short_fits": (
        "no cameras are refined here: tests/extras/calibration/test_refine.py, "
        "tests/fit/test_balance.py"
    ),
    "fit.refine_cameras": "the recorder refines cameras: tests/extras/calibration/test_refine.py",
    "fit.exposure": "the tests of the loop have cameras that differ: tests/test_stream_loop.py",
    "fit.noise_aware": "images without noise here: tests/fit/test_dropout.py",
    "motion.mask_method": "flow finds the same masks here: tests/loop/test_observation.py",
    "motion.masks": "tests/method/test_confidence.py and tests/method/mask_refiners",
    "motion.search_motion": "flow explains all parts here: tests/method/test_search.py",
    "motion.constant_velocity": "flow is lifted here: tests/fit/test_later_frame.py",
    "fit.objective.terms": "the package has no further term: tests/fit/test_later_frame.py",
    "motion.model": "the package has no motion model: tests/fit/test_motion_stage.py",
    "codec.keyframe_interval": "the recorder writes keyframes: tests/runs/test_fit_capture.py",
}


def leaves(config, path=""):
    """Return the dotted names of all fields that hold no further config."""
    names = []
    for field in fields(config):
        value = getattr(config, field.name)
        name = f"{path}{field.name}"
        names += leaves(value, f"{name}.") if is_dataclass(value) else [name]
    return names


def with_value(config, name, value):
    """Return a config with the field of a dotted name replaced."""
    head, _, rest = name.partition(".")
    return replace(
        config, **{head: with_value(getattr(config, head), rest, value) if rest else value}
    )


def value_of(config, name):
    for part in name.split("."):
        config = getattr(config, part)
    return config


def other(name):
    value = value_of(BASE, name)
    if name in VALUES:
        return VALUES[name]
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else 3 * value


@pytest.fixture(scope="module")
def clip():
    """The clip of `ball_and_wall` as the light grows slowly, with noise of a grey level."""
    rng = np.random.default_rng(0)
    frames = [
        [
            np.clip(image * (1 + 0.01 * t) + rng.normal(0, 1, image.shape), 0, 255).astype(np.uint8)
            for image in images
        ]
        for t, images in enumerate(recorded())
    ]
    return cameras(), *points_and_colors(), frames


def stream(clip, config):
    views, points, colors, frames = clip
    loop = StreamLoop(views, points, colors, config)
    return b"".join(loop.push(images)[0].encoded for images in frames)


@pytest.fixture(scope="module")
def base(clip):
    assert stream(clip, BASE) == stream(clip, BASE), "the comparison needs a reproducible fit"
    return stream(clip, BASE)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [name for name in leaves(BASE) if not name.startswith(tuple(ELSEWHERE))]
)
def test_settings__every_field_acts(clip, base, name):
    assert stream(clip, with_value(BASE, name, other(name))) != base


def bounds():
    """Return a config, the name of a field, and a value beyond each of its bounds, for all settings
    of a fit.
    """
    values = []
    configs = [StreamConfig()]
    for config in configs:
        configs += [value for value in vars(config).values() if is_dataclass(value)]
        for name, kind in types_of(type(config)).items():
            for arm in (kind, *get_args(kind)):
                for bound in getattr(arm, "__metadata__", ()):
                    values.append((config, name, BEYOND[type(bound)](*astuple(bound))))
    return values


BEYOND = {
    Ge: lambda limit: limit - 1,
    Gt: lambda limit: limit,
    Le: lambda limit: limit + 1 if limit < 1e9 else 2 * limit,
    Lt: lambda limit: limit,
    MultipleOf: lambda limit: limit + 1,
}


def test_settings__every_range_is_checked():
    for config, name, value in bounds():
        place = (
            rf"^{type(config).__name__}\(\): `{name}` must be .*, got {re.escape(str(value))}\.$"
        )
        with pytest.raises(ValueError, match=place):
            replace(config, **{name: value})
    assert len(bounds()) > 60
