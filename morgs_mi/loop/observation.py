"""Input of the loop: the rig, and the observations of a frame that follow from its images alone.

Changes and optical flow do not depend on the Gaussians. They can be computed for the next frame
while this one is fitted.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np

from morgs_mi.core.camera import OF_SENSOR, Camera
from morgs_mi.core.color_space import BRIGHTEST, display_image, display_stops
from morgs_mi.core.rig import check_near_planes, choose_key_views, scene_extent
from morgs_mi.core.view import View, Views
from morgs_mi.fit.budget import check_capacity
from morgs_mi.fit.far_views import are_around
from morgs_mi.fit.initialise import border_color, has_points, mean_color
from morgs_mi.loop.input_images import FrameImages, InputImage, as_array, copied_images
from morgs_mi.loop.seen_view import SeenView, ViewHistory
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.change import box_around, change_mask, moving_region
from morgs_mi.method.exposure import (
    LEAST_CHANGE,
    Exposure,
    common_change,
    fit_exposure,
    reduced,
)
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
from morgs_mi.method.motion_model import MOTION_MODELS
from morgs_mi.method.objective import KeyView
from morgs_mi.platform.checks import check_mask, check_number, check_points, check_type
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.threads import in_background, map_in_threads

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ImageHistory:
    """Images up to a frame."""

    #: Of the views that had one so far, by view index.
    views: Mapping[int, ViewHistory] = field(default_factory=dict)
    #: Stops by which linear light is brightened for them; None before the first frame.
    display_exposure: float | None = None
    kind: str = ""  #: Numbers of the images, uint8 or float32; empty before the first.


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """Observations of a frame that follow from its images alone."""

    views: Mapping[int, SeenView]  #: The views that have an image, by view index.
    history: ImageHistory  #: Their images, with those before.
    pending_key_views: Future[dict[int, KeyView]]  #: See `key_views`.

    @property
    def key_views(self) -> dict[int, KeyView]:
        """The key views that changed, with their optical flow, by view index. Another thread
        computes them, for which this waits.

        Raises:
            OSError: flow is read from files and one is missing.
        """
        return self.pending_key_views.result()

    def is_of(self, images: Sequence[InputImage | None]) -> bool:
        """Return whether the observation is of these images, one or None for each training view."""
        return all(
            np.array_equal(as_array(image), self.views[v].recorded)
            if v in self.views
            else image is None
            for v, image in enumerate(images)
        )


@dataclass(frozen=True, eq=False)
class Setup:
    """Data that all frames share; made by `prepare`."""

    views: Views[View]  #: The V training views, without images.
    points: np.ndarray  #: SfM points [P, 3], world units.
    point_colors: np.ndarray  #: [P, 3], encoded: 1 is white.
    key_views: tuple[int, ...]  #: Indices of the views with optical flow and masks.
    extent: float  #: Of the scene, world units.
    config: StreamConfig  #: Settings.
    #: Stops by which linear light is brightened where flow and changes are computed; None: the
    #: first frame determines it, see `display_stops`.
    display_exposure: float | None = None

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the views."""
        return self.views.cameras


def prepare(
    views: Sequence[View | Camera],
    points: np.ndarray,
    point_colors: np.ndarray,
    config: StreamConfig | None = None,
    display_exposure: float | None = None,
) -> Setup:
    """Return the data that all frames share; arguments and errors as for `StreamLoop`."""
    config = config_or_default("StreamLoop()", config, StreamConfig())
    if not isinstance(views, Sequence) or not views:
        kind = f"a {type(views).__name__}" if views else "none"
        raise ValueError(
            f"StreamLoop(): `views` must be a sequence of at least one view, got {kind}; pass a "
            "list."
        )
    setup_views = []
    for v, view in enumerate(views):
        if not isinstance(view, View):
            view = View(view)
        check_type("StreamLoop()", "views", view.camera, Camera, OF_SENSOR)
        mask = view.mask
        if mask is not None:
            place = f"StreamLoop(): view {view.name or v!r}"
            check_mask(place, mask, view.camera.height, view.camera.width)
            mask = mask.copy()
        setup_views.append(View(view.camera, mask=mask))
    if not any(view.mask is None or view.mask.any() for view in setup_views):
        raise ValueError(
            "StreamLoop(): the masks of `views` must have a valid pixel, got none in any view; set "
            "the pixels to use to True."
        )
    setup_views = Views(setup_views)
    cameras = setup_views.cameras
    points, point_colors = check_points("StreamLoop()", points, point_colors, BRIGHTEST)
    check_near_planes("StreamLoop()", cameras, points)
    check_capacity("StreamLoop()", cameras, config.fit)
    # An error now, not at the second frame, if a file that a method names is missing.
    motion = config.motion
    FLOW_SOURCES.make(motion.flow_method, motion.flow)
    MASK_REFINERS.make(motion.mask_method, motion.masks)
    MOTION_MODELS.make(motion.model, motion)
    key_views = choose_key_views(cameras, motion.key_views)
    extent = scene_extent(cameras)
    if display_exposure is not None:
        check_number("StreamLoop()", "display_exposure", display_exposure, "[-100, 100]")
    cloud = points.copy(), point_colors.copy()
    return Setup(setup_views, *cloud, key_views, extent, config, display_exposure)


def over_border(setup: Setup, images: FrameImages) -> Setup:
    """Return a setup without points with the colour of the images' borders as its background, with
    a warning. If the borders have no colour in common, few cameras around a scene get the mean
    colour of the images, and others nothing. With points or a background, the setup stays as it is.

    Args:
        setup: data that all frames share.
        images: of the first frame, as for `observe_frame`.
    """
    render = setup.config.render
    backgrounds = [render.background, *(camera.background for camera in setup.cameras)]
    if any(b is not None for b in backgrounds) or has_points(setup.cameras, setup.points):
        return setup
    observation = observe_frame(setup, 0, ImageHistory(), images)
    views = [view.in_scene() for view in observation.views.values()]
    color = border_color(views)
    source = "colour of the images' borders"
    if color is None and are_around(setup.cameras):
        color = mean_color(views)
        source = "mean colour of the images"
    if color is None:
        return setup
    _LOG.warning(
        "no points: the background is the %s, %s; give a `RenderConfig.background` for another.",
        source,
        tuple(np.round(color, 3).tolist()),
    )
    render = replace(render, background=color)
    return replace(setup, config=replace(setup.config, render=render))


def observe_frame(
    setup: Setup, frame: int, history: ImageHistory, images: FrameImages
) -> FrameObservation:
    """Return the observations of a frame: changes, flow (eq. 4) and masks (eqs. 9, 10).

    Args:
        setup: data that all frames share.
        frame: its index.
        history: images up to the frame before; `ImageHistory()` for the first.
        images: per training view uint8 [H, W, 3], RGB, or linear light (see `FrameImages`), or None
            where the view has no image. They are copied.

    Raises:
        ValueError: as for `copied_images`.
    """
    views, new_history = _seen_views(setup, frame, history, images)
    # Beside the search for the active Gaussians, which does not need it.
    key_views = in_background(partial(_key_views, setup, frame, views))
    return FrameObservation(views, new_history, key_views)


def extended_history(
    setup: Setup, frame: int, history: ImageHistory, images: FrameImages
) -> ImageHistory:
    """Return the images up to a frame, without flow; arguments and errors of `observe_frame`."""
    return _seen_views(setup, frame, history, images)[1]


def _seen_views(
    setup: Setup, frame: int, history: ImageHistory, images: FrameImages
) -> tuple[dict[int, SeenView], ImageHistory]:
    """Return the views that have an image, compared with those before, and the images up to the
    frame; arguments and errors of `observe_frame`.
    """
    fit = setup.config.fit
    recorded = copied_images(setup.views, images, frame, history.kind)
    stops = history.display_exposure if setup.display_exposure is None else setup.display_exposure
    stops = display_stops(recorded.values()) if stops is None else stops
    display_images = {v: display_image(image, stops) for v, image in recorded.items()}
    exposures = {}
    if fit.exposure != "off":
        exposures = _exposures(setup, history, display_images)

    def seen_view(v: int) -> SeenView:
        """Return a view with its image, compared with those before."""
        view = setup.views[v]
        before = history.views.get(v)
        exposure = exposures.get(v, Exposure())
        image = exposure.corrected(display_images[v])
        reference = image
        # A view's first image has no changes; without `skip_static`, all pixels count as changed.
        change = np.full(image.shape[:2], not fit.skip_static)
        if before is not None and (fit.skip_static or exposures):
            mask = change_mask(before.reference, image, view.mask)
            # The reference is replaced where the image changed: a slow change is detected once it
            # has added up.
            old = before.reference.copy()
            reference = np.asarray(cv2.copyTo(image, mask.astype(np.uint8), old))
            change |= mask
        return SeenView(
            view.camera,
            image,
            view.mask,
            change=change,
            index=v,
            recorded=recorded[v],
            previous=None if before is None else before.image,
            history=ViewHistory(image, reference, exposure),
        )

    views = {view.index: view for view in map_in_threads(seen_view, recorded)}
    histories = {v: replace(view, image=None) for v, view in history.views.items()}
    histories |= {v: view.history for v, view in views.items()}
    kind = next((image.dtype.name for image in recorded.values()), history.kind)
    return views, ImageHistory(histories, stops, kind)


def _exposures(
    setup: Setup, history: ImageHistory, images: Mapping[int, np.ndarray]
) -> dict[int, Exposure]:
    """Return the exposures of images relative to the first ones of their views, where these are
    not the first, without the change of light that all views show.
    """
    views = [v for v in images if v in history.views]
    pairs = map_in_threads(
        lambda v: (v, reduced(history.views[v].reference, images[v], setup.views[v].mask)), views
    )
    # A fit is many short operations, for which threads would only wait for each other.
    exposures = {v: fit_exposure(*pair, history.views[v].exposure) for v, pair in pairs}
    light = common_change([*exposures.values()])
    relative = {v: exposure.without(light) for v, exposure in exposures.items()}
    # The identity where an exposure hardly changes an image.
    return {v: e if e.change > LEAST_CHANGE else Exposure() for v, e in relative.items()}


def _key_views(setup: Setup, frame: int, views: Mapping[int, SeenView]) -> dict[int, KeyView]:
    """Return the key views that changed with their optical flow, and with masks in every n-th
    frame, where a term uses it.
    """
    motion = setup.config.motion
    has_mask_loss = motion.learn_confidence and setup.config.fit.objective.mask_weight > 0
    with_masks = has_mask_loss and frame % motion.mask_interval == 0
    if not (motion.learn_motion or with_masks or (motion.learn_confidence and frame == 1)):
        return {}
    common_views = [v for v, view in views.items() if view.previous is not None]
    key_views = [v for v in setup.key_views if v in common_views]
    if len(key_views) < len(setup.key_views) and common_views:  # others, where some lack an image
        chosen = choose_key_views([setup.cameras[v] for v in common_views], len(setup.key_views))
        key_views = [common_views[k] for k in chosen]
    pairs = {}
    for v in key_views:
        view = views[v]
        box = box_around(view.change)
        if box is not None and view.previous is not None:
            region = moving_region(view.change)
            pair = FramePair(view.image, view.previous, view.name, frame, view.mask, box, region)
            pairs[v] = pair
    if not pairs:
        return {}
    masks = motion.mask_method if with_masks else None
    flows = observe_key_views(pairs, motion.flow_method, masks, motion.flow, motion.masks)
    return {v: KeyView(pairs[v], flow) for v, flow in flows.items()}
