"""Where optical flow comes from: computed by name, read from files, or given by a network; all by one string.

A source takes two successive pictures of a camera and returns two flows in pixels: from I_t to I_{t-1} on frame t's
grid (eq. 4), and from I_{t-1} to I_t on frame t - 1's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from morgs_mi.method.flow_sources.files import FlowFolder
from morgs_mi.method.flow_sources.network import VALUE_RANGES, FlowNetwork
from morgs_mi.method.flow_sources.opencv import FLOW_METHODS, check_pictures, optical_flow

__all__ = ["FlowSource", "FramePair", "flow_source"]


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two successive pictures of one camera.

    Attributes:
        image: I_t [H, W, 3], RGB, uint8 or float in [0, 1].
        previous: I_{t-1}, likewise.
        camera: the camera's name; flow from files needs it.
        frame: t; flow from files needs it.
        valid: [H, W] bool, False where undistortion left nothing; None: valid everywhere.
        box: rows and columns outside which nothing has changed; None: there may be change everywhere.
    """

    image: np.ndarray
    previous: np.ndarray
    camera: str = ""
    frame: int = 1
    valid: np.ndarray | None = None
    box: tuple[slice, slice] | None = None


FlowSource = Callable[[FramePair], tuple[np.ndarray, np.ndarray]]


@lru_cache(maxsize=8)  # a network is loaded once
def flow_source(flow_method: str) -> FlowSource:
    """Return the source that a string names.

    Args:
        flow_method: a key of `FLOW_METHODS`; ``files:FOLDER`` (see `flow_files`); or ``onnx:FILE`` (see
            `flow_network`) for a network that takes values from 0 to 255, ``onnx-unit:FILE`` for one that takes 0 to
            1, ``onnx-signed:FILE`` for one that takes -1 to 1.

    Raises:
        FileNotFoundError: the folder or file is missing.
        ValueError: the string names no source, or as `FlowNetwork`.
    """
    kind, _, path = flow_method.partition(":")
    if flow_method in FLOW_METHODS:
        return partial(_there_and_back, partial(optical_flow, method=flow_method))
    if path and kind == "files":
        return partial(_from_files, FlowFolder(path))
    if path and kind in VALUE_RANGES:
        return partial(_there_and_back, FlowNetwork(path, *VALUE_RANGES[kind]))
    known = ", ".join([*FLOW_METHODS, "files:FOLDER", *(f"{kind}:FILE" for kind in VALUE_RANGES)])
    raise ValueError(f"flow_source(): `flow_method` must be one of {known}, got {flow_method!r}.")


def _there_and_back(
    method: Callable[[np.ndarray, np.ndarray], np.ndarray], pair: FramePair
) -> tuple[np.ndarray, np.ndarray]:
    check_pictures("flow_source()", pair.image, pair.previous)
    if pair.box is None:
        return method(pair.image, pair.previous), method(pair.previous, pair.image)
    now, then = (np.ascontiguousarray(image[pair.box]) for image in (pair.image, pair.previous))
    flows = np.zeros((2, *pair.image.shape[:2], 2), np.float32)
    flows[0][pair.box], flows[1][pair.box] = method(now, then), method(then, now)
    return flows[0], flows[1]


def _from_files(folder: FlowFolder, pair: FramePair) -> tuple[np.ndarray, np.ndarray]:
    return folder.flows(pair.camera, pair.frame, pair.image.shape[:2])
