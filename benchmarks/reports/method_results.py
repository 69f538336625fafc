"""Results of the report on the method; their JSON is ``method.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmarks.reports.records import Record

__all__ = ["FlowError", "MethodClip", "MethodResult", "ScratchRow", "SettingRow"]


@dataclass(frozen=True)
class SettingRow:
    """Scores of one setting over its seeds; `scores_of` names and explains the scores."""

    preset: str
    epochs: int
    """Passes over the views for every later frame."""
    key_views: int
    """Cameras with optical flow."""
    rates: float
    """Factor on the learning rates."""
    runs: int
    """Number of seeds."""
    mean: Mapping[str, float]
    """Mean of each score over the seeds."""
    std: Mapping[str, float]
    """Standard deviation of each score over the seeds (n - 1)."""
    by_frame: Mapping[str, tuple[float, ...]]
    """Means over the seeds for each later frame."""
    best: bool
    """Whether the rates are the preset's best at this number of epochs."""


@dataclass(frozen=True)
class ScratchRow:
    """Scores of one frame that is fitted from scratch."""

    frame: int
    steps: int
    psnr: float
    """PSNR, dB."""
    psnr_moving: float
    psnr_still: float
    ssim: float
    seconds: float
    """Wall time of the fit."""


@dataclass(frozen=True)
class FlowError:
    """Endpoint error of the optical flow on the key views where the surface moves, px."""

    error: float
    """Over all pixels."""
    reliable_error: float
    """Over the pixels that pass the forward-backward check."""


@dataclass(frozen=True)
class MethodClip:
    """Results of one clip."""

    name: str
    views: int
    frames: int
    width: int
    """Width of the images, px."""
    height: int
    """Height of the images, px."""
    held_out: bool
    """Whether one view is held out."""
    flow: FlowError | None = field(metadata={"key": "cue"})
    """Error of the flow that guides the motion; None without ground truth."""
    scratch: tuple[ScratchRow, ...]
    """Frames fitted from scratch."""
    rows: tuple[SettingRow, ...]
    """Settings of the presets."""
    key_view_rows: tuple[SettingRow, ...]
    """Settings that compare numbers of key views."""


@dataclass(frozen=True)
class MethodResult(Record):
    """Results of a report on the method."""

    clips: tuple[MethodClip, ...]
    table_epochs: int
    """Number of epochs of the tables on parts and on key views."""
    version: str
    """Version of the method's sources."""
    settings: Mapping[str, Any]
    machine: Mapping[str, Any]
    versions: Mapping[str, str]
