"""The objective (eq. 13) as data: L = L_recon + sum of lambda L over further terms.

A `Term` declares its weight, the channels that must be rendered for it, and the observations that
it compares them with. Which channels a view renders, which static splats it needs and which losses
a report lists follow from `TERMS`.

An observation is an array of one view at one frame, by name. `target` exists in all views. The
others exist in key views, where the observer of a term returns them. A term acts in the views that
have all its observations.

`loss_term` registers further terms, which `ObjectiveConfig.terms` selects.

The terms of eq. 13: L_recon (eq. 2), L_flow (eq. 7), L_mask (eq. 11) and L_off, each a scalar
Dr.Jit tensor.

Every loss is a mean over pixels or Gaussians. Its weight does not depend on the size of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
from annotated_types import Ge, Le

from morgs_mi.core.gaussians import Gaussians, read_columns
from morgs_mi.core.types import Arrays, Float, Tensor, Tensors
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.method.method_registry import Registry
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.ssim import Comparison, Recon, Target
from morgs_mi.platform.checks import check_number
from morgs_mi.platform.config import NonNegative, config_class
from morgs_mi.render.backend import elements
from morgs_mi.render.rasterize import Image
from morgs_mi.render.region import DrawnBlocks, Region


def recon_loss(
    image: Tensor,
    target: Target | Comparison,
    dssim_weight: float,
    region: DrawnBlocks | None = None,
) -> Tensor:
    """Return (1 - lambda) mean |I - I*| + lambda (1 - SSIM) (eq. 2), differentiable in `image`.

    Value and derivative are computed together, and the backward pass costs one multiplication.

    Args:
        image: rendered image [H, W, 3], or an image on the region.
        target: image to match.
        dssim_weight: lambda.
        region: the only pixels that are compared; the target itself surrounds them. The derivative
            equals the whole view's. The value omits pixels outside the region and SSIM windows
            without pixels inside, because they cannot have changed.
    """
    on = target.comparison(region if isinstance(region, Region) and not region.whole else None)
    loss = dr.custom(Recon, image.array, on, dssim_weight)
    target.mse = on.mse
    return loss


def flow_loss(
    motion: Tensor, target: Tensor, reliable: Tensor, pixel_share: float | Float
) -> Tensor:
    """Return the mean endpoint error in px between the rendered motion map and the observed motion
    (eq. 7).

    Args:
        motion: rendered motion map [H, W, 2], px, x_t - x_{t-1}; or on a region.
        target: motion by optical flow on the same grid, of the same shape and sign, px.
        reliable: [H, W] of 0 and 1, or on the region. The mean is over all pixels: few reliable
            pixels weigh little.
        pixel_share: weight of a pixel in a mean, 1 / the number of pixels of the whole view.
    """
    lane = dr.arange(mi.UInt32, dr.width(motion) // 2)
    x, y = read_columns(motion.array, lane, 2)
    x = x - elements(target.array, 2 * lane)
    y = y - elements(target.array, 2 * lane + 1)
    # A hundredth of a pixel keeps the derivative finite where both agree.
    total = dr.sum(dr.sqrt(x * x + y * y + 1e-4) * reliable.array)
    return total * pixel_share


def mask_loss(confidence: Tensor, mask: Tensor, pixel_share: float | Float) -> Tensor:
    """Return mean |M~ - M| of the rendered confidence [H, W, 1] and the motion mask [H, W]
    (eq. 11), as `flow_loss`.
    """
    return dr.sum(dr.abs(confidence.array - mask.array)) * pixel_share


def offset_loss(offset: Tensor, share: float | Float) -> Tensor:
    """Return the mean L1 norm of the offsets [N, 3] in scene extents (L_off).

    Args:
        offset: offsets of the active Gaussians, world units.
        share: weight of an offset, 1 / (number of Gaussians of the whole scene * its extent).
    """
    return dr.sum(dr.abs(offset.array)) * share


SQUARED_ERROR = "mse"
"""Name of the mean squared error of the images beside the losses; it has no weight and no
derivative.
"""
Observations = Mapping[str, Any]


@config_class
class ObjectiveConfig:
    """Weights of the terms; 0 switches one off.

    Raises:
        ValueError: a weight is out of range, or a further term is not registered or named twice.
    """

    dssim_weight: Annotated[float, Ge(0), Le(1)] = 0.2
    """lambda of eq. 2."""
    flow_weight: NonNegative = 0.01
    """lambda_flow of eq. 13, per px of endpoint error."""
    mask_weight: NonNegative = 0.5
    """lambda_mask of eq. 13."""
    offset_weight: NonNegative = 0.01
    """lambda_off of eq. 13, per scene extent."""
    terms: tuple[str, ...] = ()
    """Registered terms, NAME:WEIGHT each (see docs/extending.md)."""

    def __post_init__(self) -> None:
        for text in self.terms:
            LOSS_TERMS.check(text)
            _weight(text.partition(":")[2])
        names = [text.partition(":")[0] for text in self.terms]
        if len(names) > len({*names}):
            raise ValueError(
                f"ObjectiveConfig(): `terms` must name each term once, got {self.terms}."
            )


@dataclass(frozen=True, eq=False)
class KeyView:
    """Input of the observers: one key view at one frame."""

    pair: FramePair  #: Its images at frames t and t - 1.
    flow: FlowObservation  #: Its optical flow.


@dataclass(frozen=True, eq=False)
class Prediction:
    """Rendering of one view at one step, which terms compare with the observations."""

    image: Image  #: The rendered channels.
    parameters: Tensors  #: Of the residual, by name.
    region: DrawnBlocks | None  #: The rendered blocks; None: the whole view.
    pixel_share: Float  #: Weight of a pixel in a mean: 1 / the number of the whole view's [1].
    offset_share: Float  #: Weight of an offset, see `offset_loss` [1].
    extent: float  #: Of the scene, world units; 1 in a recording, which has no further terms.
    gaussians: Gaussians  #: The active ones, after the residual.
    #: The same ones in the previous frame, detached, in their order: one object in all steps up to
    #: the round of density control.
    previous: Gaussians


Loss = Callable[[Prediction, Observations, ObjectiveConfig], Tensor]
Observer = Callable[[KeyView, MotionConfig, ObjectiveConfig], Arrays]


@dataclass(frozen=True)
class Term:
    """One term of the objective."""

    name: str  #: In reports.
    loss: Loss  #: (prediction, observations, settings) -> scalar.
    channels: tuple[str, ...] = ()  #: That must be rendered.
    observations: tuple[str, ...] = ()  #: That must exist.
    parameters: tuple[str, ...] = ()  #: Of the residual that must exist.
    #: (key view, settings of the motion, settings) -> observations [H, W, ...] by name; None: they
    #: exist without it.
    observer: Observer | None = None
    weight: float | None = None  #: Lambda; None: the setting NAME_weight, 1 without one.


# Terms that every fit may have. Recorded steps compute them, where `Prediction.extent` is 1 and
# Gaussians and parameters are padded: use sums times a share there, no means over Gaussians.
TERMS: tuple[Term, ...] = (
    Term(  # eq. 2
        "recon",
        lambda p, o, config: recon_loss(p.image.color, o["target"], config.dssim_weight, p.region),
        channels=("color",),
        observations=("target",),
    ),
    Term(  # eq. 7
        "flow",
        lambda p, o, config: flow_loss(
            p.image["guided_motion"], o["motion"], o["reliable"], p.pixel_share
        ),
        channels=("guided_motion",),
        observations=("motion", "reliable"),
        observer=lambda view, motion, config: (
            {"motion": view.flow.motion, "reliable": view.flow.reliable}
            if motion.learn_motion
            else {}
        ),
    ),
    Term(  # eq. 11
        "mask",
        lambda p, o, config: mask_loss(p.image.confidence, o["mask"], p.pixel_share),
        channels=("confidence",),
        observations=("mask",),
        observer=lambda view, motion, config: (
            {"mask": view.flow.mask}
            if motion.learn_confidence and view.flow.mask is not None
            else {}
        ),
    ),
    Term(  # L_off
        "offset",
        lambda p, o, config: offset_loss(p.parameters["offset"], p.offset_share),
        parameters=("offset",),
    ),
)


LOSS_TERMS: Registry[Term, ObjectiveConfig] = Registry(
    "ObjectiveConfig()", "terms", ObjectiveConfig
)


def loss_term(
    name: str,
    channels: tuple[str, ...] = (),
    observations: tuple[str, ...] = (),
    parameters: tuple[str, ...] = (),
    observer: Observer | None = None,
) -> Callable[[Loss], Loss]:
    """Return a decorator that registers a loss as a term of the objective of later frames.

    Example:
        >>> @morgs_mi.loss_term("speed", parameters=("motion",))
        ... def speed_loss(prediction, observations, config):
        ...     motion = prediction.parameters["motion"]
        ...     return dr.mean(dr.abs(motion), axis=None) / prediction.extent
        >>> objective = morgs_mi.ObjectiveConfig(terms=("speed:0.1",))

    Args:
        name: selects the term, with its weight, in `ObjectiveConfig.terms`.
        channels: as `Term` has them, like all that follow.
        observations: that must exist.
        parameters: of the residual that must exist.
        observer: of the key views.

    Raises:
        ValueError: the name is taken, empty, or has a colon.
    """
    if name in (SQUARED_ERROR, *(term.name for term in TERMS)):
        raise ValueError(
            f"loss_term(): `name` must be new, got {name!r}, which the objective has already; "
            "rename it."
        )

    def add(loss: Loss) -> Loss:
        def term(weight: str, config: ObjectiveConfig) -> Term:
            return Term(name, loss, channels, observations, parameters, observer, _weight(weight))

        LOSS_TERMS.register(name, "WEIGHT")(term)
        return loss

    return add


def _weight(text: str) -> float:
    """Return the weight of a registered term."""
    try:
        weight: Any = float(text)
    except ValueError:
        weight = text
    check_number("ObjectiveConfig()", "terms", weight, "[0, inf)")
    return weight


def terms_of(config: ObjectiveConfig) -> tuple[Term, ...]:
    """Return all terms that the settings have a weight for."""
    return (*TERMS, *(LOSS_TERMS.make(text, config) for text in config.terms))


def observe(view: KeyView, motion: MotionConfig, config: ObjectiveConfig) -> Arrays:
    """Return the observations of a key view, arrays [H, W, ...] by name."""
    observations = {}
    for term in terms_of(config):
        if term.observer is not None:
            observations |= term.observer(view, motion, config)
    return observations


def active_terms(
    observations: Observations, parameters: Tensors, config: ObjectiveConfig
) -> list[Term]:
    """Return the terms that act in a view with these observations."""
    weights = weights_of(config)
    return [
        term
        for term in terms_of(config)
        if weights[term.name]
        and observations.keys() >= {*term.observations}
        and all(name in parameters for name in term.parameters)
    ]


def channels_of(observations: Observations, config: ObjectiveConfig) -> tuple[str, ...]:
    """Return the channels to render in a view with these observations beside its `target`."""
    terms = active_terms({"target": None, **observations}, {}, config)
    return tuple(dict.fromkeys(channel for term in terms for channel in term.channels))


def losses_of(
    prediction: Prediction, observations: Observations, config: ObjectiveConfig
) -> Tensors:
    """Return the losses of one view, by the names of the terms."""
    terms = active_terms(observations, prediction.parameters, config)
    return {term.name: term.loss(prediction, observations, config) for term in terms}


def weights_of(config: ObjectiveConfig) -> dict[str, float]:
    """Return the weights of the terms, by name."""
    return {
        term.name: getattr(config, f"{term.name}_weight", 1.0)
        if term.weight is None
        else term.weight
        for term in terms_of(config)
    }
