"""Commands that run in a folder of foreign files execute none of them."""

import os
import re
import shlex
import signal
import subprocess
import sys
import sysconfig
from importlib.metadata import packages_distributions
from pathlib import Path
from urllib.request import urlopen

import mitsuba as mi
import pytest

from morgs_mi.cli.main import COMMANDS
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.io.ply import write_ply
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.llvm import VARIABLE
from tests.quick import OPTIONS, SHORT_FITS
from tests.scenes import changing_splats, noise_capture

PROGRAM = Path(sysconfig.get_path("scripts"), "morgs-mi")
SHORT = shlex.join(OPTIONS)
SETTINGS = f"""\
[fit]
num_gaussians = 80
first_frame_steps = 8
epochs = 1
{SHORT_FITS}"""
CUBE = '<scene version="3.0.0"><shape type="cube"><bsdf type="diffuse"/></shape></scene>'
SMALL = "--cameras 4 --frames 2 --width 64 --height 48 --spp 1"
# For each command, one that loads much. `fit` and `live` start processes.
LINES = {
    "fit": f"fit capture fit --chunks 2 {SHORT}",
    "render": "render a.ply a.png --camera 0 --insert ../own/cube.xml --samples 1",
    "export": "export web a.ply a.html",
    "view": "view a.ply --no-browser",
    "eval": "eval a.morgs --capture capture --any-recording",
    "accuracy": "accuracy a.ply",
    "info": "info capture --plot rig.png",
    "calibrate": "calibrate capture --overwrite",
    "demo": f"demo demo {SMALL} --config short.toml",
    "import": "import a.ply a.ply imported",
    "live": "live live --camera capture/cam0.mkv capture/cam1.mkv capture/cam2.mkv "
    f"--calibration capture --frames 4 --view --no-browser {SHORT}",
    "sweep": "sweep capture --presets default --epochs 1 --seeds 1 --frames 2 --config short.toml",
    "synth": f"synth spheres synth {SMALL}",
}
# Commands that fail with this capture, after they have loaded all that they need.
FAILING = {"calibrate"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a capture and a file of Gaussians, in which each module that Python could
    import and each plugin that Mitsuba could load has a foreign file of its name.
    """
    folder = tmp_path_factory.mktemp("folders") / "foreign"
    folder.mkdir()
    capture = noise_capture.write_capture(folder / "capture")
    for name in noise_capture.NAMES:
        write_video(capture / f"{name}.mkv", noise_capture.clip(4), 25)
    with StreamWriter(folder / "a.morgs", noise_capture.rig(), 25) as writer:
        writer.write(keyframe_packet(changing_splats.splats(), 0))
    write_ply(folder / "a.ply", changing_splats.splats())
    # Mitsuba also loads plugins that are beside a scene file.
    (folder.parent / "own").mkdir()
    (folder.parent / "own/cube.xml").write_text(CUBE)
    (folder / "short.toml").write_text(SETTINGS)
    for name in {*sys.stdlib_module_names, *packages_distributions(), "sitecustomize"}:
        write_module(folder / f"{name}.py", folder / "executed")
    (folder / "plugins").mkdir()
    for plugin in Path(mi.__file__).parent.glob("plugins/*.so"):
        (folder / "plugins" / plugin.name).write_text("no library, so that loading it fails")
    return folder


def write_module(path, marker):
    """Write a module that adds its name to the file `marker`, and cannot be imported."""
    path.write_text(f"open({str(marker)!r}, 'a').write(__name__ + '\\n'); raise ImportError")


def start(folder, line):
    """Start a command in the folder, where the user's choice of LLVM is one that is refused."""
    (folder / "executed").unlink(missing_ok=True)
    choice = folder / "libLLVM-15.so.1"
    choice.touch()
    return subprocess.Popen(
        [sys.executable, PROGRAM, *shlex.split(line)],
        cwd=folder,
        env={**os.environ, VARIABLE: str(choice), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell ignores SIGINT for the processes that it starts in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def check_nothing_executed(folder, process):
    """Wait for the end of a command, and return what it printed as errors."""
    error = process.communicate(timeout=300)[1]
    executed = folder / "executed"
    assert not executed.exists(), executed.read_text().split()
    assert "libLLVM-15.so.1 is no libLLVM" in error
    assert "Traceback" not in error
    return error


def test_morgs_mi__executes_no_file_of_the_current_folder(folder):
    process = start(folder, "info a.ply")
    error = check_nothing_executed(folder, process)
    assert process.returncode == 0, error


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_command__executes_no_file_of_the_current_folder(folder, command):
    process = start(folder, LINES[command])
    if command == "view":
        assert process.stdout
        address = re.match("http://[^ ]*", process.stdout.readline())
        with urlopen(address[0]) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
    error = check_nothing_executed(folder, process)
    expected = 130 if command == "view" else 1 if command in FAILING else 0
    assert process.returncode == expected, error
