"""Optical flow by OpenCV's methods (eq. 4).

Notation: the flow F(x) lives on frame t's pixel grid and points from x_t to x_{t-1}, so I_t(x) is
I_{t-1}(x + F(x)). The motion x_t - x_{t-1} of the rendered motion map is -F. Units are pixels, x to
the right and y down.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np

from morgs_mi.core.color_space import byte_values
from morgs_mi.method.flow_sources.flow_registry import (
    FLOW_SOURCES,
    FlowConfig,
    both_directions,
)
from morgs_mi.platform.config import config_or_default

# Side of an image in pixels below which the methods have too little to match: DIS needs patches of
# 8 pixels on its coarsest level.
MIN_SIDE = 16
# Given None, OpenCV allocates its result; OpenCV's type stubs do not allow for it.
_ALLOCATE: Any = None

_Method = Callable[[np.ndarray, np.ndarray, FlowConfig], np.ndarray]


def _dis(preset: int, finest: Callable[[int, FlowConfig], int] | None = None) -> _Method:
    """Return DIS with a preset.

    Args:
        preset: OpenCV's number of the preset.
        finest: returns the last pyramid level (0 is full resolution) for a width; None: the
            preset's.
    """

    def flow(a: np.ndarray, b: np.ndarray, config: FlowConfig) -> np.ndarray:
        height, width = a.shape[:2]
        method = cv2.DISOpticalFlow.create(preset)
        if finest is not None:
            method.setFinestScale(finest(width, config))
        # At least half as high as wide: DIS chooses its coarsest level by the width alone and
        # crashes where the height is less than a patch.
        missing = max(0, width // 2 - height)
        a, b = _gray(a, b)
        a = cv2.copyMakeBorder(a, 0, missing, 0, 0, cv2.BORDER_REPLICATE)
        b = cv2.copyMakeBorder(b, 0, missing, 0, 0, cv2.BORDER_REPLICATE)
        return method.calc(a, b, _ALLOCATE)[:height]

    return flow


def _gray(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return cv2.cvtColor(a, cv2.COLOR_RGB2GRAY), cv2.cvtColor(b, cv2.COLOR_RGB2GRAY)


def _rlof(a: np.ndarray, b: np.ndarray, config: FlowConfig) -> np.ndarray:
    # The global motion prior is for moving cameras, and its grid never ends on images of less than
    # 40 rows. The default interpolation (EPIC) crashes or returns NaN on small images; this one
    # needs colours.
    parameters = cv2.optflow.RLOFOpticalFlowParameter.create()
    parameters.setUseGlobalMotionPrior(False)
    return cv2.optflow.calcOpticalFlowDenseRLOF(
        a, b, _ALLOCATE, rlofParam=parameters, interp_type=cv2.optflow.INTERP_GEO
    )


# OpenCV's other methods are no better at any cost (Farneback, PCAFlow, dual TV-L1), or crash or
# return NaN on images with too little to match (sparse-to-dense, SimpleFlow, RLOF with other
# interpolations): see docs/experiments/flow.md. All take RGB as bytes.
FLOW_METHODS: dict[str, _Method] = {
    # The presets stop at half or quarter resolution, where patches of 8 pixels miss small objects
    # in small images.
    "dis": _dis(
        cv2.DISOPTICAL_FLOW_PRESET_MEDIUM, lambda width, config: int(width > config.fine_width)
    ),
    "dis-fine": _dis(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM, lambda width, config: 0),
    "dis-ultrafast": _dis(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST),
    "rlof": _rlof,
    "deepflow": lambda a, b, config: cv2.optflow.createOptFlow_DeepFlow().calc(
        *_gray(a, b), _ALLOCATE
    ),
}


def optical_flow(
    image: np.ndarray, previous: np.ndarray, method: str = "dis", config: FlowConfig | None = None
) -> np.ndarray:
    """Return the flow [H, W, 2] in pixels, float32, from I_t to I_{t-1} on frame t's grid (eq. 4).

    Images with a side under 16 px have too little to match: their flow is zero.

    Args:
        image: I_t [H, W, 3], RGB, uint8 or float in [0, 1].
        previous: I_{t-1}, likewise.
        method: a key of `FLOW_METHODS`.
        config: settings of the methods; None: the defaults.
    """
    config = config_or_default("optical_flow()", config, FlowConfig())
    if min(image.shape[:2]) < MIN_SIDE:
        return np.zeros((*image.shape[:2], 2), np.float32)
    a = np.ascontiguousarray(byte_values(image))
    b = np.ascontiguousarray(byte_values(previous))
    return FLOW_METHODS[method](a, b, config)


for _name in FLOW_METHODS:
    FLOW_SOURCES.register(_name)(
        lambda _, config, name=_name: both_directions(
            partial(optical_flow, method=name, config=config)
        )
    )
