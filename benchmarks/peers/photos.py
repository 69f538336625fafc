"""Photos of a static scene: the held-out photo over the processor seconds of OpenSplat and of this package.

    benchmarks/peers/build.sh FOLDER
    python -m benchmarks.peers.photos fern --folder FOLDER --seconds 60 120 300 --json photos.json

CAPTURE is a folder of photos with COLMAP's `sparse/0`. Both programs get the same poses and points; the test view of
the capture is held out. OpenSplat takes principal points for the centres of the images. Therefore a bundle adjustment
moves them there first, for both programs.

OpenSplat stores its Gaussians again and again, and this package renders all of them. Seconds are processor time divided
by the number of threads, because other programs may run on the machine.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pycolmap
import tyro

from benchmarks.speed.output import Output
from morgs_mi import rasterize
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.evaluate.metrics import psnr_of
from morgs_mi.io.ply import read_ply
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.stream_loop import StreamLoop

_SAVE_EVERY = 20  # steps


@dataclass(frozen=True)
class Options(Output):
    """Photos, budget and output."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of photos with poses."""
    folder: Path = Path("peers")
    """Folder in which `build.sh` has built OpenSplat."""
    seconds: tuple[int, ...] = (60, 120, 300)
    """Seconds after which the photo is compared, in ascending order."""
    downscale: float = 1
    """Factor by which the photos are reduced."""
    test_view: str = "auto"
    """Index or name of the held-out photo; "auto" is the first one of at least six."""


def held_out_psnr(capture: Capture, gaussians: Gaussians) -> float:
    """Return PSNR, dB, of the test view."""
    assert capture.test_views
    truth = np.asarray(next(capture.frames()).images[capture.reference_view], np.float32) / 255
    image = np.clip(np.asarray(rasterize(gaussians, capture.cameras[capture.reference_view], ("color",)).color), 0, 1)
    return round(psnr_of(((image - truth) ** 2).mean()), 2)


def opensplat(project: Path, capture: Capture, photo: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row of seconds, step, Gaussians and PSNR at each budget; `photo` is the name of the test view."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "splat.ply"
        command = [options.folder / "OpenSplat" / "build" / "opensplat", project, "-o", out, "-n", "30000", "--cpu"]
        command += ["-s", str(_SAVE_EVERY), "-d", str(options.downscale), "--val"]
        command += ["--val-image", next(p.name for p in (project / "images").glob(f"{photo}.*"))]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            try:
                for seconds in options.seconds:
                    while (spent := processor_seconds(process.pid)) < seconds:
                        time.sleep(0.5)
                        if process.poll() is not None:
                            raise SystemExit(
                                f"{command[0]}: expected a fit of {seconds} s, got exit {process.returncode}."
                            )
                    stored = sorted(Path(name).glob("splat_*.ply"), key=lambda p: int(p.stem.split("_")[1]))
                    if stored:
                        gaussians, step = read_ply(stored[-1]), int(stored[-1].stem.split("_")[1])
                        psnr = held_out_psnr(capture, gaussians)
                        memory = peak_megabytes(process.pid)
                        yield {
                            "seconds": round(spent),
                            "steps": step,
                            "gaussians": len(gaussians),
                            "psnr": psnr,
                            "mb": memory,
                        }
            finally:
                process.kill()


def peak_megabytes(pid: int) -> int:
    """Return the largest resident memory that a process has had, MB (Linux)."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmHWM"))
    return round(int(line.split()[1]) / 1e3)


def centred_project(path: Path, folder: Path) -> Path:
    """Write the photos of a capture and their poses with centred principal points, and return the folder."""
    model, options = pycolmap.Reconstruction(path / "sparse" / "0"), pycolmap.BundleAdjustmentOptions()
    for camera in model.cameras.values():
        camera.principal_point_x, camera.principal_point_y = camera.width / 2, camera.height / 2
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images").symlink_to(path.resolve())
    model.write_binary(folder / "sparse" / "0")
    return folder


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process, divided by the number of threads (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") / dr.thread_count()


def ours(capture: Capture) -> dict[str, Any]:
    """Return the row of this package's default first frame."""
    start = processor_seconds(os.getpid())
    loop = StreamLoop.of(capture, StreamConfig())
    loop.push([next(capture.frames()).images[v] for v in capture.train_views])
    spent = processor_seconds(os.getpid()) - start
    assert loop.gaussians is not None
    return {
        "seconds": round(spent),
        "gaussians": len(loop.gaussians),
        "psnr": held_out_psnr(capture, loop.gaussians),
        "mb": peak_megabytes(os.getpid()),
    }


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant("llvm_ad_rgb")
    rows = []
    for path in options.captures:
        with tempfile.TemporaryDirectory() as name:
            project = centred_project(path, Path(name) / "project")
            capture = load_capture(project, options.downscale, options.test_view)
            if not capture.test_views:
                raise SystemExit(f"{path}: expected a held-out photo, found none; give one with --test-view.")
            photo = capture.names[capture.reference_view]
            names = {"capture": path.name, "photo": photo}
            rows.append({**names, "program": "ours", **ours(capture)})
            print(rows[-1], flush=True)
            for row in opensplat(project, capture, photo, options):
                rows.append({**names, "program": "OpenSplat 1.2.0", **row})
                print(rows[-1], flush=True)
    options.write({"threads": dr.thread_count(), "fits": rows})


if __name__ == "__main__":
    main(tyro.cli(Options))
