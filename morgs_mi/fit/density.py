"""Density control: cloning, splitting, adding and pruning Gaussians, and resizing the optimiser's
state.

N Gaussians become M. `parent` [M] is the index among the N of the Gaussian that each one is or was
made from; `source` [M] is the same for survivors, which come first in ascending order, and -1 for
births, which come last.

In the first frame, `plan_growth` (Kerbl et al. 2023): a small parent is cloned, and both get the
opacity 1 - sqrt(1 - o), with which they cover as much as the parent (Bulo et al. 2024). A large
parent is split into two: a long one along its longest axis (arXiv 2508.12313), another one into two
smaller ones. In a later frame, `plan_additions` (Sun et al. 2024): parents stay unchanged, because
their tracks must not jump and the few remaining steps could not repair them; births are small and
faint, and gain opacity or are pruned. Births that are not from splits along an axis are drawn from
the density of their parents.

Parents are the Gaussians with the largest densification scores (see `method.error_per_gaussian`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.fit.initialise import in_empty_space

# float32 has no opacity closer to 1.
_MAX_OPACITY = 1 - 1e-6
# Opacity of a birth in a later frame: low, because unnecessary births are then pruned soon.
_BIRTH_OPACITY = 0.1
# Logarithm of the factor by which both parts of a large Gaussian that is not long, and a birth in a
# later frame, are smaller than their parent (3DGS).
_LOG_SHRINK = -float(np.log(1.6))
# Least ratio of the longest scale to the second one of a long Gaussian.
_LONG = 2.0
# Distance of the two parts of a split Gaussian from its mean, in scales along its longest axis
# (arXiv 2508.12313).
_SPLIT_SHIFT = 1.35
# Factor on the scale of both parts along the longest axis (arXiv 2508.12313).
_SPLIT_LONGEST = 0.55
# Factor on their other two scales.
_SPLIT_OTHERS = 0.893
# Factor on their opacity.
_SPLIT_OPACITY = 0.6


@dataclass(frozen=True)
class DensityPlan:
    """One round of density control; see the module for the order of the M Gaussians."""

    parent: np.ndarray  #: int [M], index among the N Gaussians before.
    source: np.ndarray  #: int [M], the same for survivors, -1 for births.
    #: Changes added to raw attributes, by name, [M, ...]; other attributes stay unchanged.
    edits: dict[str, np.ndarray] = field(default_factory=dict)


def plan_growth(
    gaussians: Gaussians,
    scores: np.ndarray,
    births: int,
    extent: float,
    config: DensityConfig,
    rng: np.random.Generator,
    cameras: Sequence[Camera] = (),
) -> DensityPlan:
    """Return the plan of a round in the first frame: which Gaussians are pruned, cloned and split.

    Gaussians in the empty space before the cameras are pruned; a birth there takes the mean of its
    parent instead.

    Args:
        gaussians: N Gaussians.
        scores: their densification scores [N].
        births: largest number of births.
        extent: of the scene, world units.
        config: thresholds.
        rng: draws the means of the births.
        cameras: the training cameras.
    """
    means = np.asarray(gaussians.means)
    opacities = np.asarray(gaussians.opacities)
    visible = (opacities >= config.min_opacity) & ~in_empty_space(cameras, means)
    survivors = _survivors(visible)
    parents = _parents(survivors, scores, births, 0)
    parent = np.concatenate([survivors, parents])
    is_parent = np.isin(parent, parents)
    scales = np.asarray(gaussians.scales)[parent]
    _, second, longest = np.sort(scales, axis=1).T
    is_large = is_parent & (longest > config.split_scale * extent)
    is_halved = is_large & (longest > _LONG * second)
    is_shrunk = is_large & ~is_halved
    opacity = np.minimum(opacities[parent], _MAX_OPACITY)
    new_opacity = np.where(is_halved, _SPLIT_OPACITY * opacity, 1 - np.sqrt(1 - opacity))
    change = _logit(new_opacity) - np.asarray(gaussians.logit_opacities)[parent]
    logits = np.where(is_parent & ~is_shrunk, change, 0)
    plan = _plan(gaussians, survivors, parents, np.where(is_shrunk, _LOG_SHRINK, 0), logits, rng)
    # Both parts of a split Gaussian lie along its longest axis.
    is_longest = np.eye(3, dtype=bool)[scales.argmax(axis=1)]
    side = np.where(plan.source < 0, _SPLIT_SHIFT, -_SPLIT_SHIFT)[:, None]
    shift = plan.edits["means"]
    shift[is_halved] = _rotated(np.asarray(gaussians.quats)[parent], side * is_longest * scales)[
        is_halved
    ]
    plan.edits["log_scales"][is_halved] = np.log(
        np.where(is_longest, _SPLIT_LONGEST, _SPLIT_OTHERS)
    )[is_halved]
    shift[in_empty_space(cameras, means[parent] + shift)] = 0
    return plan


def plan_additions(
    gaussians: Gaussians,
    scores: np.ndarray,
    config: DensityConfig,
    rng: np.random.Generator,
    num_static: int = 0,
) -> DensityPlan:
    """Return the plan of a round in a later frame: which Gaussians are pruned, and where small
    faint ones are added.

    Args:
        gaussians: N active Gaussians.
        scores: their densification scores [N].
        config: thresholds.
        rng: draws the means of the births.
        num_static: number of the other Gaussians, which stay unchanged.
    """
    survivors = _survivors(np.asarray(gaussians.opacities) >= config.min_opacity)
    # At the limit, none is pruned for it: a later frame draws a part of the pixels, in which it
    # cannot see what a Gaussian contributes elsewhere.
    room = max(config.max_gaussians - num_static - len(survivors), 0)
    births = min(round(config.births * (len(gaussians) + num_static)), room)
    parents = _parents(survivors, scores, births, config.min_error)
    is_birth = np.arange(len(survivors) + len(parents)) >= len(survivors)
    logits = np.asarray(gaussians.logit_opacities)[np.concatenate([survivors, parents])]
    fainter = np.where(is_birth, _logit(_BIRTH_OPACITY) - logits, 0)
    return _plan(gaussians, survivors, parents, np.where(is_birth, _LOG_SHRINK, 0), fainter, rng)


def _survivors(visible: np.ndarray) -> np.ndarray:
    """Return the indices of the `visible` [N], or of all if none is."""
    # Without any Gaussian, the scene could not recover.
    return np.flatnonzero(visible) if visible.any() else np.arange(len(visible))


def _parents(
    survivors: np.ndarray, scores: np.ndarray, births: int, min_error: float
) -> np.ndarray:
    """Return the indices of those survivors that have the largest error."""
    candidates = survivors[scores[survivors] > min_error]
    return np.sort(candidates[np.argsort(-scores[candidates], kind="stable")][:births])


def _plan(
    gaussians: Gaussians,
    survivors: np.ndarray,
    parents: np.ndarray,
    log_scale: np.ndarray,
    logit_opacity: np.ndarray,
    rng: np.random.Generator,
) -> DensityPlan:
    """Return the plan that adds `log_scale` and `logit_opacity` [M] and draws the means of the
    births.
    """
    parent = np.concatenate([survivors, parents])
    source = np.concatenate([survivors, np.full(len(parents), -1)])
    shift = np.zeros((len(parent), 3))
    # A random displacement from the density of each parent.
    scales = np.asarray(gaussians.scales)[parents]
    displacement = rng.standard_normal(scales.shape) * scales
    shift[len(survivors) :] = _rotated(np.asarray(gaussians.quats)[parents], displacement)
    edits = {
        "means": shift,
        "log_scales": np.repeat(log_scale[:, None], 3, axis=1),
        "logit_opacities": logit_opacity,
    }
    return DensityPlan(
        parent, source, {name: edit.astype(np.float32) for name, edit in edits.items()}
    )


def _rotated(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the vectors [M, 3], rotated by quaternions [M, 4] of any length (Rodrigues)."""
    w = quats[:, :1]
    v = quats[:, 1:]
    t = 2 * np.cross(v, vectors)
    square = np.maximum((quats**2).sum(axis=1, keepdims=True), 1e-30)
    return vectors + (w * t + np.cross(v, t)) / square


def _logit(x: np.ndarray | float) -> np.ndarray:
    return np.log(x) - np.log1p(-np.asarray(x, float))


def apply_plan(gaussians: Gaussians, plan: DensityPlan) -> Gaussians:
    """Return the M Gaussians of a plan."""
    parents = gaussians.select(plan.parent)
    columns = parents.numpy()
    return replace(parents, **{name: columns[name] + edit for name, edit in plan.edits.items()})
