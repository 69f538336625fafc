"""Optical flow on key views: where the pixels of frame t came from (eq. 4).

Notation: the flow F(x) lives on frame t's pixel grid and points from x_t to x_{t-1}, so I_t(x) is
I_{t-1}(x + F(x)). The motion x_t - x_{t-1} that the renderer's motion map holds is -F. Units are pixels,
x to the right and y down.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

__all__ = ["FLOW_METHODS", "check_pictures", "consistency_mask", "optical_flow"]

# DIS needs patches of 8 pixels on its coarsest level; below this no method has anything to match.
MIN_SIDE = 16

# PCAFlow writes its 18 x 14 coefficients into a quarter of the width and height: out of bounds below this size.
_PCA_SIZE = (72, 56)

# Up to this width, `dis` goes to full resolution.
FINE_WIDTH = 480

_Method = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _on_gray(method: _Method) -> _Method:
    return lambda a, b: method(cv2.cvtColor(a, cv2.COLOR_RGB2GRAY), cv2.cvtColor(b, cv2.COLOR_RGB2GRAY))


def _at_least(width: int, height: int, method: _Method, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the flow of pictures that are padded below and on the right where they are smaller."""
    down, right = max(0, height - a.shape[0]), max(0, width - a.shape[1])
    padded = (cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE) for image in (a, b))
    return method(*padded)[: a.shape[0], : a.shape[1]]


def _dis(preset: int, finest: Callable[[int], int] | None = None) -> _Method:
    """Return DIS by its preset; `finest` tells the level that it ends on, 0 being the picture, by the width."""

    def flow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        method = cv2.DISOpticalFlow_create(preset)
        if finest is not None:
            method.setFinestScale(finest(a.shape[1]))
        # DIS picks its coarsest level by the width alone and crashes where the height falls under a patch.
        return _at_least(0, a.shape[1] // 2, lambda a, b: method.calc(a, b, None), a, b)

    return _on_gray(flow)


def _pcaflow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    method = cv2.optflow.createOptFlow_PCAFlow()
    try:
        return _at_least(*_PCA_SIZE, lambda a, b: method.calc(a, b, None), a, b)
    except cv2.error:  # it found no corner, or lost every one: nothing speaks for motion
        return np.zeros((*a.shape[:2], 2), np.float32)


def _rlof(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # The global motion prior is for moving cameras, and its grid never ends on pictures of less than 40 rows. The
    # default interpolation (EPIC) crashes or gives NaN on small pictures; this one needs colours.
    parameters = cv2.optflow.RLOFOpticalFlowParameter_create()
    parameters.setUseGlobalMotionPrior(False)
    return cv2.optflow.calcOpticalFlowDenseRLOF(a, b, None, rlofParam=parameters, interp_type=cv2.optflow.INTERP_GEO)


# What OpenCV has beside these (sparse-to-dense, SimpleFlow, RLOF with other interpolations) crashes or gives NaN on
# pictures with too little to match: see docs/flow.md. All take RGB as bytes.
FLOW_METHODS: dict[str, _Method] = {
    # Its presets end at half or quarter resolution, where patches of 8 pixels lose what is small in small pictures.
    "dis": _dis(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM, lambda width: int(width > FINE_WIDTH)),
    "dis-fine": _dis(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM, lambda width: 0),
    "dis-ultrafast": _dis(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST),
    "dis-fast": _dis(cv2.DISOPTICAL_FLOW_PRESET_FAST),
    "dis-medium": _dis(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "farneback": _on_gray(lambda a, b: cv2.calcOpticalFlowFarneback(a, b, None, 0.5, 5, 15, 3, 5, 1.2, 0)),
    "pcaflow": _on_gray(_pcaflow),
    "rlof": _rlof,
    "deepflow": _on_gray(lambda a, b: cv2.optflow.createOptFlow_DeepFlow().calc(a, b, None)),
    "tvl1": _on_gray(lambda a, b: cv2.optflow.createOptFlow_DualTVL1().calc(a, b, None)),
}


def optical_flow(image: np.ndarray, previous: np.ndarray, method: str = "dis") -> np.ndarray:
    """Return the flow [H, W, 2] in pixels, float32, from I_t to I_{t-1} on frame t's grid (eq. 4).

    Images with a side under 16 pixels have too little to match: their flow is zero.

    Args:
        image: I_t [H, W, 3], RGB, uint8 or float in [0, 1].
        previous: I_{t-1}, likewise.
        method: a key of `FLOW_METHODS`.

    Raises:
        ValueError: an unknown method, images that are not RGB or differ in size.
    """
    if method not in FLOW_METHODS:
        raise ValueError(f"optical_flow(): `method` must be one of {', '.join(FLOW_METHODS)}, got {method!r}.")
    image, previous = np.asarray(image), np.asarray(previous)
    check_pictures("optical_flow()", image, previous)
    if min(image.shape[:2]) < MIN_SIDE:
        return np.zeros((*image.shape[:2], 2), np.float32)
    return FLOW_METHODS[method](_bytes(image), _bytes(previous))


def check_pictures(place: str, image: np.ndarray, previous: np.ndarray) -> None:
    """Refuse two pictures that are not RGB of one size [H, W, 3]."""
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != previous.shape:
        raise ValueError(
            f"{place}: `image` and `previous` must be RGB of one size [H, W, 3], got {image.shape} and "
            f"{previous.shape}."
        )


def consistency_mask(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return where a flow can be trusted [H, W], bool: where the way back returns to where it began.

    |F + B|^2 < 0.01 (|F|^2 + |B|^2) + 0.5 px^2, with B read where F leads (Sundaram, Brox and Keutzer, ECCV
    2010): what gets hidden or leaves the picture fails.

    Args:
        flow: F [H, W, 2] in pixels, from one frame to another.
        back: B [H, W, 2], from that one to the first, on its own grid.
    """
    height, width = flow.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x + flow[..., 0], y + flow[..., 1]
    back = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mismatch = _squared(flow + back)
    agrees = mismatch < 0.01 * (_squared(flow) + _squared(back)) + 0.5
    # Half a pixel of slack keeps the border itself inside in spite of the flow's own error.
    return agrees & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)


def _bytes(image: np.ndarray) -> np.ndarray:
    if image.dtype != np.uint8:
        image = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(image)


def _squared(vectors: np.ndarray) -> np.ndarray:
    return np.einsum("hwc,hwc->hw", vectors, vectors)
