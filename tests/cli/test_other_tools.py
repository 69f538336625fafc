"""Folders of other tools, docs/captures.md: its commands run on a small recording in the folder of
each of them.
"""

import os
import re
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest

import morgs_mi
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.camera import Camera
from morgs_mi.platform.bounded import read_json
from morgs_mi.playback.visualise import write_png
from tests.quick import SHORT_FITS
from tests.scenes import captures as layouts

PAGE = (Path(__file__).parents[2] / "docs/captures.md").read_text(encoding="utf-8")
(BLOCK,) = re.findall(r"## Folders of other tools\n.*?```sh\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [line for line in BLOCK.splitlines() if not line.startswith("#")]
QUICK = "--num-gaussians 400 --first-frame-steps 20 --epochs 1 --config short.toml"
CAMERAS = 7
FRAMES = 2


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "spheres"
    morgs_mi.synthesize(
        "spheres",
        folder,
        morgs_mi.SynthConfig(cameras=CAMERAS, frames=FRAMES, width=320, height=240, spp=8),
    )
    return load_capture(folder)


def write_images(recording, name):
    """Write the images under names with {camera}, {frame} and {number}, which counts from 1."""
    for frame in recording.frames():
        for camera, image in zip(recording.names, frame.images, strict=True):
            write_png(
                Path(name.format(camera=camera, frame=frame.index, number=frame.index + 1)), image
            )


def dynerf(recording):
    write_images(recording, "dynerf/SCENE/{camera}/images/{frame:04d}.png")
    layouts.write_poses_bounds("dynerf/SCENE/poses_bounds.npy", recording.cameras)


def multipleview(recording):
    write_images(recording, "multipleview/SCENE/{camera}/frame_{number:05d}.png")
    # As 4DGaussians' script names them: in no particular order.
    other = [
        Camera(c.K, c.viewmat, c.width, c.height, f"image{i + 1}")
        for i, c in enumerate(recording.cameras[::-1])
    ]
    write_colmap("multipleview/SCENE/sparse_", other, recording.points)


def dynamic3dgs(_):
    layouts.dynamic3dgs(Path("dynamic3dgs/SCENE"))


def stream3dgs(recording):
    write_images(recording, "3dgstream/SCENE/frame{frame:06d}/images/{camera}.png")
    for frame in range(FRAMES):
        write_colmap(
            f"3dgstream/SCENE/frame{frame:06d}/sparse/0", recording.cameras, recording.points
        )


def nerfstudio(recording):
    first = next(iter(recording.frames()))
    cameras = []
    for i, (camera, image) in enumerate(zip(recording.cameras, first.images, strict=True), start=1):
        for folder in ("images", "images_2"):
            write_png(Path(f"nerfstudio/SCENE/{folder}/frame_{i:05d}.png"), image)
        cameras.append(replace(camera, name=f"images/frame_{i:05d}.png"))
    layouts.transforms(Path("nerfstudio/SCENE"), cameras)


def vggt(recording):
    """Photos, and a binary model in `sparse` itself."""
    first = next(iter(recording.frames()))
    for camera, image in zip(recording.cameras, first.images, strict=True):
        write_png(Path(f"vggt/SCENE/images/{camera.name}.png"), image)
    write_colmap("vggt/text", recording.cameras, recording.points)
    Path("vggt/SCENE/sparse").mkdir()
    pycolmap.Reconstruction("vggt/text").write_binary("vggt/SCENE/sparse")


@pytest.mark.slow
def test_folders_of_other_tools__are_fitted_by_the_commands(recording, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for write in (dynerf, multipleview, dynamic3dgs, stream3dgs, nerfstudio, vggt):
        write(recording)
    os.mkdir("out")
    Path("short.toml").write_text(SHORT_FITS, encoding="utf-8")
    frames = {}
    for command in COMMANDS:
        name, *rest = shlex.split(command)
        if name == "ln":
            subprocess.run([name, *rest], check=True)
            continue
        status, _, error = run(*rest, *(shlex.split(QUICK) if rest[0] == "fit" else ()))
        assert status == 0, f"{command}\n{error}"
        if rest[0] == "fit":
            frames[rest[2]] = len(read_json(Path(rest[2], "report.json"))["frames"])
    assert [frames.pop(f"out/{name}") for name in ("nerfstudio", "vggt")] == [1, 1]
    assert frames.pop("out/dynamic3dgs") == layouts.COUNT
    assert frames == {f"out/{name}": FRAMES for name in ("dynerf", "multipleview", "3dgstream")}


def test_folders_of_other_tools__have_a_command_each():
    assert len([command for command in COMMANDS if command.startswith("morgs-mi fit")]) == 6
