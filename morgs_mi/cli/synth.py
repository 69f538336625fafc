"""`morgs-mi synth`: a synthetic capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import Flag, optional
from morgs_mi.synth.disturbances import Disturbances

__all__ = ["Synth"]


@dataclass(frozen=True)
class Synth:
    """Path-trace a moving scene into a multi-view capture with exact ground truth."""

    scene: Positional[str]
    """Name of a scene (spheres, arm, thin, flicker, random), or path of an animated glTF file (.glb, .gltf) or of a
    Python file with a function build(seed)."""
    out: Positional[Path]
    """New folder for the capture."""
    cameras: Annotated[int | None, DisallowNone] = None
    """Number of cameras, the held-out cam00 included; the scene's own, usually 10, if not given."""
    frames: int = 12
    """Number of frames per camera."""
    width: int = 320
    """Width of the images in pixels, even."""
    height: int = 240
    """Height of the images in pixels, even."""
    spp: Annotated[int | None, DisallowNone] = None
    """Samples per pixel; 16 gives noise at 42 dB. The scene's own, usually 16, if not given."""
    noise: Annotated[float | None, DisallowNone] = None
    """Standard deviation of sensor noise as a share of white; an indoor camera has 0.01, 2.5 grey levels. The scene's
    own, usually 0, if not given."""
    fps: float = 30.0
    """Frames per second."""
    lossless: bool = True
    """Also write the frames as PNG files, which are read in place of the compressed videos."""
    animation: Annotated[str | None, optional("NAME")] = None
    """Animation of a glTF file; its first, if not given."""
    disturbances: Annotated[Disturbances, arg(name="")] = field(default_factory=Disturbances)
    """Disturbances of the recording."""
    seed: int = 0
    """Seed of textures, sampling noise, disturbances and the choice of points; of everything in the scene random."""
    overwrite: Flag = False
    """Replace an earlier synthetic capture in OUT."""

    arguments: ClassVar[Mapping[str, str]] = {"num_cameras": "--cameras", "num_frames": "--frames"}

    def run(self) -> None:
        from morgs_mi.synth.synthesize import synthesize

        with progress() as report:
            synthesize(
                self.scene,
                self.out,
                num_cameras=self.cameras,
                num_frames=self.frames,
                width=self.width,
                height=self.height,
                spp=self.spp,
                noise=self.noise,
                fps=self.fps,
                lossless=self.lossless,
                disturbances=self.disturbances,
                animation=self.animation,
                seed=self.seed,
                overwrite=self.overwrite,
                progress=lambda done, total: report("Path-tracing", done, total),
            )
        images = "PNG files and videos" if self.lossless else "videos"
        cameras = len(list((self.out / "truth").glob("cam*")))
        print_result(
            f"{self.out}: {cameras} cameras, {self.frames} frames of {self.width}x{self.height} as {images}, with "
            "ground truth."
        )
