"""Time offsets of the cameras of a rig with unsynchronised clocks, from the motion in their images.

At a timestamp, Gaussians are fitted to the images of all training views, and the flow of the views
is lifted to their displacement in one frame (see `method.lift`). `offset_equations` gives the
offsets that explain the remaining error of the images. The images are interpolated at the times
that these offsets give, and the Gaussians are fitted again. These are Gauss-Newton steps. The first
ones use blurred images, because the equations hold only for small displacements.

A fit compensates part of the offsets with shapes and colours. The visible part kappa follows from
the last two rounds of one blur (the secant method),

    kappa = - sum_v s_v (o'_v - o_v) / sum_v s_v^2 ,

with s the step between them and o, o' the solutions of the equations before and after it, for the
training views. If cameras are far apart, a fit can hide the whole offset, because it explains each
image by separate Gaussians; then any offset fits. A last round therefore moves the clocks by half a
frame. The errors of the offsets are divided by the part of this move that the equations recover.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from operator import add

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.interpolation import FrameInterpolation
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.offset_equations import UNKNOWN, OffsetEquations, offset_equations
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.method.flow import ViewFlow, observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.method.lift import lift_flow
from morgs_mi.platform.checks import require
from morgs_mi.platform.progress import StepReport
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.render_config import RenderConfig

# px, least width of the images: small images are fitted fast, and an offset displaces them by few
# pixels.
_WIDTH = 160
# Number of frames used from the start of the recording, and of timestamps among them at which
# Gaussians are fitted.
_FRAMES = 12
_TIMESTAMPS = 2
# Gaussians and steps of the fit at a timestamp; half as many of both for blurred images.
GAUSSIANS = 8000
STEPS = 600
# Standard deviations in pixels of the filters of the first rounds, one round each.
_BLURS = (6.0, 3.0, 1.5)
# Largest number of rounds after these, with unblurred images.
_ROUNDS = 6
# Largest step in frames of the last round: an offset is accurate to about half of it.
_TOLERANCE = 0.02
# Largest offset from the mean of the training views, frames.
_LARGEST = 3
_BLUR_OF_ROUND = (*_BLURS, *[0.0] * _ROUNDS)

# Bounds of kappa, and of a step in frames.
_SHARES = (0.2, 1.2)
_LONGEST_STEP = 1.0
# Frames by which the last round moves the clocks, and the least part of it that counts as
# recovered.
_MOVED = 0.5
_LEAST_FOUND = 0.05


@dataclass(frozen=True)
class TimeOffsets:
    """Time offsets of the cameras."""

    #: By name, the frame of each camera's clip that is simultaneous with frame 0 of the
    #: reference's, as in `ReadConfig.offset`; negative for a camera that began later.
    offsets: dict[str, float]
    #: By name, standard errors of the offsets, frames: large where the images hardly depend on the
    #: offset.
    errors: dict[str, float]
    reference: str  #: Name of the held-out camera, or of the first one; its offset does not change.
    change: float  #: Largest change in the last round, frames.
    #: Whether `change` is within the tolerance; the accuracy of the offsets is in `errors`.
    converged: bool


def estimate_time_offsets(
    capture: Capture,
    progress: StepReport | None = None,
) -> TimeOffsets:
    """Return the time offsets of a capture's cameras in frames, see `TimeOffsets`.

    They include the offsets that the capture was read with: its `reading` with the result as
    `offset` aligns the clips. Two runs differ by up to 0.02 frames, because the order of summed
    gradients varies.

    No Gaussian is fitted to the held-out view. Its offset follows from its own error and from the
    others' offsets.

    Args:
        capture: a capture with clips of one frame rate.
        progress: called with (fits done, fits at most).

    Raises:
        ValueError: the recording has one camera or fewer than four frames, an image is missing, or
            nothing moves.
    """
    place = capture.path
    cameras = len(capture.cameras)
    require(cameras > 1, place, "expected at least 2 cameras to compare clocks", 1, "record more")
    clips = _Clips.of(capture, progress)
    largest = min(_LARGEST, (clips.num_frames - 2) // 2)
    require(
        largest >= 1,
        place,
        "expected at least 4 frames to compare clocks",
        clips.num_frames,
        "record longer",
    )
    offsets, step, equations = _aligned(clips, largest)
    reference = capture.reference_view
    # The part that the equations recover of a move of the clocks relative to the reference's.
    moves = np.where(np.arange(cameras) % 2, _MOVED, -_MOVED)
    moves[reference] = 0
    change = clips.equations(offsets - step + moves, 0.0, largest).solution() - equations.solution()
    part = (change[reference] - change) / np.where(moves != 0, moves, 1)
    part = np.clip(part, _LEAST_FOUND, 1)
    errors = np.minimum(equations.errors(reference) / part, UNKNOWN)
    given = capture.reading.offset
    clocks = offsets - [camera.delay for camera in capture.cameras]
    offset_by_name = {}
    error_by_name = {}
    for view, name in enumerate(capture.names):
        offset = given.get(name, 0.0) - (clocks[view] - clocks[reference])
        offset_by_name[name] = round(float(offset), 3) + 0.0  # without -0
        error_by_name[name] = round(float(errors[view]), 3)
    last_change = float(np.abs(step).max())
    return TimeOffsets(
        offset_by_name,
        error_by_name,
        capture.names[reference],
        last_change,
        last_change < _TOLERANCE,
    )


def _aligned(clips: _Clips, largest: int) -> tuple[np.ndarray, np.ndarray, OffsetEquations]:
    """Return offsets [V] of at most `largest`, the last step [V], and the step's equations."""
    offsets = step = solution = np.zeros(len(clips.clips))
    for index, blur in enumerate(_BLUR_OF_ROUND):
        equations = clips.equations(offsets, blur, largest)
        previous = solution
        solution = equations.solution()
        share = 1.0  # kappa of the module
        last_step = step[clips.train]
        if blur in _BLUR_OF_ROUND[:index] and last_step.any():
            change = (solution - previous)[clips.train]
            share = float(np.clip(-np.sum(last_step * change) / np.sum(last_step**2), *_SHARES))
        move = np.clip(equations.solution(share), -_LONGEST_STEP, _LONGEST_STEP)
        result = np.clip(offsets + move, -largest, largest)
        step = result - offsets
        offsets = result
        if not blur and np.abs(step).max() < _TOLERANCE:
            break
    return offsets, step, equations


@dataclass(frozen=True, eq=False)
class _Clip:
    """The first frames of a view, reduced."""

    view: View  # the reduced view
    pairs: list[FrameInterpolation]  # of successive frames, uint8 [H, W, 3]

    @classmethod
    def of(cls, capture: Capture, index: int, view: View) -> _Clip:
        images = []
        for image in capture.images(index, 0, _FRAMES):
            if isinstance(image, Exception):
                raise image
            images.append(image)
        view = view.at(images[0]).reduced(_WIDTH)
        size = view.camera.size
        # The images are whole frames: with the capture's delays they would be displaced twice.
        view = replace(view, camera=view.camera.without_delays())
        images = [cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in images]
        return cls(view, [FrameInterpolation(*pair) for pair in pairwise(images)])

    def at(self, time: float) -> View:
        """Return the view with its image of a time, in frames."""
        time = np.clip(time, 0, len(self.pairs))
        frame = min(int(time), len(self.pairs) - 1)
        return self.view.at(self.pairs[frame].at(time - frame))


@dataclass(eq=False)
class _Clips:
    """The first frames of a capture, and fits to them."""

    capture: Capture
    progress: StepReport | None  # called with (fits done, fits at most), or None
    clips: tuple[_Clip, ...]  # of V views
    done: int = 0  # number of completed fits

    @classmethod
    def of(cls, capture: Capture, progress: StepReport | None) -> _Clips:
        display = capture.displayed()
        clips = [_Clip.of(display, index, view) for index, view in enumerate(display.views)]
        return cls(capture, progress, tuple(clips))

    @property
    def train(self) -> list[int]:
        """Indices of the training views."""
        return list(self.capture.train_views)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.clips[0].pairs) + 1

    def at(self, times: np.ndarray) -> list[View]:
        """Return the views with their images, each at its own time [V], in frames."""
        return [clip.at(time) for clip, time in zip(self.clips, times, strict=True)]

    def equations(self, offsets: np.ndarray, blur: float, largest: int) -> OffsetEquations:
        """Return the sum of the equations of all timestamps, with images interpolated by offsets
        [V] of at most `largest` and blurred.
        """
        parts = []
        last = self.num_frames - 2 - largest
        for timestamp in np.linspace(largest, last, _TIMESTAMPS).round().astype(int):
            parts.append(self._equations_at(timestamp - offsets, blur))
            self.done += 1
            if self.progress is not None:
                # There are fewer fits if a round is left out.
                self.progress(self.done, (len(_BLUR_OF_ROUND) + 1) * _TIMESTAMPS)
        equations = reduce(add, parts)
        require(
            equations.own.any(),
            self.capture.path,
            f"expected motion in the first {self.num_frames} frames",
            "none",
            "record something that moves",
        )
        return equations

    def _equations_at(self, times: np.ndarray, blur: float) -> OffsetEquations:
        """Return the equations of a timestamp, which each view shows at its own time [V]."""
        views = self.at(times)
        next_views = self.at(times + 1)
        pairs = {
            v: FramePair(next_views[v].image, views[v].image, valid=views[v].mask)
            for v in self.train
        }
        divisor = 2 if blur else 1
        fit = FitConfig(
            sh_degree=0,
            num_gaussians=GAUSSIANS // divisor,
            first_frame_steps=STEPS // divisor,
            dropout=0.0,
            density=DensityConfig(rounds=0),
        )
        train_views = [views[v] for v in self.train]
        rng = rng_of(0, Stream.TIMING)
        points = PointCloud(self.capture.points, self.capture.point_colors)
        problem = FirstFrameProblem.of(train_views, points, fit, RenderConfig(), rng)
        gaussians = fit_first_frame(problem, fit, rng).gaussians
        observed = observe_key_views(pairs)
        flow = lift_flow(
            gaussians, [ViewFlow(ActiveView(views[v].camera), observed[v]) for v in self.train]
        )
        gaussians = replace(gaussians, motion=flow.displacement)
        train = np.isin(np.arange(len(views)), self.train)
        return offset_equations(gaussians, views, train, blur)
