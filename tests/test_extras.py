"""Extras enter themselves: each can be deleted, and other packages can add some."""

import os
import shutil
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.core.extras import extra, places
from tests.scenes.programs import run_script

PACKAGE = Path(morgs_mi.__file__).parent
REGISTRIES = (
    "commands",
    "exports",
    "integrators",
    "renderings",
    "layouts",
    "image checks",
    "camera refinement",
    "flow sources",
    "mask refiners",
    "image distances",
)
# The spine: the renderer in both forms, a capture, a fit, its scores, a page and the viewer.
SPINE = """
import sys
from threading import Thread
from urllib.request import urlopen
import mitsuba as mi, numpy as np
import morgs_mi
mi.set_variant("llvm_ad_rgb")
from morgs_mi.cli.main import COMMANDS, main
from morgs_mi.cli.export import EXPORTS
from morgs_mi.playback.viewer.server import Viewer
from tests.quick import quick

assert not {"info", "demo", "synth"} & set(COMMANDS) and set(EXPORTS) == {"ply", "video", "web"}
capture = morgs_mi.load_capture(sys.argv[1])
assert capture.layout == "COLMAP"
morgs_mi.stream_capture(capture, "fit", quick())
stream = morgs_mi.open_stream("fit")
gaussians = stream.seek(1).gaussians
camera = stream.cameras[0]
image = np.array(morgs_mi.rasterize(gaussians, camera).color)
integrator = {"type": "gaussian_splat"}
shape = morgs_mi.ellipsoids(gaussians)
entries = {"type": "scene", "shape": shape, "sensor": camera.sensor(), "integrator": integrator}
scene = mi.load_dict(entries)
assert np.array(mi.render(scene)).shape == image.shape
assert morgs_mi.evaluate_stream("fit").num_frames == capture.num_frames
assert main(["export", "web", "fit", "page.html"]) == 0
assert main(["eval", "fit", "--lpips", "network.onnx"]) == 1
viewer = Viewer(stream)
Thread(target=viewer.run, daemon=True).start()
assert urlopen(viewer.url).status == 200
"""


def environment(*folders):
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}


def test_extras__can_all_be_deleted(tmp_path, fitted_clip):
    shutil.copytree(
        PACKAGE, tmp_path / "morgs_mi", ignore=shutil.ignore_patterns("extras", "__pycache__")
    )
    folders = environment(tmp_path, PACKAGE.parent)
    result = run_script(SPINE, fitted_clip / "capture", cwd=tmp_path, env=folders, timeout=300)
    assert result.returncode == 0, result.stderr
    assert "expected an extra that adds lpips, found none" in result.stderr


def test_extras__of_another_package_register_by_an_entry_point(tmp_path):
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "__init__.py").write_text(
        "from morgs_mi.core.extras import enter\n"
        "def register(): enter(__name__, 'flow sources', {'zero:FILE': 'flow:zero'})\n"
    )
    metadata = tmp_path / "stranger-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text(
        "[morgs_mi.extras]\nstranger = stranger:register\nbroken = stranger:missing\n"
    )
    code = (
        "from morgs_mi.method import flow_sources as s; print('zero' in str(vars(s.FLOW_SOURCES)))"
    )
    result = run_script(code, env=environment(tmp_path, PACKAGE.parent), timeout=60)
    assert result.stdout == "True\n"
    assert "stranger:missing: this extra is left out" in result.stderr


@pytest.mark.parametrize("registry", REGISTRIES)
def test_extras__all_places_exist(registry):
    assert places(registry)
    assert all(extra(registry, name) is not None for name in places(registry))
