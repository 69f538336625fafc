"""Input of the loop: the rig, and the observations of a frame that follow from its images alone.

Changes and optical flow do not depend on the Gaussians. They can be computed for the next frame
while this one is fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from morgs_mi.core.camera import OF_SENSOR, Camera
from morgs_mi.core.checks import check_mask, check_number, check_points, check_type
from morgs_mi.core.color_space import BRIGHTEST, display_image, display_stops, encode_light
from morgs_mi.core.config import config_or_default
from morgs_mi.core.rig import check_near_planes, choose_key_views, scene_extent
from morgs_mi.core.threads import map_in_threads
from morgs_mi.fit.budget import check_capacity
from morgs_mi.fit.view import View
from morgs_mi.loop.input_images import Frame, Images, copied_images
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.change import box_around, change_mask, moving_region
from morgs_mi.method.exposure import LEAST_CHANGE, Exposure, common_change, follow_exposure
from morgs_mi.method.flow import FlowObservation, observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
from morgs_mi.method.motion_model import MOTION_MODELS
from morgs_mi.method.objective import KeyView


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
    #: Optical flow of the key views that changed, by view index.
    flows: Mapping[int, FlowObservation]
    key_views: Mapping[int, KeyView]  #: These views for the terms of the objective, by view index.
    #: Images that the fit compares, encoded, by view index: `history.images` where uint8 was given,
    #: otherwise float32 with values above 1.
    encoded: Images
    recorded: Images  #: The images as they were given, by view index.


@dataclass(frozen=True, eq=False)
class Setup:
    """Data that all frames share; made by `prepare`."""

    cameras: tuple[Camera, ...]  #: The V training views.
    masks: tuple[np.ndarray | None, ...]  #: Per view [H, W] bool of valid pixels, or None.
    points: np.ndarray  #: SfM points [P, 3], world units.
    point_colors: np.ndarray  #: [P, 3], encoded: 1 is white.
    key_views: tuple[int, ...]  #: Indices of the views with optical flow and masks.
    extent: float  #: Of the scene, world units.
    config: StreamConfig  #: Settings.
    #: Stops by which linear light is brightened where flow and changes are computed; None: the
    #: first frame determines it, see `display_stops`.
    display_exposure: float | None = None


def prepare(
    cameras: Sequence[Camera],
    points: np.ndarray,
    point_colors: np.ndarray,
    config: StreamConfig | None = None,
    masks: Sequence[np.ndarray | None] | None = None,
    display_exposure: float | None = None,
) -> Setup:
    """Return the data that all frames share; arguments and errors as for `StreamLoop`."""
    config = config_or_default("StreamLoop()", config, StreamConfig())
    if not isinstance(cameras, Sequence) or not cameras:
        kind = f"a {type(cameras).__name__}" if cameras else "none"
        raise ValueError(
            f"StreamLoop(): `cameras` must be a sequence of at least one view, got {kind}; pass a "
            "list."
        )
    for camera in cameras:
        check_type("StreamLoop()", "cameras", camera, Camera, OF_SENSOR)
    points, point_colors = check_points("StreamLoop()", points, point_colors, BRIGHTEST)
    masks = (None,) * len(cameras) if masks is None else masks
    check_type("StreamLoop()", "masks", masks, Sequence, "pass a list")
    if len(masks) != len(cameras):
        raise ValueError(
            f"StreamLoop(): `masks` must have one mask or None for each of {len(cameras)} views, "
            f"got {len(masks)}; pass None where all pixels are valid."
        )
    for view, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        if mask is not None:
            place = f"StreamLoop(): view {camera.name or view!r}"
            check_mask(place, mask, camera.height, camera.width)
    check_near_planes("StreamLoop()", cameras, points)
    check_capacity("StreamLoop()", cameras, config.fit)
    # An error now, not at the second frame, if a file that a method names is missing.
    motion = config.motion
    FLOW_SOURCES.make(motion.flow_method, motion.flow)
    MASK_REFINERS.make(motion.mask_method, motion.masks)
    MOTION_MODELS.make(motion.model, motion)
    copies = tuple(None if mask is None else mask.copy() for mask in masks)
    key_views = choose_key_views(cameras, motion.key_views)
    extent = scene_extent(cameras)
    if display_exposure is not None:
        check_number("StreamLoop()", "display_exposure", display_exposure, "[-100, 100]")
    cloud = points.copy(), point_colors.copy()
    return Setup(tuple(cameras), copies, *cloud, key_views, extent, config, display_exposure)


def views_of(setup: Setup, images: Images) -> list[View]:
    """Return the views that have an image."""
    return [View(setup.cameras[v], image, setup.masks[v]) for v, image in images.items()]


def observe_frame(
    setup: Setup, frame: int, history: ImageHistory, images: Frame
) -> FrameObservation:
    """Return the observations of a frame: changes, flow (eq. 4) and masks (eqs. 9, 10).

    Args:
        setup: data that all frames share.
        frame: its index.
        history: images up to the frame before; `ImageHistory()` for the first.
        images: per training view uint8 [H, W, 3], RGB, or linear light (see `Frame`), or None
            where the view has no image. They are copied.

    Raises:
        ValueError: as for `copied_images`.
    """
    recorded = copied_images(setup.cameras, images, frame, history.kind)
    new_history, changes = _extended(setup, history, recorded)
    flows, key_views = _flows(setup, frame, history.images, new_history.images, changes)
    encoded = {
        v: new_history.images[v]
        if image.dtype == np.uint8
        else new_history.exposures.get(v, Exposure()).corrected(encode_light(image))
        for v, image in recorded.items()
    }
    return FrameObservation(new_history, changes, flows, key_views, encoded, recorded)


def extended_history(
    setup: Setup, frame: int, history: ImageHistory, images: Frame
) -> ImageHistory:
    """Return the images up to a frame, without flow; arguments and errors of `observe_frame`."""
    return _extended(setup, history, copied_images(setup.cameras, images, frame, history.kind))[0]


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
        view_exposures = map_in_threads(
            lambda v: follow_exposure(
                history.references[v], display_images[v], setup.masks[v], history.exposures.get(v)
            ),
            views,
        )
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
        lambda v: change_mask(history.references[v], images[v], setup.masks[v], config), views
    )
    for v, mask in zip(views, masks, strict=True):
        changes[v] = mask
        # The reference is replaced where the image changed: a slow change is detected once it has
        # added up.
        old = history.references[v].copy()
        references[v] = np.asarray(cv2.copyTo(images[v], mask.astype(np.uint8), old))
    return ImageHistory(images, references, exposures, stops, kind), changes if skip else None


def _flows(
    setup: Setup,
    frame: int,
    previous: Images,
    images: Images,
    changes: Mapping[int, np.ndarray] | None,
) -> tuple[dict[int, FlowObservation], dict[int, KeyView]]:
    """Return the optical flow of the key views that changed, with masks in every n-th frame, where
    a term uses it.
    """
    motion = setup.config.motion
    has_mask_loss = motion.learn_confidence and setup.config.fit.objective.mask_weight > 0
    with_masks = has_mask_loss and frame % motion.mask_interval == 0
    if not (motion.learn_motion or with_masks or (motion.learn_confidence and frame == 1)):
        return {}, {}
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
            name = setup.cameras[v].name
            pairs[v] = FramePair(images[v], previous[v], name, frame, setup.masks[v], box, region)
    if not pairs:
        return {}, {}
    masks = motion.mask_method if with_masks else None
    flows = observe_key_views(pairs, motion.flow_method, masks, motion.flow, motion.masks)
    return flows, {v: KeyView(pairs[v], flow) for v, flow in flows.items()}
