"""Disturbances of a recording: time offsets, rolling shutters and lens distortion.

Frame k of a camera with the time offset o is exposed at (k + o) / fps, and its row r of H at (k + o
+ s ((r + 0.5) / H - 0.5)) / fps, with s the rolling shutter: the time of a frame is the time of its
middle row. Ground truth refers to this time and to the view without distortion, which
`load_capture` returns.

On disk: ``truth/disturbances.json``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from morgs_mi.capture.lens import Lens
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.config import NonNegative, check_ranges
from morgs_mi.platform.files import write_json

_FILE = "disturbances.json"


@dataclass(frozen=True)
class Disturbances:
    """Strength of the disturbances of a recording; by default there are none.

    The held-out camera is the reference: it has no time offset.
    """

    time_offset: NonNegative = 0.0
    """Largest time offset of a camera from cam00 in frames; drawn per camera."""
    rolling_shutter: Annotated[float, Ge(0), Le(1)] = 0.0
    """Time in which all cameras read their rows, as a share of a frame; a rolling shutter has about
    0.5.
    """
    # Beyond, the corners of a wide view fold.
    distortion: Annotated[float, Ge(0), Le(0.5)] = 0.0
    """Largest radial distortion of the lenses, COLMAP's SIMPLE_RADIAL k, drawn per camera; 0.1 is
    moderate.
    """


@dataclass(frozen=True)
class CameraDisturbance:
    """The disturbance of one camera."""

    #: Frame k shows the time of frame k + time_offset of the reference, at its middle row.
    time_offset: float
    rolling_shutter: float  #: Time from the first row to the last, frames.
    distortion: float  #: k of COLMAP's SIMPLE_RADIAL lens.

    @property
    def lens(self) -> Lens:
        """The lens, as in a capture."""
        return Lens("SIMPLE_RADIAL", (self.distortion,)) if self.distortion else Lens()

    def row_times(self, frame: int, height: int) -> np.ndarray:
        """Return the time at which each row of a frame is read [H], in frames of the reference."""
        rows = (np.arange(height) + 0.5) / height - 0.5
        return frame + self.time_offset + self.rolling_shutter * rows


def draw_disturbances(
    disturbances: Disturbances, num_cameras: int, seed: int
) -> tuple[CameraDisturbance, ...]:
    """Return the disturbance of each camera; a setting affects only its own draws.

    Raises:
        ValueError: a setting is out of range.
    """
    check_ranges(disturbances, "draw_disturbances()")

    def draws(largest: float, stream: int) -> np.ndarray:
        rng = np.random.default_rng([seed, 3, stream])
        return largest * rng.uniform(-1, 1, num_cameras) + 0.0  # not -0

    offsets = draws(disturbances.time_offset, 0)
    offsets[0] = 0
    pairs = np.stack([offsets, draws(disturbances.distortion, 4)], axis=1).tolist()
    shutter = float(disturbances.rolling_shutter)
    return tuple(CameraDisturbance(offset, shutter, k) for offset, k in pairs)


def save_disturbances(folder: Path, cameras: Mapping[str, CameraDisturbance]) -> None:
    """Write the disturbance of each camera, by name, into a capture's ``truth`` folder.

    Raises:
        OSError: the file cannot be written.
    """
    write_json(folder / _FILE, {name: asdict(camera) for name, camera in cameras.items()})


def load_disturbances(folder: str | Path) -> dict[str, CameraDisturbance]:
    """Read the disturbance of each camera, by name, from a capture's ``truth`` folder.

    Raises:
        FileNotFoundError: the folder has no such file.
        ValueError: the file is broken.
    """
    path = Path(folder) / _FILE
    content = read_json(path)
    try:
        return {name: CameraDisturbance(**entry) for name, entry in content.items()}
    except (AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: expected the disturbances of each camera, got a broken file ({error})."
        ) from None
