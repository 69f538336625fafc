"""Presets: the paper's variants and rows, which leave all else alone and contradict nobody in silence."""

from __future__ import annotations

from dataclasses import asdict
from typing import get_args

import pytest

from morgs_mi.fit.config import FitConfig, Rates
from morgs_mi.fit.presets import PRESETS, PresetName, apply_preset
from morgs_mi.motion.config import MotionConfig


def test_names_are_those_that_are_offered():
    assert tuple(PRESETS) == get_args(PresetName)


@pytest.mark.parametrize(
    ("name", "epochs", "modules", "lifted"),
    [
        ("l", 8, (True, True, True), True),
        ("s", 5, (True, True, True), True),
        ("baseline", 8, (False, False, False), True),
        ("ml", 8, (True, False, False), True),
        ("ml-mo", 8, (True, True, False), True),
        ("ml-mo-mc", 8, (True, True, True), True),
        ("paper", 8, (True, True, True), False),
    ],
)
def test_rows_of_the_paper(name, epochs, modules, lifted):
    fit, motion = apply_preset(name, FitConfig(num_gaussians=77), MotionConfig(key_views=12))
    assert fit == FitConfig(num_gaussians=77, epochs=epochs)
    assert (motion.learn_motion, motion.learn_offset, motion.learn_confidence) == modules
    assert (motion.lift_flow, motion.propagate_motion, motion.key_views) == (lifted, lifted, 12)


def test_places_go_far_first_and_the_rest_takes_longer_strides_in_fewer_epochs():
    first, last = (FitConfig(epochs=8).rates_at(k) for k in (0, 7))
    assert asdict(first) == pytest.approx({**asdict(Rates()), "means": 2 * Rates().means})
    assert asdict(last) == pytest.approx({**asdict(Rates()), "means": Rates().means / 4})
    first, last = (FitConfig(epochs=2).rates_at(k) for k in (0, 1))
    assert first.means == pytest.approx(2 * last.means)
    assert asdict(first) == pytest.approx({**{n: 2 * r for n, r in asdict(Rates()).items()}, "means": first.means})
    assert FitConfig(epochs=1).rates_at(0).means == Rates().means


def test_a_contradiction_is_refused():
    with pytest.raises(ValueError, match="preset 's' sets `epochs` to 5, but it was given as 3; leave one"):
        apply_preset("s", FitConfig(epochs=3), MotionConfig())
    assert apply_preset("s", FitConfig(epochs=5), MotionConfig())[0].epochs == 5
    with pytest.raises(ValueError, match="must be one of l, s, baseline, ml, ml-mo, ml-mo-mc, paper, got 'xl'"):
        apply_preset("xl", FitConfig(), MotionConfig())  # type: ignore[arg-type]
