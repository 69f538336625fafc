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
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le
from drjit.opt import Adam

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import BRIGHTEST, unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import scene_extent
from morgs_mi.core.types import Arrays
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.fit.initialise import in_empty_space
from morgs_mi.fit.optimise import select_rows, values_of
from morgs_mi.method.error_per_gaussian import densification_scores
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.platform.checks import (
    LARGEST,
    check_mask,
    check_number,
    check_type,
    errors_at,
    few,
    numbers,
    require,
)
from morgs_mi.platform.config import check_value, config_or_default
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.render_config import RenderConfig

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


_Births = Annotated[int, Ge(0), Le(100_000_000)]


@dataclass(frozen=True)
class DensityPlan:
    """One round of density control; see the module for the order of the M Gaussians."""

    parent: np.ndarray  #: int [M], index among the N Gaussians before.
    source: np.ndarray  #: int [M], the same for survivors, -1 for births.
    #: Changes added to raw attributes, by name, [M, ...]; other attributes stay unchanged.
    edits: Arrays = field(default_factory=dict)


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
    survivors = _survivors((opacities >= config.min_opacity) & ~in_empty_space(cameras, means))
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


class DensityControl:
    """Clones, splits and prunes Gaussians while they are optimised (see `density`).

    The optimiser, `mi.ad.Adam` or `drjit.opt.Adam`, has raw attributes by their names in
    `Gaussians.parameters`, and may have others with a row for each Gaussian.

    Args:
        cameras: training views, `Camera`s or `perspective` sensors; Gaussians in the empty space
            before them are pruned.
        config: thresholds.
        extent: of the scene, world units; None: of the cameras.
        seed: of the means of births, or a generator.
        render: cut-offs of the renderer.

    Attributes:
        extent: of the scene, world units.
        scores: densification scores [N] since the last step, by which parents are chosen; may be
            set, such as to gradients of projected means (see `render_view`). None: none yet.

    Raises:
        ValueError: neither cameras nor an extent are given, or an argument is of another type or
            out of range.

    Example:
        >>> optimizer = mi.ad.Adam(lr=0.01, params=gaussians.parameters())
        >>> control = morgs_mi.DensityControl(cameras)
        >>> ...  # some steps
        >>> for camera, image in zip(cameras, images):
        ...     control.observe(optimizer, camera, image)
        >>> plan = control.step(optimizer, births=1000)
    """

    def __init__(
        self,
        cameras: Sequence[Any] = (),
        config: DensityConfig | None = None,
        extent: float | None = None,
        seed: int | np.random.Generator = 0,
        render: RenderConfig | None = None,
    ) -> None:
        check_type("DensityControl()", "cameras", cameras, Sequence, "pass a list")
        self._cameras = [Camera.of(camera) for camera in cameras]
        require(
            cameras or extent is not None,
            "DensityControl()",
            "`cameras` or `extent` must be given",
            "neither",
            "pass the training views",
        )
        self._config = config_or_default("DensityControl()", config, DensityConfig())
        self.extent = scene_extent(self._cameras) if extent is None else extent
        check_number("DensityControl()", "extent", self.extent, f"(0, {LARGEST:g}]")
        with errors_at("DensityControl(), `seed`"):
            self._rng = np.random.default_rng(seed)
        self._render = config_or_default("DensityControl()", render, RenderConfig(), "render")
        self.scores: np.ndarray | None = None

    def observe(
        self, optimizer: Adam, camera: Any, image: np.ndarray, mask: np.ndarray | None = None
    ) -> None:
        """Render a view, and attribute its error to the Gaussians that cause it.

        Args:
            optimizer: holds the Gaussians.
            camera: a `Camera` or a `perspective` sensor.
            image: the recorded image [H, W, 3], sRGB-encoded: uint8, or floats with 1 for white.
            mask: valid pixels [H, W], bool; None: all are.

        Raises:
            ValueError: the image or the mask is not of the camera's size, or has other values.
        """
        place = "DensityControl.observe()"
        view = ActiveView(Camera.of(camera), self._render)
        width, height = view.camera.size
        image = numbers(place, "image", image, height, width, 3)
        is_image = (np.abs(unit_values(image)) <= BRIGHTEST).all()
        requirement = f"`image` must have numbers from {-BRIGHTEST:g} to {BRIGHTEST:g}, 1 for white"
        require(is_image, place, requirement, "others", "mask such pixels, and set them to 0")
        if mask is not None:
            check_mask(place, mask, height, width)
        gaussians = Gaussians.from_parameters(values_of(optimizer))
        self.observe_views(gaussians, [ObservedView.of(view, Target(image, mask))])

    def observe_views(self, gaussians: Gaussians, views: Sequence[ObservedView]) -> None:
        """Render views and attribute their errors to N Gaussians, see `densification_scores`."""
        scores = densification_scores(gaussians, views)
        self.scores = scores if self.scores is None else np.maximum(self.scores, scores)

    def step(self, optimizer: Adam, births: int) -> DensityPlan:
        """Prune what is faint, and clone or split the Gaussians with the largest scores.

        Survivors keep their moments of Adam; births have moments of 0.

        Args:
            optimizer: holds the Gaussians, whose number may change.
            births: largest number of births, 0 to 100 million.

        Returns:
            What was done, as indices of the Gaussians before.

        Raises:
            ValueError: the optimiser is of another kind, an attribute is missing, the number of
                births is out of range, or the scores are of another number of Gaussians or not
                finite.
        """
        check_type("DensityControl.step()", "optimizer", optimizer, Adam, "pass mi.ad.Adam")
        check_value("DensityControl.step()", "births", births, _Births)
        gaussians = Gaussians.from_parameters(values_of(optimizer))
        plan = plan_growth(
            gaussians,
            self._taken_scores(len(gaussians)),
            births,
            self.extent,
            self._config,
            self._rng,
            self._cameras,
        )
        del gaussians  # tensors that the next steps would keep in memory
        select_rows(optimizer, plan.parent, plan.source < 0, plan.edits)
        return plan

    def step_later(self, optimizer: Adam, gaussians: Gaussians, num_static: int) -> DensityPlan:
        """Prune what is faint, and add small faint Gaussians where the scores are largest, as a
        later frame does; the optimiser has a residual, which births share with their parents.

        Args:
            optimizer: holds the residual.
            gaussians: N active Gaussians after it.
            num_static: number of the other Gaussians.
        """
        plan = plan_additions(
            gaussians, self._taken_scores(len(gaussians)), self._config, self._rng, num_static
        )
        select_rows(optimizer, plan.parent, plan.source < 0)
        return plan

    def _taken_scores(self, count: int) -> np.ndarray:
        """Return the scores, which are used once."""
        place = "DensityControl.step()"
        scores = numbers(place, "scores", np.zeros(count) if self.scores is None else self.scores)
        require(
            scores.shape == (count,),
            place,
            f"`scores` must be [{count}], one for each Gaussian",
            list(scores.shape),
            "observe the Gaussians that the optimiser has now",
        )
        others = scores[~np.isfinite(scores)]
        require(not len(others), place, "`scores` must be finite", few(others), "set other scores")
        self.scores = None
        return scores


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
