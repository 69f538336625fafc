"""Settings of the motion modules."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Le

from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FlowConfig
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from morgs_mi.method.motion_model import MOTION_MODELS
from morgs_mi.platform.config import Count, config_class


@config_class
class MotionConfig:
    """Settings of the motion modules; the first three are the rows of the paper's ablation.

    With all three off, the residual-only baseline remains (eq. 3).

    Raises:
        ValueError: a number is out of range, or a method or model is not registered.
    """

    learn_motion: bool = True
    """ML: optical flow on key views guides each Gaussian's motion (eq. 7)."""
    learn_offset: bool = True
    """MO: a learned offset corrects the flow-guided motion (eq. 8)."""
    learn_confidence: bool = True
    """MC: a learned confidence gates the residuals (eq. 12)."""
    two_gates: bool = True
    """Gate means and rotations only, and let appearance change freely; False: one gate for all, as
    in the paper.
    """
    lift_flow: bool = True
    """Start each Gaussian's motion from lifted flow; False: from zero, as in the paper."""
    constant_velocity: bool = False
    """Without lifted flow: start each Gaussian's motion from its motion in the previous frame."""
    propagate_motion: bool = True
    """Also try the motion of neighbours as starts; needs `lift_flow`."""
    search_motion: bool = True
    """Search for parts that neither flow nor proposals explain; needs `lift_flow`."""
    refine_start: bool = True
    """Refine the start of motion and colour by the images of the key views; needs `lift_flow` and
    `two_gates`.
    """
    lift_confidence: bool = True
    """Start each Gaussian's confidence from lifted flow; False: carry it over, as in the paper."""
    flow_method: str = "dis"
    """Source of optical flow: a method of OpenCV (see docs/flow.md), files:FOLDER, or onnx:FILE for
    a network (onnx-unit:FILE or onnx-signed:FILE if it takes values from 0 or -1 to 1 instead of
    bytes)."""
    mask_method: str = "grabcut"
    """Refinement of flow masks to objects: none, grabcut, or sam2:ENCODER.onnx,DECODER.onnx
    (see docs/masks.md)."""
    key_views: Count | tuple[str, ...] = 4
    """Number of cameras with optical flow and masks, or their names."""
    mask_interval: Count = 5
    """Frames from one supervision of the confidence by masks to the next."""
    model: str = "none"
    """Motion that Gaussians share, fitted before the residual: none, or a registered model (see
    docs/extending.md).
    """
    model_share: Annotated[float, Ge(0), Le(1)] = 0.5
    """Fraction of a later frame's epochs that fit this model, at least one epoch."""
    flow: FlowConfig = FlowConfig()
    """Optical flow."""
    masks: MaskConfig = MaskConfig()
    """Motion masks."""

    def __post_init__(self) -> None:
        FLOW_SOURCES.check(self.flow_method)
        MASK_REFINERS.check(self.mask_method)
        MOTION_MODELS.check(self.model)
