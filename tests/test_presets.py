"""Presets: the paper's variants and rows, which leave all else alone and contradict nobody in silence."""

from __future__ import annotations

from dataclasses import asdict
from typing import get_args

import pytest

from morgs_mi.fit.config import FitConfig, LearningRates
from morgs_mi.method.config import MotionConfig
from morgs_mi.presets import PRESETS, PresetName, apply_preset


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
    assert fit == FitConfig(num_gaussians=77, epochs=epochs, decay_means_rate=lifted)
    assert (motion.learn_motion, motion.learn_offset, motion.learn_confidence) == modules
    assert (motion.lift_flow, motion.propagate_motion, motion.key_views) == (lifted, lifted, 12)


def test_rates_of_places_fall_and_all_others_are_larger_in_fewer_epochs():
    places = [FitConfig(epochs=8).rates_at(k).means / LearningRates().means for k in range(8)]
    assert places == pytest.approx([1, 1, 2 / 3, 1 / 2, 2 / 5, 1 / 3, 2 / 7, 1 / 4])
    assert all(FitConfig(decay_means_rate=False).rates_at(k) == LearningRates() for k in range(8))
    others = {name: rate for name, rate in asdict(LearningRates()).items() if name != "means"}
    for epochs, factor in ((8, 1), (2, 2)):
        for k in range(epochs):
            rates = asdict(FitConfig(epochs=epochs).rates_at(k))
            assert {name: rates[name] for name in others} == {name: factor * rate for name, rate in others.items()}


def test_a_contradiction_is_refused():
    with pytest.raises(ValueError, match="preset 's' sets `epochs` to 5, but it was given as 3; leave one"):
        apply_preset("s", FitConfig(epochs=3), MotionConfig())
    assert apply_preset("s", FitConfig(epochs=5), MotionConfig())[0].epochs == 5
    with pytest.raises(ValueError, match="must be one of l, s, baseline, ml, ml-mo, ml-mo-mc, paper, got 'xl'"):
        apply_preset("xl", FitConfig(), MotionConfig())  # type: ignore[arg-type]
