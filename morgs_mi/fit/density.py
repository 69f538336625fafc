"""Density control: which Gaussians are cloned, split or pruned, and what the optimiser remembers of them.

N Gaussians become M. `parent` [M] says which of the N each one is or was made from; `source` [M] is the same for
survivors, who come first in ascending order, and -1 for births, who come after them. A survivor keeps its centre,
so that its track does not jump: what is born is drawn from the parent's own density, and

    split (parent wider than `split_scale` of the scene): both shrink by 1.6, as in 3DGS (Kerbl et al. 2023);
    clone (all others): both get opacity 1 - sqrt(1 - o), so that together they cover what one did (Bulo et al. 2024).

Who is in need is told by the pictures: E_i = sum_x w_i(x) |I(x) - I*(x)|, the error that a Gaussian answers for
with its blend weights w_i (the same paper), of that view where it is largest; and W_i = sum_x w_i(x), the pixels that
it covers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import drjit as dr
import numpy as np
from drjit.opt import Adam

from morgs_mi.capture.camera import Camera
from morgs_mi.fit.config import DensityConfig
from morgs_mi.fit.losses import Target
from morgs_mi.fit.optimise import replace_parameter
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.render.backproject import backproject
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = ["Need", "Plan", "apply_plan", "find_need", "plan_density", "regrow"]

_SHRINK = float(np.log(1.6))


@dataclass(frozen=True)
class Need:
    """What the pictures say of N Gaussians.

    Attributes:
        error: E [N], of the view where it is largest.
        weight: W [N], pixels, of the view where it is largest; 0 for who is seen nowhere.
    """

    error: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Plan:
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


def find_need(gaussians: Gaussians, cameras: Sequence[Camera], targets: Sequence[Target], render: RenderConfig) -> Need:
    """Render every view, and give each Gaussian its share of the errors and of the pixels (E and W)."""
    gaussians = gaussians.detached()
    error, weight = np.zeros((2, len(gaussians)), np.float32)
    for camera, target in zip(cameras, targets, strict=True):
        image = np.asarray(rasterize(gaussians, camera, ("color",), config=render).color)
        if target.weight is not None:
            image = image * np.asarray(target.weight)
        wrong = np.abs(image - np.asarray(target.pixels).reshape(target.shape)).mean(axis=2)
        sums = backproject(gaussians, camera, np.stack([wrong, np.ones_like(wrong)], axis=2), render)
        error, weight = np.maximum(error, sums[:, 0]), np.maximum(weight, sums[:, 1])
    return Need(error, weight)


def plan_density(
    gaussians: Gaussians, need: Need, births: int, extent: float, config: DensityConfig, rng: np.random.Generator
) -> Plan:
    """Decide who dies and who is cloned or split.

    Those fainter than `min_opacity` die. Of the rest, those with the largest error become parents, as many as
    `births` and `max_gaussians` allow; nobody is a parent whose error is below `min_error`.

    Args:
        gaussians: N of them.
        need: of the same.
        births: at most so many.
        extent: of the scene, world units.
        config: thresholds.
        rng: draws where the births lie.
    """
    columns = gaussians.numpy()
    opacity, scales = np.asarray(gaussians.opacities), np.exp(columns["log_scales"])
    survivors = np.flatnonzero(opacity >= config.min_opacity)
    if not len(survivors):  # an empty scene could never come back
        survivors = np.arange(len(opacity))
    room = max(config.max_gaussians - len(survivors), 0)
    candidates = survivors[need.error[survivors] > config.min_error]
    order = np.argsort(-need.error[candidates], kind="stable")
    chosen = np.sort(candidates[order[: min(births, room)]])

    parent = np.concatenate([survivors, chosen])
    source = np.concatenate([survivors, np.full(len(chosen), -1)])
    touched = np.isin(parent, chosen)
    wide = touched & (scales[parent].max(axis=1) > config.split_scale * extent)
    shift = np.zeros((len(parent), 3), np.float32)
    shift[len(survivors) :] = _draw(columns["quats"][chosen], scales[chosen], rng)
    clone = touched & ~wide
    o = np.clip(opacity[parent].astype(float), 1e-6, 1 - 1e-6)
    half = 1 - np.sqrt(1 - o)
    fainter = np.where(clone, np.log(half / (1 - half)) - np.log(o / (1 - o)), 0)
    edits = {
        "means": shift,
        "log_scales": np.repeat(np.where(wide, -_SHRINK, 0)[:, None], 3, axis=1).astype(np.float32),
        "logit_opacities": fainter.astype(np.float32),
    }
    return Plan(parent, source, edits)


def _draw(quats: np.ndarray, scales: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return one displacement [M, 3] from each Gaussian's own density."""
    w, v = quats[:, :1], quats[:, 1:]
    n = rng.standard_normal(scales.shape) * scales
    # Rodrigues: the rotation of n by a quaternion of any length
    t = 2 * np.cross(v, n)
    square = np.maximum((quats**2).sum(axis=1, keepdims=True), 1e-30)
    return (n + (w * t + np.cross(v, t)) / square).astype(np.float32)


def apply_plan(gaussians: Gaussians, plan: Plan) -> Gaussians:
    """Return the M Gaussians of a plan."""
    chosen = gaussians.select(plan.parent)
    columns = chosen.numpy()
    return replace(chosen, **{name: columns[name] + edit for name, edit in plan.edits.items()})


def regrow(optimizer: Adam, plan: Plan, edits: Mapping[str, np.ndarray] | None = None) -> None:
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
