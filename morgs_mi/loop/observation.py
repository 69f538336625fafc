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
from morgs_mi.core.color_space import BRIGHTEST, display_image, display_stops, encode_light
from morgs_mi.core.rig import check_near_planes, choose_key_views, scene_extent
from morgs_mi.core.view import View, Views
from morgs_mi.fit.budget import check_capacity
from morgs_mi.fit.far_views import are_around
from morgs_mi.fit.initialise import border_color, has_points, mean_color
from morgs_mi.loop.input_images import FrameImages, Images, copied_images
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.change import box_around, change_mask, moving_region
from morgs_mi.method.exposure import (
    LEAST_CHANGE,
    Exposure,
    common_change,
    fit_exposure,
    reduced,
)
from morgs_mi.method.flow import FlowObservation, observe_key_views
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
    """Images up to a frame, with the exposure of each view's first image if exposures are
    estimated.
    """

    #: Of that frame as a display shows them, uint8, by view index, of the views that have one.
    images: Images = field(default_factory=dict)
    #: Images that the next frame is compared with to detect changes, by view index.
    references: Images = field(default_factory=dict)
    #: Of that frame relative to the view's first image, by view index; empty if they are not
    #: estimated.
    exposures: Mapping[int, Exposure] = field(default_factory=dict)
    #: Stops by which linear light is brightened for them; None before the first frame.
    display_exposure: float | None = None
    kind: str = ""  #: Numbers of the images, uint8 or float32; empty before the first.


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """Observations of a frame that follow from its images alone."""

    history: ImageHistory  #: The images, with those before.
    #: Masks of changed pixels [H, W], by view index; None: all pixels may have changed.
    changes: Mapping[int, np.ndarray] | None
    #: Images that the fit compares, encoded, by view index: `history.images` where uint8 was given,
    #: otherwise float32 with values above 1.
    encoded: Images
    recorded: Images  #: The images as they were given, by view index.
    pending_key_views: Future[dict[int, KeyView]]  #: See `key_views`.

    @property
    def key_views(self) -> dict[int, KeyView]:
        """The key views that changed, with their optical flow, by view index. Another thread
        computes them, for which this waits.

        Raises:
            OSError: flow is read from files and one is missing.
        """
        return self.pending_key_views.result()

    @property
    def flows(self) -> dict[int, FlowObservation]:
        """Optical flow of these views, likewise."""
        return {v: view.flow for v, view in self.key_views.items()}


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
            check_type("StreamLoop()", "views", view, Camera, OF_SENSOR)
            view = View(view)
        mask = view.mask
        if mask is not None:
            place = f"StreamLoop(): view {view.name or v!r}"
            check_mask(place, mask, view.camera.height, view.camera.width)
            mask = mask.copy()
        setup_views.append(View(view.camera, mask=mask))
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
    encoded = observe_frame(setup, 0, ImageHistory(), images).encoded
    views = views_of(setup, encoded)
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


def views_of(setup: Setup, images: Images) -> list[View]:
    """Return the views that have an image."""
    return [setup.views[v].at(image) for v, image in images.items()]


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
    recorded = copied_images(setup.views, images, frame, history.kind)
    new_history, changes = _extended(setup, history, recorded)
    # Beside the search for the active Gaussians, which does not need it.
    key_views = in_background(
        partial(_key_views, setup, frame, history.images, new_history.images, changes)
    )
    encoded = {
        v: new_history.images[v]
        if image.dtype == np.uint8
        else new_history.exposures.get(v, Exposure()).corrected(encode_light(image))
        for v, image in recorded.items()
    }
    return FrameObservation(new_history, changes, encoded, recorded, key_views)


def extended_history(
    setup: Setup, frame: int, history: ImageHistory, images: FrameImages
) -> ImageHistory:
    """Return the images up to a frame, without flow; arguments and errors of `observe_frame`."""
    return _extended(setup, history, copied_images(setup.views, images, frame, history.kind))[0]


def _extended(
    setup: Setup, history: ImageHistory, recorded: Images
) -> tuple[ImageHistory, dict[int, np.ndarray] | None]:
    """Return the images up to a frame with these, and the masks of its changes; None: all may have
    changed.
    """
    skip = setup.config.fit.skip_static
    follow = setup.config.fit.exposure != "off"
    stops = history.display_exposure if setup.display_exposure is None else setup.display_exposure
    stops = display_stops(recorded.values()) if stops is None else stops
    display_images = {v: display_image(image, stops) for v, image in recorded.items()}
    kind = next((image.dtype.name for image in recorded.values()), history.kind)
    if not (skip or follow):
        return ImageHistory(display_images, display_exposure=stops, kind=kind), None
    views = sorted(display_images.keys() & history.references.keys())
    exposures = {}
    if follow:
        # Relative to the views' first images, without the change of light that all views show.
        pairs = map_in_threads(
            lambda v: (
                *reduced(history.references[v], display_images[v], setup.views[v].mask),
                history.exposures.get(v),
            ),
            views,
        )
        # A fit is many short operations, for which threads would only wait for each other.
        view_exposures = [fit_exposure(*pair) for pair in pairs]
        light = common_change(view_exposures)
        relative = [exposure.without(light) for exposure in view_exposures]
        # The identity where an exposure hardly changes an image.
        visible = [e if e.change > LEAST_CHANGE else Exposure() for e in relative]
        exposures = {**history.exposures, **dict(zip(views, visible, strict=True))}
    images = {
        v: exposures[v].corrected(image) if v in exposures else image
        for v, image in display_images.items()
    }
    # A view's first image has no changes.
    changes = {v: np.zeros(image.shape[:2], bool) for v, image in images.items()}
    references = {**history.references, **images}
    config = setup.config.motion.change
    masks = map_in_threads(
        lambda v: change_mask(history.references[v], images[v], setup.views[v].mask, config), views
    )
    for v, mask in zip(views, masks, strict=True):
        changes[v] = mask
        # The reference is replaced where the image changed: a slow change is detected once it has
        # added up.
        old = history.references[v].copy()
        references[v] = np.asarray(cv2.copyTo(images[v], mask.astype(np.uint8), old))
    return ImageHistory(images, references, exposures, stops, kind), changes if skip else None


def _key_views(
    setup: Setup,
    frame: int,
    previous: Images,
    images: Images,
    changes: Mapping[int, np.ndarray] | None,
) -> dict[int, KeyView]:
    """Return the key views that changed with their optical flow, and with masks in every n-th
    frame, where a term uses it.
    """
    motion = setup.config.motion
    has_mask_loss = motion.learn_confidence and setup.config.fit.objective.mask_weight > 0
    with_masks = has_mask_loss and frame % motion.mask_interval == 0
    if not (motion.learn_motion or with_masks or (motion.learn_confidence and frame == 1)):
        return {}
    common_views = sorted(previous.keys() & images.keys())
    key_views = [v for v in setup.key_views if v in common_views]
    if len(key_views) < len(setup.key_views) and common_views:  # others, where some lack an image
        chosen = choose_key_views([setup.cameras[v] for v in common_views], len(setup.key_views))
        key_views = [common_views[k] for k in chosen]
    pairs = {}
    for v in key_views:
        box = None if changes is None else box_around(changes[v])
        if changes is None or box is not None:
            region = None if changes is None else moving_region(changes[v])
            view = setup.views[v]
            pairs[v] = FramePair(images[v], previous[v], view.name, frame, view.mask, box, region)
    if not pairs:
        return {}
    masks = motion.mask_method if with_masks else None
    flows = observe_key_views(pairs, motion.flow_method, masks, motion.flow, motion.masks)
    return {v: KeyView(pairs[v], flow) for v, flow in flows.items()}
