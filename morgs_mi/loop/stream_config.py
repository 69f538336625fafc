"""Settings of a fit: all configs in one value, and presets.

Presets:

    l, s                              8 and 5 passes over the views for every later frame
    baseline, ml, ml-mo, ml-mo-mc     rows of the ablation: residuals only; with motion; with
                                      offset; with confidence
    paper                             all three modules; motion and confidence do not start from
                                      the lifted flow, one gate, constant learning rates, motion
                                      rendered to first order

The number of key views (2, 4, 8 or 12 in the paper) is `MotionConfig.key_views` and belongs to no
preset. `platform.config` reads settings from TOML files and writes them.
"""

from __future__ import annotations

from typing import Any, Literal

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.platform.config import NonNegativeInt, apply_values, config_class
from morgs_mi.render.render_config import RenderConfig

PresetName = Literal["l", "s", "baseline", "ml", "ml-mo", "ml-mo-mc", "paper"]


@config_class
class StreamConfig:
    """Settings of the streaming loop.

    Example:
        >>> config = morgs_mi.StreamConfig(fit=morgs_mi.FitConfig(epochs=4), seed=1)
    """

    fit: FitConfig = FitConfig()
    """Optimisation of the Gaussians."""
    motion: MotionConfig = MotionConfig()
    """Motion, offset and confidence."""
    render: RenderConfig = RenderConfig()
    """Rasteriser."""
    codec: CodecConfig = CodecConfig()
    """Precision and size of the stream."""
    seed: NonNegativeInt = 0
    """Seed of every random choice: order of the views, added points."""


def _modules(motion: bool, offset: bool, confidence: bool) -> dict[str, Any]:
    return {"learn_motion": motion, "learn_offset": offset, "learn_confidence": confidence}


PRESETS: dict[PresetName, dict[str, dict[str, Any]]] = {
    "l": {"fit": {"epochs": 8}},
    "s": {"fit": {"epochs": 5}},
    "baseline": {"motion": _modules(False, False, False)},
    "ml": {"motion": _modules(True, False, False)},
    "ml-mo": {"motion": _modules(True, True, False)},
    "ml-mo-mc": {"motion": _modules(True, True, True)},
    "paper": {
        "fit": {"epochs": 8, "decay_means_rate": False},
        "render": {"first_order_motion": True},
        "motion": {
            "lift_flow": False,
            "propagate_motion": False,
            "search_motion": False,
            "refine_start": False,
            "lift_confidence": False,
            "two_gates": False,
            **_modules(True, True, True),
        },
    },
}


def apply_preset(config: StreamConfig, name: PresetName) -> StreamConfig:
    """Return `config` with the settings of a preset; all others are unchanged.

    Raises:
        ValueError: `name` is not a preset.
    """
    if name not in PRESETS:
        raise ValueError(
            f"apply_preset(): the preset must be one of {', '.join(PRESETS)}, got {name!r}."
        )
    return apply_values(config, PRESETS[name], "apply_preset()")
