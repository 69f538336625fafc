"""Settings by name: the paper's two variants and the rows of its ablation.

    l, s                              8 and 5 passes over the views for every later frame
    baseline, ml, ml-mo, ml-mo-mc     residuals only; with motion; with its offset; with confidence
    paper                             all three, motion starting from zero in place of the lifted flow, one gate,
                                      rates that stay

How many key views there are (2, 4, 8 or 12 in the paper) is `MotionConfig.key_views`, and goes with all of them.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Literal, TypeVar

from morgs_mi.fit.config import FitConfig
from morgs_mi.method.config import MotionConfig

__all__ = ["PRESETS", "PresetName", "apply_preset"]

PresetName = Literal["l", "s", "baseline", "ml", "ml-mo", "ml-mo-mc", "paper"]
Config = TypeVar("Config", FitConfig, MotionConfig)


def _modules(motion: bool, offset: bool, confidence: bool) -> dict[str, Any]:
    return {"learn_motion": motion, "learn_offset": offset, "learn_confidence": confidence}


PRESETS: dict[PresetName, dict[str, Any]] = {
    "l": {"epochs": 8},
    "s": {"epochs": 5},
    "baseline": _modules(False, False, False),
    "ml": _modules(True, False, False),
    "ml-mo": _modules(True, True, False),
    "ml-mo-mc": _modules(True, True, True),
    "paper": {
        "epochs": 8,
        "decay_means_rate": False,
        "lift_flow": False,
        "propagate_motion": False,
        "lift_confidence": False,
        "two_gates": False,
        **_modules(True, True, True),
    },
}


def apply_preset(name: PresetName, fit: FitConfig, motion: MotionConfig) -> tuple[FitConfig, MotionConfig]:
    """Return both configs with the settings of a preset; all that it does not speak of stays.

    Raises:
        ValueError: no such preset, or one of its settings was given another value already.
    """
    if name not in PRESETS:
        raise ValueError(f"apply_preset(): `name` must be one of {', '.join(PRESETS)}, got {name!r}.")
    return _with(fit, name), _with(motion, name)


def _with(config: Config, name: PresetName) -> Config:
    own = {f.name: f.default for f in fields(config)}
    values = {key: value for key, value in PRESETS[name].items() if key in own}
    for key, value in values.items():
        given = getattr(config, key)
        if given not in (own[key], value):
            raise ValueError(
                f"apply_preset(): preset {name!r} sets `{key}` to {value}, but it was given as {given}; "
                "leave one of the two out."
            )
    return replace(config, **values)
