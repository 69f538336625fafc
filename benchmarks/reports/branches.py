"""Branches of the method, each with a switch: stages, heuristics, and constants that switch
something or stand for one.

A branch is in `morgs_mi.method`, `fit`, `loop` or one of the two doors. Its switches are settings
of `StreamConfig`, such as ``motion.search_motion``, or names of modules, such as
``method.lift:_ROUNDS``, which `switched` replaces from outside. A constant gets the value with
which it does nothing, a function another one that returns its neutral result. Two constants that
do one thing get one value, and a number of pixels becomes a share of the image.

Sentences, forecasts, the release of memory and fits ahead of time change no packet and are not
listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from morgs_mi.core.attributes import BY_NAME
from morgs_mi.fit import initialise
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method import active_set, exposure, lift, motion
from morgs_mi.method.exposure import Exposure
from morgs_mi.platform.config import apply_values

# Width of the clips on which the settings were chosen, px.
_TUNED_WIDTH = 320
# A number that no Gaussian, pixel or frame exceeds, and the least one that can be divided by.
_ALL = 10**9
_LEAST = 1e-6


@dataclass(frozen=True)
class PerWidth:
    """Length that is a share of the image: so many pixels at the width of the tuning clips."""

    pixels: float  #: At a width of 320 px.

    def at(self, width: int) -> float:
        """Return the length in an image of a width, both in px."""
        return self.pixels * width / _TUNED_WIDTH


GONE: Mapping[str, Any] = {}
"""Switches of a branch that went: its fits, of code that had it, stay in the table."""


@dataclass(frozen=True)
class Branch:
    """A branch, and the switches without it."""

    group: str  #: Branches of a group are switched off together first.
    name: str  #: What is gone without it.
    switches: Mapping[str, Any]  #: New values, by setting or by MODULE:NAME.
    in_first: bool = False  #: Whether it acts on the first frame; otherwise on later ones alone.


@contextmanager
def switched(
    branches: Iterable[Branch], config: StreamConfig, width: int
) -> Iterator[StreamConfig]:
    """Switch branches off until the context ends, and yield the settings without them.

    Args:
        branches: some of `BRANCHES`.
        config: settings with them.
        width: of the images, px.
    """
    switches = {place: value for branch in branches for place, value in branch.switches.items()}
    settings: dict[str, Any] = {}
    with ExitStack() as stack:
        for place, value in switches.items():
            module, _, name = place.partition(":")
            if name:
                value = value.at(width) if isinstance(value, PerWidth) else value
                stack.enter_context(patch(f"morgs_mi.{module}.{name}", value))
            else:
                *parents, setting = place.split(".")
                values = settings
                for parent in parents:
                    values = values.setdefault(parent, {})
                values[setting] = value
        yield apply_values(config, settings)


def groups() -> tuple[str, ...]:
    """Return the names of the groups, in the order of the table."""
    return tuple(dict.fromkeys(branch.group for branch in BRANCHES))


# The functions that neutral ones call, before they are replaced.
_RATES_AT = FitConfig.rates_at
_LINE = exposure._line
_RESPONSIBILITY = active_set.responsibility
_STEP = motion._step
_RESAMPLE = initialise.resample_points


def _everywhere(mask: np.ndarray) -> tuple[slice, slice] | None:
    return (slice(0, mask.shape[0]), slice(0, mask.shape[1])) if mask.any() else None


def _any_motion(flows: Any, d: np.ndarray) -> np.ndarray:
    return np.any(np.linalg.norm(flows.project(d), axis=-1) > lift.NOISE_PX, axis=0)


def _step_alone(jacobians: Any, sums: Any, near: np.ndarray, moves: np.ndarray) -> np.ndarray:
    return _STEP(jacobians, sums, near[:, :0], moves)


_FREE_ROTATION = {**BY_NAME, "quats": replace(BY_NAME["quats"], gate="appearance")}

_CHANGES = "detection of changes"
_FOLLOWED = "exposures over time"
_BALANCE = "balance of the cameras"
_ACTIVE = "active set"
_FLOW = "optical flow"
_STARTS = "start of the motion"
_LIFT = "rules of lifted flow"
_PROPOSALS = "rules of proposals"
_SEARCH = "rules of the search"
_REFINE = "rules of refinement"
_CONFIDENCE = "confidence"
_MASKS = "masks"
_OFFSET = "offset"
_RATES = "rates of later frames"
_ADDITIONS = "density of later frames"
_FIRST = "fit of the first frame"
_POINTS = "points of the first frame"
_PLAN = "plan of the first frame"
_SHARED = "constants that could be one"
_SHARES = "pixels that could be shares"

BRANCHES: tuple[Branch, ...] = (
    # method.change
    Branch(_CHANGES, "threshold by the noise", {"method.change:_SIGMAS": 0.0}),
    Branch(
        _CHANGES,
        "noise of the surroundings",
        {"method.change:_noise_of_surroundings": lambda *_: np.zeros((1, 1), np.float32)},
    ),
    Branch(_CHANGES, "peak of a change", {"method.change:MIN_PEAK": 0.0}),
    Branch(_CHANGES, "changes of colour", {"method.change:_COLORS": np.zeros((2, 3))}),
    Branch(_CHANGES, "average over a window", {"method.change:_WINDOW": 1}),
    Branch(_CHANGES, "closing of outlines", {"method.change:_CLOSING": 1}),
    Branch(
        _CHANGES,
        "inside of outlines",
        {"loop.observation:moving_region": lambda change: change},
    ),
    Branch(_CHANGES, "box around the changes", {"loop.observation:box_around": _everywhere}),
    # method.exposure, loop.observation
    Branch(
        _FOLLOWED,
        "exposure of later frames",
        {"loop.observation:fit_exposure": lambda *_: Exposure()},
    ),
    Branch(
        _FOLLOWED,
        "change of the light that all cameras show",
        {"loop.observation:common_change": lambda exposures: Exposure()},
    ),
    Branch(_FOLLOWED, "least change of exposure", {"loop.observation:LEAST_CHANGE": 0.0}),
    # fit.balance, method.exposure
    Branch(
        _BALANCE,
        "balance",
        {
            "loop.first_frame:_balanced": lambda setup, *_: (
                tuple(Exposure() for _ in setup.cameras),
                {},
            )
        },
        True,
    ),
    Branch(_BALANCE, "further rounds of balance", {"fit.short_fits.rounds": 1}, True),
    Branch(_BALANCE, "cameras that are alike", {"fit.balance:LEAST_DIFFERENCE": 0.0}, True),
    Branch(_BALANCE, "comparison in withheld pixels", {"fit.exposure": "on"}, True),
    Branch(_BALANCE, "limit of the steps of balance", {"fit.balance:_LEAST_SHARE": 1}, True),
    Branch(_BALANCE, "reference of the exposures", {"fit.balance:centred": tuple}, True),
    Branch(_BALANCE, "reweighting of an exposure", {"method.exposure:_STEPS": 1}, True),
    Branch(
        _BALANCE,
        "priors of an exposure",
        {"method.exposure:_line": lambda x, y, prior, _: _LINE(x, y, prior, (_LEAST, _LEAST))},
        True,
    ),
    Branch(_BALANCE, "largest gain", {"method.exposure:_MAX_LOG_GAIN": np.inf}, True),
    Branch(
        _BALANCE,
        "tones that are nearly black or white",
        {"method.exposure:_DARK": -1.0, "method.exposure:_BRIGHT": 2.0},
        True,
    ),
    # method.active_set
    Branch(_ACTIVE, "active set", {"fit.skip_static": False}),
    Branch(
        _ACTIVE,
        "responsibility",
        {
            "method.active_set:responsibility": lambda gaussians, *_: np.ones(
                len(gaussians), np.float32
            )
        },
    ),
    Branch(_ACTIVE, "hidden Gaussians", {"method.active_set:MIN_WEIGHT": 0.0}),
    Branch(_ACTIVE, "overlap", {"method.active_set:_MIN_OVERLAP": -1.0}),
    Branch(
        _ACTIVE,
        "changes that no Gaussian explains",
        {"method.active_set:_inside_unexplained": lambda _, active: np.zeros_like(active)},
    ),
    Branch(_ACTIVE, "Gaussians in some views only", {"method.active_set:QUIET": -1.0}),
    Branch(_ACTIVE, "core of a Gaussian", {"method.active_set:_CORE": 1.0}),
    Branch(_ACTIVE, "everything where most pixels changed", GONE),
    Branch(_ACTIVE, "least part of a changed block", GONE),
    # method.flow, method.objective
    Branch(_FLOW, "flow guidance", {"motion.learn_motion": False}),
    Branch(_FLOW, "flow loss", {"fit.objective.flow_weight": 0.0}),
    Branch(
        _FLOW,
        "forward-backward check",
        {"method.flow:consistency_mask": lambda flow, *_: np.ones(flow.shape[:2], bool)},
    ),
    Branch(_FLOW, "tolerance by length", {"method.flow:RELATIVE_TOLERANCE": 0.0}),
    Branch(_FLOW, "full resolution of small images", {"motion.flow.fine_width": 0}),
    # method.motion
    Branch(_STARTS, "lifted flow", {"motion.lift_flow": False}),
    Branch(_STARTS, "propagation", {"motion.propagate_motion": False}),
    Branch(_STARTS, "search", {"motion.search_motion": False}),
    Branch(_STARTS, "refinement", {"motion.refine_start": False}),
    # method.lift
    Branch(_LIFT, "agreement of the views", {"method.lift:_ROUNDS": 0}),
    Branch(_LIFT, "variance of the flow", GONE),
    Branch(_LIFT, "prior of no motion", {"method.lift:_PRIOR_PIXELS": _LEAST}),
    Branch(_LIFT, "noise that grows with motion", {"method.lift:_NOISE_FRACTION": 0.0}),
    Branch(_LIFT, "weight of hardly covered views", {"method.lift:_HALF_WEIGHT_PIXELS": _LEAST}),
    Branch(_LIFT, "evidence of motion", {"method.lift:_evidence": _any_motion}),
    Branch(_LIFT, "soft confidence", GONE),
    Branch(_LIFT, "least motion", GONE),
    # method.motion, method.sweep
    Branch(_PROPOSALS, "proposals from neighbours", {"method.motion:_ROUNDS": 0}),
    Branch(_PROPOSALS, "proposals from the frame before", GONE),
    Branch(
        _PROPOSALS,
        "clear gain of a proposal",
        {"method.motion:_ERROR_RATIO": 1.0, "method.motion:_ERROR_RATIO_STATIC": 1.0},
    ),
    Branch(
        _PROPOSALS,
        "floors of the relative error",
        {"method.sweep:_FLOOR_PX": _LEAST, "method.sweep:_FLOOR_WEIGHT": _LEAST},
    ),
    # method.search
    Branch(_SEARCH, "limit of a part's error", {"method.search:_UNEXPLAINED": 1.0}),
    Branch(_SEARCH, "least size of a part", {"method.search:_MIN_SIZE": 1}),
    Branch(_SEARCH, "clear gain of the cost", {"method.search:_COST_RATIO": 1.0}),
    Branch(_SEARCH, "clear gain of the images", {"method.search:_ERROR_RATIO": 1.0}),
    Branch(_SEARCH, "further parts", {"method.search:_MAX_PARTS": 1}),
    Branch(_SEARCH, "reduced images", {"method.search:_reduction": lambda *_: 1}),
    # method.motion
    Branch(
        _REFINE,
        "pixels of neighbours",
        {"method.motion:_step": _step_alone},
    ),
    Branch(
        _REFINE,
        "start of the colour",
        {"method.motion:_color_change": lambda color, weight: np.zeros_like(color[0])},
    ),
    Branch(_REFINE, "longest step", {"method.motion:LONGEST_PX": float(_ALL)}),
    Branch(_REFINE, "prior of no step", {"method.motion:_PRIOR_PIXELS": 1e-9}),
    Branch(_REFINE, "colour of few pixels", {"method.motion:_HALF_COLOR_PIXELS": _LEAST}),
    # method.residual, method.confidence, method.cohesion
    Branch(_CONFIDENCE, "confidence", {"motion.learn_confidence": False}),
    Branch(_CONFIDENCE, "two gates", {"motion.two_gates": False}),
    Branch(_CONFIDENCE, "gate of rotations", {"method.residual:BY_NAME": _FREE_ROTATION}),
    Branch(_CONFIDENCE, "confidence by lifted flow", {"motion.lift_confidence": False}),
    Branch(_CONFIDENCE, "cohesion", {"method.cohesion:WEIGHT": 0.0}),
    Branch(_CONFIDENCE, "colour in cohesion", GONE),
    Branch(_CONFIDENCE, "far cohesion", {"method.cohesion:ROUNDS": 10}),
    Branch(_CONFIDENCE, "confidence of the frame before", GONE),
    Branch(_CONFIDENCE, "start at full length behind the gate", {"method.residual:_MIN_GATE": 1.0}),
    # method.mask_refiners, loop.first_frame
    Branch(
        _MASKS,
        "masks",
        {"fit.objective.mask_weight": 0.0, "fit.confidence_steps": 0},
    ),
    Branch(_MASKS, "confidence of the first frame", {"fit.confidence_steps": 0}),
    Branch(_MASKS, "masks of later frames", {"fit.objective.mask_weight": 0.0}),
    Branch(_MASKS, "masks of objects", {"motion.mask_method": "none"}),
    Branch(_MASKS, "threshold by the spread", GONE),
    # method.residual, method.objective
    Branch(_OFFSET, "offset", {"motion.learn_offset": False}),
    Branch(_OFFSET, "offset loss", {"fit.objective.offset_weight": 0.0}),
    # fit.fit_config, fit.later_frame
    Branch(_RATES, "decay of the rate of the means", {"fit.decay_means_rate": False}),
    Branch(
        _RATES,
        "larger rates in fewer epochs",
        {
            "fit.fit_config:FitConfig.rates_at": lambda config, epoch: _RATES_AT(
                replace(config, epochs=8), epoch
            )
        },
    ),
    Branch(_RATES, "momentum by epochs", {"fit.fit_config:FitConfig.momentum": 0.9}),
    Branch(_RATES, "early end of a frame", GONE),
    # fit.density, method.error_per_gaussian
    Branch(_ADDITIONS, "density of later frames", {"fit.density.later_frames": False}),
    Branch(_ADDITIONS, "round before the last epochs", GONE),
    Branch(_ADDITIONS, "errors that are noise", {"method.error_per_gaussian:NOISE": 0.0}),
    Branch(_ADDITIONS, "least error of a parent", {"fit.density.min_error": 0.0}),
    Branch(_ADDITIONS, "smaller births", {"fit.density:_LOG_SHRINK": 0.0}, True),
    # fit.first_frame, fit.density
    Branch(_FIRST, "density of the first frame", {"fit.density.rounds": 0}, True),
    Branch(_FIRST, "half the size at first", {"fit.first_frame:half_sized": list}, True),
    Branch(_FIRST, "one band after the other", {"fit.first_frame:BAND": 0.0}, True),
    Branch(_FIRST, "SH above 0", {"fit.sh_degree": 0}, True),
    Branch(_FIRST, "decay of all rates", {"fit.first_frame:FINAL_RATE": 1.0}, True),
    Branch(_FIRST, "start of the density rounds", {"fit.first_frame:_FIRST_ROUND": 0.01}, True),
    Branch(_FIRST, "halving of long Gaussians", {"fit.density:_LONG": float(_ALL)}, True),
    Branch(_FIRST, "dropout", {"fit.dropout": 0.0}, True),
    Branch(_FIRST, "L1 alone in noise", {"fit.noise_aware": False}, True),
    # fit.initialise
    Branch(
        _POINTS,
        "empty space before the cameras",
        {
            place: lambda cameras, means: np.zeros(len(means), bool)
            for place in ("fit.initialise:in_empty_space", "fit.density:in_empty_space")
        },
        True,
    ),
    Branch(_POINTS, "random points where views show none", {"fit.initialise:MANY_POINTS": 0}, True),
    Branch(_POINTS, "spread of their depths", {"fit.initialise:_SPREAD": 0.0}, True),
    Branch(
        _POINTS,
        "points between neighbours",
        {
            "fit.initialise:resample_points": lambda points, count, rng: (
                _RESAMPLE(points, count, rng) if points.count > count else points
            )
        },
        True,
    ),
    Branch(_POINTS, "extent of distant scenes", {"fit.initialise:_DEPTH": 0.0}, True),
    # fit.detail, fit.budget
    Branch(_PLAN, "noise in details", {"fit.detail:_NOISE": 0.0}, True),
    Branch(_PLAN, "least number of Gaussians", {"fit.budget:LEAST_GAUSSIANS": 1}, True),
    Branch(_PLAN, "Gaussians that grow in the plan", {"fit.budget:_GROWING": 1.0}, True),
    # Constants of one meaning at one value.
    Branch(_SHARED, "gain of a proposal that does not move", {"method.motion:_ERROR_RATIO": 0.8}),
    Branch(_SHARED, "neighbours of cohesion", GONE),
    Branch(
        _SHARED,
        "quiet as hardly responsible",
        {"method.active_set:MIN_RESPONSIBILITY": active_set.QUIET},
    ),
    Branch(_SHARED, "covered pixels of colour", {"method.motion:_HALF_COLOR_PIXELS": 1.0}),
    Branch(_SHARED, "opacity of a birth", {"fit.density:_BIRTH_OPACITY": 0.3}),
    Branch(_SHARED, "overlap as half", {"method.active_set:_MIN_OVERLAP": active_set.EXPLAINED}),
    # Pixels that are a share of the image.
    Branch(_SHARES, "longest step, a share", {"method.motion:LONGEST_PX": PerWidth(2.0)}),
    Branch(
        _SHARES,
        "responsibility at most 1280 px wide",
        {
            "method.active_set:responsibility": lambda gaussians, views: _RESPONSIBILITY(
                gaussians, views, _ALL
            )
        },
    ),
    Branch(_SHARES, "noise of the flow, a share", {"method.lift:NOISE_PX": PerWidth(0.2)}),
    Branch(_SHARES, "least motion, a share", {"method.confidence:NOISE_PX": PerWidth(0.2)}),
)
"""All branches; their names are unique."""
