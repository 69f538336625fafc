"""Settings of a synthetic capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from morgs_mi.core.checks import check_number
from morgs_mi.synth.disturbances import Disturbances

if TYPE_CHECKING:
    from morgs_mi.synth.scene import RecordingDefaults

__all__ = ["SynthConfig"]

_INTERVALS = {
    "cameras": "[2, inf)",
    "frames": "[1, inf)",
    "spp": "[1, inf)",
    "noise": "[0, 1)",
    "fps": "(0, inf)",
    "seed": "[0, inf)",
}


@dataclass(frozen=True)
class SynthConfig:
    """Size, length and disturbances of a synthetic capture."""

    cameras: int | None = None
    """Number of cameras, the held-out cam00 included; the scene's own, usually 10, if not given."""
    frames: int = 12
    """Number of frames per camera."""
    width: int = 320
    """Width of the images in pixels, even."""
    height: int = 240
    """Height of the images in pixels, even."""
    spp: int | None = None
    """Samples per pixel; 16 gives noise at 42 dB. The scene's own, usually 16, if not given."""
    noise: float | None = None
    """Standard deviation of sensor noise as a share of white; an indoor camera has 0.01, 2.5 grey levels. The scene's
    own, usually 0, if not given."""
    fps: float = 30.0
    """Frames per second."""
    lossless: bool = True
    """Also write the frames as PNG files, which are read in place of the compressed videos."""
    animation: str | None = None
    """Animation of a glTF file; its first, if not given."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    """Disturbances of the recording."""
    seed: int = 0
    """Seed of textures, sampling noise, disturbances and the choice of points; of everything in the scene random."""

    def check(self) -> None:
        """Raise an error unless all settings are in range.

        Raises:
            ValueError: they are not.
        """
        for name, interval in _INTERVALS.items():
            if getattr(self, name) is not None:
                check_number("synthesize()", name, getattr(self, name), interval)
        if min(self.width, self.height) < 2 or self.width % 2 or self.height % 2:
            raise ValueError(f"synthesize(): `width` and `height` must be even, got {self.width}x{self.height}.")

    def completed(self, recording: RecordingDefaults) -> SynthConfig:
        """Return the settings with the scene's own ones where none are given."""
        own = {"cameras": recording.num_cameras, "spp": recording.spp, "noise": recording.noise}
        return replace(self, **{name: value for name, value in own.items() if getattr(self, name) is None})

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as they stand in `capture.json`."""
        values = asdict(self)
        return {"num_cameras": values.pop("cameras"), "num_frames": values.pop("frames"), **values}
