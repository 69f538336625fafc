"""Fit of the first frame: from images and points to a keyframe, and later its confidence."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

import numpy as np

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.progress import Progress
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.dropping import adapted_to_images
from morgs_mi.fit.first_frame import fit_confidence, fit_first_frame
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.initialise import MIN_POINTS
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.loop.correction import estimate_correction
from morgs_mi.loop.frame_report import FittedFrame
from morgs_mi.loop.observation import FrameObservation, Images, Setup, views_of
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.flow import FlowObservation

_LOG = logging.getLogger(__name__)


def fitted_first_frame(
    setup: Setup,
    observed: FrameObservation,
    progress: Progress,
    on_provisional: Callable[[Packet], None] | None,
) -> FittedFrame:
    """Return the fit of the first frame.

    Args:
        setup: data that all frames share.
        observed: the images.
        progress: of the stages.
        on_provisional: called with provisional keyframes during the fit; None: there are none.
    """
    config = setup.config
    correction, correction_entry = estimate_correction(setup, observed.encoded, progress)
    views = views_of(setup, correction.corrected(observed.encoded))
    rng = rng_of(config.seed, Stream.FIRST_FRAME)
    plan = plan_first_frame(views, setup.points, config.fit)
    problem = FirstFrameProblem.of(views, setup.cloud, plan.config, config.render, rng)
    fit_config = adapted_to_images(plan.config, problem)

    on_round = (
        None
        if on_provisional is None
        else lambda gaussians: on_provisional(_packet(setup, gaussians))
    )
    status = "ok"
    if (count := len(setup.points)) < MIN_POINTS:
        status = (
            f"the capture has {count} points, too few: seeded {plan.config.first_count} random "
            "ones inside the views"
        )
        _LOG.warning("frame 0: %s", status)
    expected = forecast(problem.cameras, problem.points).entries if len(views) > 1 else {}
    fitted = fit_first_frame(problem, fit_config, rng, progress.of(plan.stage), on_round)
    return FittedFrame(
        packet=_packet(setup, fitted.gaussians),
        correction=correction,
        losses=fitted.losses,
        steps=fitted.steps,
        status=status,
        validation=expected | correction_entry,
    )


def _packet(setup: Setup, gaussians: Gaussians) -> Packet:
    return keyframe_packet(gaussians, 0, setup.cameras, setup.config.codec)


def with_first_confidence(
    setup: Setup,
    gaussians: Gaussians,
    images: Images,
    flows: Mapping[int, FlowObservation],
    rng: np.random.Generator,
) -> Gaussians:
    """Return the Gaussians of the first frame with a confidence learned from the masks of that
    frame (eqs. 9 to 11).

    Args:
        setup: data that all frames share.
        gaussians: the Gaussians.
        images: of the first frame, by view index.
        flows: optical flow of key views to the second frame, by view index.
        rng: of the order of the views.
    """
    config = setup.config
    motion = config.motion
    if not flows or not motion.learn_confidence:
        return gaussians
    masks = {
        v: motion_mask(
            images[v], flow.forward_flow, flow.forward_reliable, motion.mask_method, motion.masks
        )
        for v, flow in flows.items()
    }
    return fit_confidence(
        gaussians, dict(enumerate(setup.cameras)), masks, config.fit, config.render, rng
    )[0]
