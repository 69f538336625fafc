"""Selection of an optical-flow source by one string.

A source takes two successive images of a camera and returns two flows in pixels: from I_t to
I_{t-1} on frame t's grid (eq. 4), and from I_{t-1} to I_t on frame t - 1's grid.

A new source is one module in this package that decorates a factory with `FLOW_SOURCES.register`;
docs/flow.md has an example. A source outside this package registers itself in the same way where it
is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from morgs_mi.method.method_registry import Registry
from morgs_mi.platform.config import NonNegativeInt, config_class

NOISE_PX = 0.2
"""Noise of the flow where nothing moves, px, in images of any width."""


@config_class
class FlowConfig:
    """Settings of OpenCV's methods.

    Raises:
        ValueError: a number is out of range.
    """

    fine_width: NonNegativeInt = 480
    """Width in pixels up to which `dis` goes to full resolution; in wider images it stops at half
    resolution.
    """


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two successive images of one camera."""

    image: np.ndarray  #: I_t [H, W, 3], RGB, uint8 or float in [0, 1].
    previous: np.ndarray  #: I_{t-1}, likewise.
    camera: str = ""  #: The camera's name; flow from files needs it.
    frame: int = 1  #: t; flow from files needs it.
    #: [H, W] bool, False where undistortion left nothing; None: valid everywhere.
    valid: np.ndarray | None = None
    #: Rows and columns outside which nothing has changed; None: any pixel may have changed.
    box: tuple[slice, slice] | None = None
    #: [H, W] bool, pixels outside which nothing has moved, all of them in the box; None: any may
    #: have.
    region: np.ndarray | None = None


FlowSource = Callable[[FramePair], tuple[np.ndarray, np.ndarray]]

FLOW_SOURCES: Registry[FlowSource, FlowConfig] = Registry(
    "MotionConfig()", "flow_method", FlowConfig
)
"""Sources by name: a key of `FLOW_METHODS`; ``files:FOLDER`` (see `files`); ``onnx:FILE`` (see
`extras.networks.flow_network`) for a network that takes values from 0 to 255, ``onnx-unit:FILE``
for one that takes 0 to 1, ``onnx-signed:FILE`` for one that takes -1 to 1.
"""


def both_directions(method: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> FlowSource:
    """Return the source that computes both flows by a function of two images, inside the pair's
    box.

    Args:
        method: takes two images and returns the flow [H, W, 2] from the first to the second.
    """

    def source(pair: FramePair) -> tuple[np.ndarray, np.ndarray]:
        box = pair.box or np.s_[:, :]
        image = np.ascontiguousarray(pair.image[box])
        previous = np.ascontiguousarray(pair.previous[box])
        backward, forward = np.zeros((2, *pair.image.shape[:2], 2), np.float32)
        backward[box] = method(image, previous)
        forward[box] = method(previous, image)
        return backward, forward

    return source
