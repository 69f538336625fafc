"""Density control: who is cloned, split, added or pruned, and what the optimiser remembers of them.

N Gaussians become M. `parent` [M] says which of the N each one is or was made from; `source` [M] is the same for
survivors, who come first in ascending order, and -1 for births, who come after them. Survivors keep their centres,
so that their tracks do not jump; what is born is drawn from its parent's own density.

In the first frame, `plan_growth` (Kerbl et al. 2023): a wide parent is split, both shrink by 1.6; a narrow one is
cloned, both get opacity 1 - sqrt(1 - o), so that together they cover what one did (Bulo et al. 2024).
In a later frame, `plan_additions` (Sun et al. 2024): parents stay as they are, so that nothing is spoilt that the
few steps left could not mend; what is born is faint and small, and earns its opacity or dies.

Who is in need is told by the pictures: E_i = sum_x w_i(x) e(x), the error that a Gaussian answers for with its blend
weights w_i (Bulo et al. 2024), of that view where it is largest, and W_i = sum_x w_i(x), the pixels that it covers.
While a picture is not yet fitted, e = |I - I*|; in a later frame what exceeds thrice its median over the picture, so
that noise asks for nobody.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import drjit as dr
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.config import DensityConfig
from morgs_mi.fit.optimise import replace_parameter
from morgs_mi.losses.attribution import DensificationScores

__all__ = [
    "DensityPlan",
    "apply_plan",
    "plan_additions",
    "plan_growth",
    "resize_optimizer",
]

_SHRINK = float(np.log(1.6))
# float32 knows no opacity closer to 1.
_MOST_OPAQUE = 1 - 1e-6


@dataclass(frozen=True)
class DensityPlan:
    """Who is there after a step of density control; see the module for the order.

    Attributes:
        parent: int [M], index into the N before.
        source: int [M], the same for survivors, -1 for births.
        edits: what is added to raw attributes, by name, [M, ...]; attributes that stay are left out.
    """

    parent: np.ndarray
    source: np.ndarray
    edits: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def num_births(self) -> int:
        """How many were born."""
        return int((self.source < 0).sum())

    @property
    def num_survivors(self) -> int:
        """How many live on."""
        return len(self.source) - self.num_births


def plan_growth(
    gaussians: Gaussians,
    need: DensificationScores,
    births: int,
    limit: int,
    extent: float,
    config: DensityConfig,
    rng: np.random.Generator,
) -> DensityPlan:
    """Decide who dies and who is cloned or split in the first frame.

    Args:
        gaussians: N of them.
        need: of the same.
        births: at most so many.
        limit: how many there may be.
        extent: of the scene, world units.
        config: thresholds.
        rng: draws where the births lie.
    """
    survivors, chosen = _choose(gaussians, need, births, limit, 0, config)
    parent, opacity = np.concatenate([survivors, chosen]), np.asarray(gaussians.opacities)
    touched, scales = np.isin(parent, chosen), np.asarray(gaussians.scales).max(axis=1)[parent]
    wide = touched & (scales > config.split_scale * extent)
    half = 1 - np.sqrt(1 - np.minimum(opacity[parent], _MOST_OPAQUE))
    fainter = np.where(touched & ~wide, _logit(half) - np.asarray(gaussians.logit_opacities)[parent], 0)
    return _plan(gaussians, survivors, chosen, np.where(wide, -_SHRINK, 0), fainter, rng)


def plan_additions(
    gaussians: Gaussians,
    need: DensificationScores,
    config: DensityConfig,
    rng: np.random.Generator,
    num_others: int = 0,
) -> DensityPlan:
    """Decide who dies and beside whom a faint Gaussian is added in a later frame.

    Args:
        gaussians: N of them.
        need: of the same.
        config: thresholds.
        rng: draws where the births lie.
        num_others: how many there are besides, who are not to be touched.
    """
    births, limit = round(config.births * (len(gaussians) + num_others)), max(config.max_gaussians - num_others, 0)
    survivors, chosen = _choose(gaussians, need, births, limit, config.min_error, config)
    born = np.arange(len(survivors) + len(chosen)) >= len(survivors)
    logits = np.asarray(gaussians.logit_opacities)[np.concatenate([survivors, chosen])]
    fainter = np.where(born, _logit(config.birth_opacity) - logits, 0)
    return _plan(gaussians, survivors, chosen, np.where(born, -_SHRINK, 0), fainter, rng)


def _choose(
    gaussians: Gaussians, need: DensificationScores, births: int, limit: int, least_error: float, config: DensityConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Return who lives on, and who of them becomes a parent: those with the largest error.

    Who is fainter than `min_opacity` dies, and so does who covers least where births would exceed `limit`.
    """
    alive = np.asarray(gaussians.opacities) >= config.min_opacity
    survivors = np.flatnonzero(alive) if alive.any() else np.arange(len(alive))  # no scene could come back from none
    needy = survivors[need.error[survivors] > least_error]
    chosen = needy[np.argsort(-need.error[needy], kind="stable")][:births]
    excess = min(max(len(survivors) + len(chosen) - limit, 0), len(chosen))
    expendable = np.setdiff1d(survivors, chosen)
    least = expendable[np.argsort(need.weight[expendable], kind="stable")][:excess]
    return np.setdiff1d(survivors, least), np.sort(chosen[: len(chosen) - (excess - len(least))])


def _plan(
    gaussians: Gaussians,
    survivors: np.ndarray,
    chosen: np.ndarray,
    log_scale: np.ndarray,
    logit_opacity: np.ndarray,
    rng: np.random.Generator,
) -> DensityPlan:
    """Return the plan that adds `log_scale` and `logit_opacity` [M] and draws the places of the births."""
    parent, source = np.concatenate([survivors, chosen]), np.concatenate([survivors, np.full(len(chosen), -1)])
    shift = np.zeros((len(parent), 3))
    shift[len(survivors) :] = _draw(np.asarray(gaussians.quats)[chosen], np.asarray(gaussians.scales)[chosen], rng)
    edits = {"means": shift, "log_scales": np.repeat(log_scale[:, None], 3, axis=1), "logit_opacities": logit_opacity}
    return DensityPlan(parent, source, {name: edit.astype(np.float32) for name, edit in edits.items()})


def _draw(quats: np.ndarray, scales: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return one displacement [M, 3] from each Gaussian's own density."""
    w, v = quats[:, :1], quats[:, 1:]
    n = rng.standard_normal(scales.shape) * scales
    # Rodrigues: the rotation of n by a quaternion of any length
    t = 2 * np.cross(v, n)
    square = np.maximum((quats**2).sum(axis=1, keepdims=True), 1e-30)
    return n + (w * t + np.cross(v, t)) / square


def _logit(x: np.ndarray | float) -> np.ndarray:
    return np.log(x) - np.log1p(-np.asarray(x, float))


def apply_plan(gaussians: Gaussians, plan: DensityPlan) -> Gaussians:
    """Return the M Gaussians of a plan."""
    chosen = gaussians.select(plan.parent)
    columns = chosen.numpy()
    return replace(chosen, **{name: columns[name] + edit for name, edit in plan.edits.items()})


def resize_optimizer(optimizer: Adam, plan: DensityPlan, edits: Mapping[str, np.ndarray] | None = None) -> None:
    """Give an optimiser's parameters [N, ...] the rows of a plan [M, ...]; moments go along, those of births are 0.

    Args:
        optimizer: holds tensors of N rows; its learning rates and its count of steps stay.
        plan: who is there.
        edits: what is added to the parameters, by name.
    """
    born = plan.source < 0

    def carry(moment: np.ndarray) -> np.ndarray:
        rows = moment[plan.parent]
        rows[born] = 0
        return rows

    for name in list(optimizer):
        value = np.asarray(dr.detach(optimizer[name]))[plan.parent]
        replace_parameter(optimizer, name, value + edits[name] if edits and name in edits else value, carry)
