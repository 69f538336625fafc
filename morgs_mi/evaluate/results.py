"""Results of an evaluation as frozen dataclasses.

`Evaluation.as_dict` is the JSON that `morgs-mi eval` writes.

NaN stands for an unknown score. A name with ``_moving`` or ``_still`` is the score of a region; see
`measures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Self

import numpy as np

from morgs_mi.platform.bounded import JsonObject

_NAN = float("nan")
_SECONDS = (
    "wall time of a frame from the images in memory to its packet: flow, masks, optimisation, "
    "residual and its decoding; without reading the recording and without writing the packet"
)


def known_mean(values: Sequence[float | None] | np.ndarray) -> float:
    """Return the mean of the values that are neither NaN nor None; NaN if there are none."""
    numbers = np.array(values, float)
    known = numbers[~np.isnan(numbers)]
    return float(known.mean()) if known.size else _NAN


@dataclass(frozen=True)
class _Scores:
    """Base of scores that are averaged field by field."""

    @classmethod
    def mean(cls, scores: Sequence[Self]) -> Self:
        """Return the mean of each field over its known values."""
        return cls(*map(known_mean, np.array(list(map(astuple, scores)), float).T))


@dataclass(frozen=True)
class ViewScores(_Scores):
    """Scores of one view of one frame, or means of several."""

    psnr: float = _NAN  #: PSNR, dB.
    psnr_moving: float = _NAN
    psnr_still: float = _NAN
    #: PSNR after the gain and bias per channel that make the rendered image most like the recorded
    #: one, dB.
    psnr_matched: float = _NAN
    #: PSNR of the recorded image of the nearest training view in place of the rendered one, dB, of
    #: held-out views alone: what a fit has to exceed.
    psnr_nearest: float = _NAN
    psnr_mu: float = _NAN  #: PSNR of the linear light by the mu-law, dB, of HDR recordings alone.
    ssim: float = _NAN  #: SSIM, at most 1.
    ssim_moving: float = _NAN
    ssim_still: float = _NAN
    delta_e: float = _NAN  #: Colour difference CIE dE2000.
    delta_e_moving: float = _NAN
    delta_e_still: float = _NAN
    lpips: float = _NAN  #: LPIPS, if a network is given.
    lpips_moving: float = _NAN
    lpips_still: float = _NAN
    motion_error: float = _NAN  #: Endpoint error of the rendered motion, px.
    motion_error_moving: float = _NAN
    motion_error_still: float = _NAN
    true_motion_moving: float = _NAN  #: Mean length of the true motion where the surface moves, px.
    confidence_iou: float = _NAN  #: IoU of the rendered confidence above 0.5 and the true mask.


@dataclass(frozen=True)
class Motion3DScores(_Scores):
    """Error of the 3D displacements of Gaussians on moving objects (see `motion3d`)."""

    #: Number of Gaussians that are compared; NaN without tracks or a previous frame.
    num_gaussians: float = _NAN
    error: float = _NAN  #: Mean of |d - d*|, world units.
    true_length: float = _NAN  #: Mean of |d*|, world units.
    relative_error: float = _NAN  #: `error` divided by `true_length`.
    length_ratio: float = _NAN  #: Mean of |d| divided by `true_length`.
    #: Mean angle between d and d*, degrees; 90 for a Gaussian that does not move.
    angle: float = _NAN


@dataclass(frozen=True)
class VariationScores(_Scores):
    """Masked total variation (mTV, x100) of the static pixels of a view (see `StillVariation`)."""

    render: float = _NAN  #: mTV of the rendered view.
    input: float = _NAN  #: mTV of the recording.
    still_share: float = _NAN  #: Share of the view's pixels that count as static.


@dataclass(frozen=True)
class FrameScores:
    """Scores of one frame."""

    frame: int  #: Index of the frame.
    kind: str  #: Kind of its packet, ``keyframe`` or ``residual``.
    num_bytes: int  #: Size of its packet.
    seconds: float | None  #: Wall time of its fit; None without a report of the fit.
    scores: ViewScores  #: Means over the views.
    motion_3d: Motion3DScores  #: Errors in 3D.
    views: Mapping[str, ViewScores]  #: Scores by camera name.
    #: Whether it was fitted with an image and an evaluated view has one.
    has_images: bool = True

    def as_dict(self) -> JsonObject:
        """Return the frame's row of the JSON."""
        row = asdict(self)
        del row["has_images"]  # the clip's row names such frames
        scores, motion, views = map(row.pop, ("scores", "motion_3d", "views"))
        return {**row, **scores, "motion_3d": motion, "views": views}


@dataclass(frozen=True)
class Timings:
    """Wall times of a fit, from the images in memory to the packet."""

    first: float | None  #: Seconds of the first frame; None without a report of the fit.
    per_later_frame: float  #: Mean seconds of a later frame.


@dataclass(frozen=True)
class Sizes:
    """Sizes of a stream, bytes."""

    file: int  #: Size of the file.
    overhead: int  #: Header, index and re-emitted keyframes.
    per_frame: float  #: `file` divided by the number of frames.
    per_keyframe: float  #: Mean size of a keyframe's packet.
    per_residual: float  #: Mean size of a residual's packet.


@dataclass(frozen=True)
class PlaybackTimes:
    """Speed of decoding and rendering a stream on this machine (see `playback_speed`)."""

    fps: float  #: Frames per second.
    decode_ms: float  #: Median time to decode a frame, ms.
    render_ms: float  #: Median time to render a frame, ms.


@dataclass(frozen=True)
class Evaluation:
    """Scores of a stream."""

    stream: str  #: Path of the stream file.
    capture: str  #: Path of the capture.
    held_out: bool  #: Whether held-out views are scored; otherwise all training views.
    #: Quality that the fit expects of views between the cameras; empty: it is not known.
    between_cameras: str
    complete: bool  #: Whether the stream holds all frames that were to be fitted.
    regions: str  #: Source of the regions, ``true masks`` or ``recorded change``.
    sizes: Sizes
    variation: VariationScores  #: Mean over the views.
    playback: PlaybackTimes
    psnr_slope: float  #: Slope of the PSNR, dB per frame.
    frames: tuple[FrameScores, ...]

    @property
    def num_frames(self) -> int:
        """Number of frames in the stream."""
        return len(self.frames)

    @property
    def without_images(self) -> tuple[int, ...]:
        """Frames that were fitted without any image, or have none of the evaluated views."""
        return tuple(frame.frame for frame in self.frames if not frame.has_images)

    @property
    def scores(self) -> ViewScores:
        """Means over the frames."""
        return ViewScores.mean([frame.scores for frame in self.frames])

    @property
    def views(self) -> dict[str, ViewScores]:
        """Means over the frames by camera name."""
        names = self.frames[0].views
        return {
            name: ViewScores.mean([frame.views[name] for frame in self.frames]) for name in names
        }

    @property
    def motion_3d(self) -> Motion3DScores:
        """Mean over the frames."""
        return Motion3DScores.mean([frame.motion_3d for frame in self.frames])

    @property
    def seconds(self) -> Timings:
        """Times of the fit."""
        later_mean = known_mean([frame.seconds for frame in self.frames[1:]])
        return Timings(self.frames[0].seconds, later_mean)

    def as_dict(self) -> JsonObject:
        """Return the evaluation as JSON can hold it, apart from scores that are infinite or NaN."""
        means = asdict(self.scores)
        first = asdict(self.frames[0].scores)
        last = asdict(self.frames[-1].scores)
        for name in ("psnr", "ssim"):
            means[name] = {"mean": means[name], "first": first[name], "last": last[name]}
        sources = ("stream", "capture", "held_out", "between_cameras")
        names = (*sources, "num_frames", "complete", "without_images", "regions")
        return {
            **{name: getattr(self, name) for name in names},
            **means,
            "psnr_slope": self.psnr_slope,
            "motion_3d": asdict(self.motion_3d),
            "seconds": {**asdict(self.seconds), "definition": _SECONDS},
            "bytes": asdict(self.sizes),
            "mtv": asdict(self.variation),
            "playback": asdict(self.playback),
            "views": {name: asdict(scores) for name, scores in self.views.items()},
            "frames": [frame.as_dict() for frame in self.frames],
        }
