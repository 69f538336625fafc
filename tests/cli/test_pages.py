"""The commands of the README and of the pages run as they stand there, on small clips with few
steps.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.capture.capture import load_capture
from morgs_mi.io.ply import write_ply
from morgs_mi.playback.visualise import write_png
from tests.quick import SHORT_FITS
from tests.scenes.changing_splats import splats

ROOT = Path(__file__).parents[2]
# Appended to a command, which then takes seconds.
SMALLER = {
    "synth": "--cameras 7 --frames 3 --width 160 --height 120 --spp 4",
    "fit": "--num-gaussians 1500 --first-frame-steps 60 --epochs 1",
    "live": "--calibration CAPTURE --frames 2 --first-frame-steps 30 --epochs 1",
    "demo": "--frames 3 --cameras 7 --width 160 --height 120 --spp 4",
    "render": "--width 240",
}
GUIDES = ("quickstart", "splat-files", "captures", "cameras")
PAGES = ("README.md", *(f"docs/{name}.md" for name in GUIDES))
# Commands that never end, or write outside of the folder.
LEFT_OUT = ("morgs-mi view", "morgs-mi --tyro-write-completion")


def commands(page):
    """Return the commands of a page, without comments."""
    lines = re.findall(
        r"^    (morgs-mi .*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE
    )
    return [line.partition("#")[0].strip() for line in lines if not line.startswith(LEFT_OUT)]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A folder with what stands for the names in capitals: a capture, its first images, and the
    clips alone; and files of Gaussians.
    """
    folder = tmp_path_factory.mktemp("recordings")
    morgs_mi.synthesize(
        "spheres",
        folder / "CAPTURE",
        morgs_mi.SynthConfig(cameras=7, frames=6, width=240, height=180, spp=8),
    )
    (folder / "FOLDER").mkdir()
    (folder / "frames").mkdir()
    capture = load_capture(folder / "CAPTURE")
    for name, image in zip(capture.names, next(capture.frames(0, 1)).images, strict=True):
        shutil.copy(folder / "CAPTURE" / f"{name}.mp4", folder / "FOLDER")
        write_png(folder / "PHOTOS" / f"{name}.png", image)
    shutil.copytree(folder / "CAPTURE", folder / "my_capture")
    for name in ("scene", "a", "b", "frames/0", "frames/1"):
        write_ply(folder / f"{name}.ply", splats(degree=3))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands__of_a_page_run_to_the_end(page, recordings, tmp_path, run, monkeypatch):
    shutil.copytree(recordings, tmp_path / "there")
    monkeypatch.chdir(tmp_path / "there")
    # Of `info --time`, which has no options.
    monkeypatch.setattr("morgs_mi.extras.calibration.timing.GAUSSIANS", 500)
    monkeypatch.setattr("morgs_mi.extras.calibration.timing.STEPS", 40)
    cameras = " ".join(str(clip) for clip in sorted(Path("CAPTURE").glob("*.mp4")))
    lines = commands(page)
    assert lines, f"{page} has no commands"
    for command in lines:
        short_command = command.replace("--camera 0 1 2 3", f"--camera {cameras}").replace(
            " > settings.toml", ""
        )
        if "--refine-cameras" in command:
            Path("short.toml").write_text(SHORT_FITS, encoding="utf-8")
            short_command += " --config short.toml"
        name, *rest = shlex.split(short_command)[1:]
        status, output, error = run(name, *rest, *shlex.split(SMALLER.get(name, "")))
        assert status == 0, f"{short_command}\n{error}"
        if command.endswith("settings.toml"):
            Path("settings.toml").write_text(output, encoding="utf-8")
