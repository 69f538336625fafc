"""Views of the first and of later frames as arguments of a recorded step, and their losses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.attributes import BY_NAME, sigmoid
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Float, Jit, Tensors, UInt32
from morgs_mi.fit.frozen_step import Draw, Inputs, Losses, RecordedSteps, StepView, room_for
from morgs_mi.method.error_per_gaussian import attribution
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import (
    SQUARED_ERROR,
    ObjectiveConfig,
    Prediction,
    active_terms,
    channels_of,
    losses_of,
    recon_loss,
    weights_of,
)
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.residual import apply_residual
from morgs_mi.method.ssim import Comparison
from morgs_mi.method.ssim_layout import RUN, Lanes, Planes
from morgs_mi.render.active_view import ActiveView, StaticSplats
from morgs_mi.render.backend import elements, sections
from morgs_mi.render.channels import channel_sizes
from morgs_mi.render.padded_region import (
    Packing,
    PaddedRegion,
    PaddedSizes,
    filled,
    packed,
    padded,
    padded_arrays,
)
from morgs_mi.render.projection import Splats, TracedCamera, intrinsics_of, project
from morgs_mi.render.rasterize import Output, draw
from morgs_mi.render.region import Region, full_view
from morgs_mi.render.render_config import RenderConfig

# Row past the last of a run of windows that walks no row.
_NO_ROWS = -20
# Logit of an opacity that no cut-off of the renderer lets pass.
_INVISIBLE = -30.0
# Largest opacity, which has a finite logit.
_MOST = 0.999
# Number of active Gaussians below which there is room for as many: they cost less than another
# recording.
_LEAST_ACTIVE = 400


@dataclass(frozen=True)
class LaterLosses:
    """Losses of a later frame in a view with some observations."""

    packing: Packing  #: Of the numbers of a view.
    observed: tuple[tuple[str, tuple[int, ...]], ...]  #: Shapes of the observations by name.
    objective: ObjectiveConfig  #: Its terms and weights.
    motion: MotionConfig  #: Gates of the residual.
    render: RenderConfig  #: Cut-offs.
    num_static: int  #: Static splats that it has room for.

    def __call__(
        self,
        parameters: Tensors,
        view: Inputs,
        shared: Inputs,
        sizes: PaddedSizes,
        is_scored: bool,
    ) -> Losses:
        """Return the losses of the Gaussians after the residual."""
        size = next(iter(parameters.values())).shape[0]
        previous = Gaussians(
            **{
                name: mi.TensorXf(values, (size, *_row_shape(name, dr.width(values) // size)))
                for name, values in shared["previous"].items()
            }
        )
        gaussians = apply_residual(previous, parameters, self.motion)
        words = self.packing.unpacked(view["words"])
        region = PaddedRegion(sizes, words)
        observed = {
            "target": _comparison(region, words, view),
            **{name: mi.TensorXf(view["observed"][name], shape) for name, shape in self.observed},
        }
        channels = channels_of(observed, self.objective)
        camera = TracedCamera.of_arrays(view["pose"], words["intrinsics"])
        features = None
        if is_scored:
            features = dr.zeros(mi.TensorXf, (size, 1))
            dr.enable_grad(features)
            channels = (*channels, "features")
        splats = project(gaussians, camera, channels, self.render, None, features)
        is_gaussian = dr.arange(mi.UInt32, len(splats)) < shared["count"]
        splats = replace(splats, valid=splats.valid & is_gaussian, finite=None)
        dr.schedule(splats)
        detached = tuple(name for name in channels if name != "color")
        output = Output(channels, detached, self.render, region.shape(0)[:-1])
        static = Splats(**view["static"])
        first = elements(view["static_range"], mi.UInt32(0))
        count = elements(view["static_range"], mi.UInt32(1))
        with dr.suspend_grad():
            drawn = splats.followed_by(static, first, count, self.num_static)
        image, lists = draw(output, splats, drawn, region, view.get("background"))
        prediction = Prediction(
            image,
            parameters,
            region,
            elements(words["numbers"], mi.UInt32(3)),
            shared["offset_share"],
            1.0,
            gaussians,
            previous,
        )
        losses = losses_of(prediction, observed, self.objective)
        losses = {**losses, SQUARED_ERROR: observed["target"].mse}
        if features is None:
            return Losses(losses, lists.total)
        term = attribution(image, *observed["target"].on_region)
        return Losses(losses, lists.total, (features, term))


@dataclass(frozen=True)
class FirstLosses:
    """Losses of the first frame in a view."""

    packing: Packing  #: Of the numbers of a view.
    dssim_weight: float  #: lambda of eq. 2.
    dropout: float  #: Probability with which a step leaves out a Gaussian.
    render: RenderConfig  #: Cut-offs.

    def __call__(
        self, parameters: Tensors, view: Inputs, shared: Inputs, sizes: PaddedSizes, _: bool
    ) -> Losses:
        """Return L_recon of the Gaussians that the step does not leave out."""
        gaussians = Gaussians.from_parameters(parameters)
        if self.dropout:
            gaussians = with_dropout(gaussians, self.dropout, view["is_kept"])
        words = self.packing.unpacked(view["words"])
        camera = TracedCamera.of_arrays(view["pose"], words["intrinsics"])
        splats = project(gaussians, camera, ("color",), self.render)
        splats = replace(splats, finite=None)
        dr.schedule(splats)
        region = PaddedRegion(sizes, words)
        output = Output(("color",), (), self.render, region.shape(0)[:-1])
        image, lists = draw(output, splats, splats, region, view.get("background"))
        target = _comparison(region, words, view)
        loss = recon_loss(image.color, target, self.dssim_weight)
        return Losses({"recon": loss, SQUARED_ERROR: target.mse}, lists.total)


def with_dropout(gaussians: Gaussians, probability: float, is_kept: UInt32) -> Gaussians:
    """Return Gaussians of which some are invisible, and the others more opaque, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each was left out, below 1.
        is_kept: 0 where it was [N].
    """
    factor = opaque(mi.Float, 1 / (1 - probability))
    opacity = dr.minimum(sigmoid(gaussians.logit_opacities.array) * factor, _MOST)
    logits = dr.select(is_kept != 0, dr.log(opacity) - dr.log(1 - opacity), _INVISIBLE)
    return replace(gaussians, logit_opacities=mi.TensorXf(logits))


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A view as a recorded step draws and compares it."""

    camera: Camera  #: The view.
    region: Region  #: The blocks that are drawn.
    on: Comparison  #: The target there.
    #: Encoded colour [3] behind all Gaussians; None: black.
    background: tuple[float, float, float] | None

    @classmethod
    def of(cls, view: ObservedView) -> ComparedView:
        """Return an active view, or a whole one, with its image."""
        region = view.region or full_view(*view.grid.size, view.grid.block, 1, mi.variant())
        on = view.target.comparison(None if region.whole else region)
        return cls(view.camera, region, on, view.config.background)


class SharedSizes:
    """Sizes that the arrays of all views of a frame fit in: views whose images have the same size
    have the same sizes.

    Args:
        views: V >= 1 views.
    """

    def __init__(self, views: Sequence[ComparedView]) -> None:
        regions = [view.region for view in views]
        parts = [region.num_blocks for region in regions if not region.whole]
        self._blocks = room_for("blocks", max(parts)) if parts else 0
        self._tiles = room_for("tiles", max(region.num_tiles for region in regions) + 1)
        self._lanes = {
            name: room_for(name, max(len(view.on.runs[name]["end"]) for view in views))
            for name in views[0].on.runs
        }
        # Blocks that fill up a region lie outside the view, where a background must not be seen.
        has_background = any(view.background is not None for view in views)
        self._is_partial = has_background or any(region.weights is not None for region in regions)

    def sizes(self, region: Region) -> PaddedSizes:
        """Return the sizes of a view's region, without a capacity."""
        blocks = region.num_blocks if region.whole else self._blocks
        is_partial = self._is_partial and not region.whole
        return PaddedSizes(region.grid, region.whole, blocks, self._tiles, is_partial, capacity=0)

    def arrays(self, view: ComparedView) -> tuple[Packing, dict[str, Any]]:
        """Return the arrays of a view: its camera, region and target, and the places of most of
        them in ``words``.
        """
        region = view.region
        camera = view.camera
        on = view.on
        numbers = padded_arrays(region, self.sizes(region))
        for name, runs in on.runs.items():
            for key, values in runs.items():  # what fills them up walks no row
                fill = _NO_ROWS if key == "end" else 0
                numbers[f"{name} {key}"] = filled(values, self._lanes[name], fill)
        shares = (on.valid_share, on.scale, 1 / (camera.width * camera.height))
        numbers["numbers"] = np.array([on.count, *shares], np.float32)
        numbers["height"] = np.array([on.height], np.int32)
        numbers["intrinsics"] = np.array(intrinsics_of(camera), np.float32)
        packing, words = packed(numbers)
        arrays = {"words": words, "pose": from_numpy(mi.Float64, camera.viewmat[:3].ravel())}
        arrays |= {name: getattr(on, name) for name in ("pixels", "mean", "variance")}
        if view.background is not None:
            arrays["background"] = from_numpy(mi.Float, np.array(view.background, np.float32))
        return packing, arrays if on.weight is None else {**arrays, "weight": on.weight}


class LaterSteps:
    """Steps of a later frame as recordings.

    Args:
        views: active views with their images and observations, by index.
        parameters: of the residual.
        objective: terms and weights.
        motion: which parts of the method are on.
    """

    def __init__(
        self,
        views: Mapping[int, ObservedView],
        parameters: Tensors,
        objective: ObjectiveConfig,
        motion: MotionConfig,
    ) -> None:
        self._objective = objective
        self._motion = motion
        self._static = _StaticArguments([view.static_splats for view in views.values()])
        compared_views = {v: ComparedView.of(view) for v, view in views.items()}
        shared_sizes = SharedSizes([*compared_views.values()])
        self._views = {
            v: self._step_view(view, compared_views[v], shared_sizes, parameters)
            for v, view in views.items()
        }

    def _step_view(
        self,
        view: ObservedView,
        compared_view: ComparedView,
        shared_sizes: SharedSizes,
        parameters: Tensors,
    ) -> StepView:
        """Return an active view as arguments of its steps."""
        region = compared_view.region
        sizes = shared_sizes.sizes(region)
        packing, arrays = shared_sizes.arrays(compared_view)
        images = {name: view.crop(array) for name, array in view.observed.items()}
        shapes = {
            name: image.shape if region.whole else (sizes.num_blocks, *image.shape[1:])
            for name, image in images.items()
        }
        arrays["observed"] = {
            name: from_numpy(mi.Float, filled(image.ravel(), int(np.prod(shapes[name]))))
            for name, image in images.items()
        }
        observed = {"target": None, **images}
        channels = channels_of(observed, self._objective)
        arrays |= self._static.of(view.static_splats, channels)
        losses = LaterLosses(
            packing,
            tuple(shapes.items()),
            self._objective,
            self._motion,
            view.config,
            self._static.most,
        )
        terms = active_terms(observed, parameters, self._objective)
        names = (*(term.name for term in terms), SQUARED_ERROR)
        return StepView(losses, names, sizes, arrays)

    def of(self, previous: Gaussians, num_gaussians: int, extent: float) -> RecordedSteps:
        """Return the steps of some active Gaussians.

        Args:
            previous: N active Gaussians of the previous frame.
            num_gaussians: of the whole scene.
            extent: of the scene, world units.
        """
        count = len(previous)
        size = room_for("active Gaussians", max(count, _LEAST_ACTIVE))
        shared = {
            "previous": {
                name: padded(value.array, size * int(np.prod(value.shape[1:])))
                for name, value in previous.items().items()
                if name not in ("motion", "offset")  # the residual replaces both
            },
            "count": from_numpy(mi.UInt32, [count]),
            "offset_share": from_numpy(mi.Float, [1 / (num_gaussians * extent)]),
        }
        dr.make_opaque(shared)
        weights = weights_of(self._objective)
        num_splats = size + self._static.most
        return RecordedSteps(self._views, shared, weights, num_splats, (count, size))


class FirstSteps:
    """Steps of the first frame as recordings.

    Args:
        views: V >= 1 whole views with their images.
        dssim_weight: lambda of eq. 2.
        dropout: probability with which a step leaves out a Gaussian.
        rng: draws which.
    """

    def __init__(
        self,
        views: Sequence[ObservedView],
        dssim_weight: float,
        dropout: float,
        rng: np.random.Generator,
    ) -> None:
        compared_views = [ComparedView.of(view) for view in views]
        shared_sizes = SharedSizes(compared_views)
        render = views[0].config
        self._views: dict[int, StepView] = {}
        for v, view in enumerate(compared_views):
            packing, arrays = shared_sizes.arrays(view)
            losses = FirstLosses(packing, dssim_weight, dropout, render)
            names = ("recon", SQUARED_ERROR)
            self._views[v] = StepView(losses, names, shared_sizes.sizes(view.region), arrays)
        self._dropout = dropout
        self._rng = rng

    def of(self, count: int) -> RecordedSteps:
        """Return the steps of some number of Gaussians."""
        draw = None
        if self._dropout:
            draw = Draw(self._rng, lambda rng: {"is_kept": kept(count, self._dropout, rng)})
        return RecordedSteps(self._views, {}, {}, count, (count, count), draw)


def kept(count: int, dropout: float, rng: np.random.Generator) -> UInt32:
    """Return 0 for each of some Gaussians that a step leaves out, 1 for the others [N]."""
    return from_numpy(mi.UInt32, rng.random(count, np.float32) >= dropout)


def is_recordable(views: Iterable[ActiveView], objective: ObjectiveConfig) -> bool:
    """Return whether the steps of a frame can be recorded: a recording has no further terms,
    because these may compute anything, and neither delays nor images behind the Gaussians.
    """
    return not objective.terms and all(map(_is_plain, views))


def _is_plain(view: ActiveView) -> bool:
    """Return whether a recorded step can render a view."""
    camera = view.camera
    return (
        not (camera.delay or camera.readout)
        and camera.backdrop is None
        and not dr.is_array_v(camera.viewmat)
        # The blocks that fill up a region change its sections in several launches.
        and (view.region is None or sections(2 * view.region.num_blocks)[0] == 1)
    )


def _row_shape(name: str, width: int) -> tuple[int, ...]:
    """Return the shape of a Gaussian's value of a raw attribute."""
    return (width // 3, 3) if name == "sh_coeffs" else BY_NAME[name].shape


class _StaticArguments:
    """Static splats of the views of a frame as arguments of recordings.

    Args:
        views: static splats of each view; None: a view has none.

    Attributes:
        most: splats that a view has room for.
    """

    def __init__(self, views: Sequence[StaticSplats | None]) -> None:
        present = [static for static in views if static is not None]
        self.most = room_for("static splats", max(map(len, present), default=0))
        groups = {id(static.together): static.together for static in present}
        most = max(map(len, groups.values()), default=0)
        self._size = room_for("static splats of all views", most)
        self._columns = {key: self._columns_of(splats) for key, splats in groups.items()}

    def of(self, static: StaticSplats | None, channels: Sequence[str]) -> dict[str, Any]:
        """Return the arguments of a recording that draws some channels of a view."""
        if static is None:
            bounds = [0, 0]
            columns = self._nothing(channels)
        else:
            bounds = [static.first, static.count]
            columns = self._columns[id(static.together)]
            columns = {
                **columns,
                "channels": {name: columns["channels"][name] for name in channels},
            }
        return {"static": columns, "static_range": from_numpy(mi.UInt32, bounds)}

    def _columns_of(self, splats: Splats) -> dict[str, Any]:
        """Return splats in arrays of a fixed size. A recording infers the size of a launch from an
        array of that size, and lengths that vary can coincide with it.
        """
        names = ("mean", "conic", "log2_opacity", "depth", "radius", "valid", "channels")
        lane = dr.arange(mi.UInt32, self._size)
        is_splat = lane < opaque(mi.UInt32, len(splats))
        columns = dr.gather(dict, {name: vars(splats)[name] for name in names}, lane, is_splat)
        dr.eval(columns)
        return columns

    def _nothing(self, channels: Sequence[str]) -> dict[str, Any]:
        """Return no splats in arrays of that size."""
        widths = channel_sizes()

        # Arrays of their own: a recording takes two that share memory for one.
        def zeros(count: int) -> list[Float]:
            return [from_numpy(mi.Float, np.zeros(self._size)) for _ in range(count)]

        return {
            "mean": mi.Point2f(zeros(2)),
            "conic": mi.Vector3f(zeros(3)),
            "log2_opacity": zeros(1)[0],
            "depth": zeros(1)[0],
            "radius": mi.Vector2f(zeros(2)),
            "valid": from_numpy(mi.Bool, np.zeros(self._size, bool)),
            "channels": {name: tuple(zeros(widths[name])) for name in channels},
        }


def _comparison(region: PaddedRegion, words: Inputs, view: Inputs) -> Comparison:
    """Return the target that the arrays of a view describe."""
    planes = Planes(region.height, region.width)
    runs = {
        name: {key: words[f"{name} {key}"] for key in RUN}
        for name in ("windows", "lanes", *(["around"] if not region.whole else []))
    }
    numbers = (elements(words["numbers"], mi.UInt32(k)) for k in range(3))
    arrays: dict[str, Jit] = {}
    arrays["count"], arrays["valid_share"], arrays["scale"] = numbers
    if "weight" in view:
        arrays["weight"] = view["weight"]
    return Comparison(
        planes,
        view["pixels"],
        region=None if region.whole else region,
        mean=view["mean"],
        variance=view["variance"],
        height=words["height"],
        **{name: Lanes.of(run) for name, run in runs.items()},
        **arrays,
    )
