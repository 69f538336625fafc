"""Settings of a synthetic capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge, Gt, Le, Lt, MultipleOf

from morgs_mi.extras.synth.disturbances import Disturbances
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.config import Count, NonNegativeInt
from morgs_mi.platform.documentation import documented

if TYPE_CHECKING:
    from morgs_mi.extras.synth.scene import RecordingDefaults


@documented
@dataclass(frozen=True)
class SynthConfig:
    """Size, length and disturbances of a synthetic capture."""

    cameras: Annotated[int, Ge(2)] | None = None
    """Number of cameras, the held-out cam00 included; the scene's own, usually 10, if not given."""
    frames: Count = 12
    """Number of frames per camera."""
    width: Annotated[int, Ge(2), MultipleOf(2)] = 320
    """Width of the images in pixels, even."""
    height: Annotated[int, Ge(2), MultipleOf(2)] = 240
    """Height of the images in pixels, even."""
    # A sampler of Mitsuba takes no more.
    spp: Annotated[int, Ge(1), Le(1_000_000)] | None = None
    """Samples per pixel; 16 gives noise at 42 dB. The scene's own, usually 16, if not given."""
    noise: Annotated[float, Ge(0), Lt(1)] | None = None
    """Standard deviation of sensor noise as a share of white; an indoor camera has 0.01, 2.5 grey
    levels. The scene's own, usually 0, if not given."""
    # The encoders of videos take no more.
    fps: Annotated[float, Gt(0), Le(1000)] = 30.0
    """Frames per second."""
    lossless: bool = True
    """Also write the frames as PNG files, which are read in place of the compressed videos."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    """Disturbances of the recording."""
    seed: NonNegativeInt = 0
    """Seed of textures, sampling noise, disturbances and the choice of points; of everything in the
    scene random.
    """

    def completed(self, recording: RecordingDefaults) -> SynthConfig:
        """Return the settings, with the scene's own values for missing ones."""
        return replace(
            self,
            cameras=self.cameras or recording.num_cameras,
            spp=self.spp or recording.spp,
            noise=recording.noise if self.noise is None else self.noise,
        )

    def as_dict(self) -> JsonObject:
        """Return the settings as stored in `capture.json`."""
        values = asdict(self)
        return {"num_cameras": values.pop("cameras"), "num_frames": values.pop("frames"), **values}
