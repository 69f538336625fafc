"""Which motion reasoning is done, and how much it weighs."""

from __future__ import annotations

from dataclasses import dataclass

from morgs_mi.method.confidence import mask_refiner
from morgs_mi.method.flow_sources.registry import flow_source

__all__ = ["MotionConfig"]


@dataclass(frozen=True)
class MotionConfig:
    """Settings of the motion modules; the first three are the rows of the paper's ablation.

    With all three off, what is left is the residual-only baseline (eq. 3).

    Raises:
        FileNotFoundError: `flow_method` or `mask_method` names a file or folder that does not exist.
        ValueError: `flow_method` names no source of flow, `mask_method` no refinement, or a number is out of range.
    """

    learn_motion: bool = True
    """ML: optical flow on key views guides each Gaussian's motion (eq. 7)."""
    learn_offset: bool = True
    """MO: a learned offset corrects the flow-guided motion (eq. 8)."""
    learn_confidence: bool = True
    """MC: a learned confidence gates all residuals (eq. 12)."""
    two_gates: bool = True
    """The confidence gates places and rotations alone, the rest changes wherever it has to; False: one gate for all."""
    lift_flow: bool = True
    """Start each Gaussian's motion from the key views' flow in closed form; False: from zero, as in the paper."""
    propagate_motion: bool = True
    """Offer each Gaussian its own motion of the frame before and its neighbours', too, where motion starts from lifted
    flow; False: that alone."""
    lift_confidence: bool = True
    """Raise each Gaussian's confidence to that evidence; False: start from the frame before, as in the paper."""
    flow_method: str = "dis"
    """Optical flow: the name of a method (see docs/flow.md), files:FOLDER for flow from files, or onnx:FILE for a
    network (onnx-unit:FILE or onnx-signed:FILE if it takes values from 0 or -1 to 1 in place of bytes)."""
    mask_method: str = "grabcut"
    """How flow masks become objects: none, grabcut, superpixels, superpixels+grabcut, or
    sam2:ENCODER.onnx,DECODER.onnx for SAM2's two networks (see docs/masks.md)."""
    key_views: int = 4
    """Cameras that get optical flow and masks."""
    mask_interval: int = 5
    """Every how many frames the masks supervise the confidence."""
    weight_flow: float = 0.01
    """lambda_flow of eq. 13, per px of endpoint error."""
    weight_mask: float = 0.5
    """lambda_mask of eq. 13."""
    weight_offset: float = 0.01
    """lambda_off of eq. 13; the offset counts in scene extents."""
    detach_weights: bool = True
    """Keep the flow and mask losses from moving opacity and geometry: they are about motion and confidence."""

    def __post_init__(self) -> None:
        # What is wrong with either shall be said before the first frame is fitted.
        flow_source(self.flow_method)
        mask_refiner(self.mask_method)
        for name in ("key_views", "mask_interval"):
            if getattr(self, name) < 1:
                raise ValueError(f"MotionConfig(): `{name}` must be at least 1, got {getattr(self, name)}.")
