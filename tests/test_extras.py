"""Extras enter themselves: each can be deleted, and other packages can add some."""

import json
import os
import shutil
from pathlib import Path
from pkgutil import iter_modules

import pytest

import morgs_mi
from morgs_mi.platform.extras import extra, places
from tests.scenes.programs import run_script

PACKAGE = Path(morgs_mi.__file__).parent
REGISTRIES = (
    "commands",
    "exports",
    "integrators",
    "layouts",
    "cameras",
    "flow sources",
    "mask refiners",
)
EXTRAS = tuple(module.name for module in iter_modules([str(PACKAGE / "extras")]))
# The finder of an editable installation would look for a folder in the checkout.
ALONE = """
import sys
sys.meta_path = [f for f in sys.meta_path if "editable" not in getattr(f, "__module__", "")]
"""
# Collects the tests; those of benchmarks need extras, as benchmarks do.
COLLECT = """
import morgs_mi, pytest
left_out = [f"--ignore={sys.argv[1]}/{name}" for name in ("extras", "benchmarks")]
options = ["--collect-only", "--quiet", "-p", "no:cacheprovider", "-m", ""]
sys.exit(pytest.main([*options, *left_out, sys.argv[1]]))
"""
# Imports all modules of the package, runs the spine (the renderer in both forms, a capture, a fit,
# its scores, a page and the viewer), and prints what a user finds: commands, exports, options of
# two commands, and the errors of public names.
SPINE = """
import json, pkgutil
from dataclasses import fields
from importlib import import_module
from threading import Thread
from urllib.request import urlopen
import mitsuba as mi, numpy as np
import morgs_mi
mi.set_variant("llvm_ad_rgb")
from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import COMMANDS, main
from morgs_mi.playback.viewer.server import Viewer
from tests.quick import quick

for module in pkgutil.walk_packages(morgs_mi.__path__, "morgs_mi."):
    if module.name != "morgs_mi.__main__":
        import_module(module.name)
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
viewer = Viewer(stream)
Thread(target=viewer.run, daemon=True).start()
assert urlopen(viewer.url).status == 200
options = [f"--{field.name}" for name in ("fit", "render") for field in fields(COMMANDS[name])]
errors = []
for name in morgs_mi.__all__:
    try:
        getattr(morgs_mi, name)
    except ImportError as error:
        errors.append(str(error))
print(json.dumps([[*COMMANDS, *EXPORTS, *options], errors]))
"""
# What a folder brings: commands, exports, options and a public name.
PARTS = {
    "calibration": ["info", "calibrate"],
    "cluster": ["--chunks", "--scheduler"],
    "exports": ["gltf", "usd"],
    "imports": ["import"],
    "light": ["--insert", "--at", "--samples", "--shadows", "--light"],
    "live": ["live"],
    "sweep": ["sweep"],
    "synth": ["synth", "demo"],
}
NAMES = {
    "light": "light_probe",
    "live": "live_frames",
    "sweep": "leave_out",
    "synth": "synthesize",
}


def environment(*folders):
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}


def run_without(folder, script, argument, *names):
    """Run a script with a copy of the package without folders of it, and return its result."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, folder / "morgs_mi", ignore=ignored)
    for name in names:
        shutil.rmtree(folder / "morgs_mi" / name)
    env = environment(folder, PACKAGE.parent)
    result = run_script(ALONE + script, argument, cwd=folder, env=env, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return result


def test_extras__can_all_be_deleted(tmp_path, fitted_clip):
    result = run_without(tmp_path, SPINE, fitted_clip / "capture", "extras")
    parts, errors = json.loads(result.stdout.splitlines()[-1])
    assert not {*parts} & {part for names in PARTS.values() for part in names}
    for name in NAMES.values():
        assert (
            f"morgs_mi.{name}: expected the folder morgs_mi.extras, found none; install morgs_mi "
            "with all folders of extras."
        ) in errors


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRAS)
def test_extras__can_be_deleted_one_by_one(tmp_path, fitted_clip, name):
    result = run_without(tmp_path, SPINE, fitted_clip / "capture", f"extras/{name}")
    parts, errors = json.loads(result.stdout.splitlines()[-1])
    remaining = {part for other in PARTS for part in PARTS[other] if other != name}
    assert remaining <= {*parts}
    assert not {*PARTS.get(name, ())} & {*parts}
    assert all(f": expected the folder morgs_mi.extras.{name}, found" in e for e in errors)
    assert (name in NAMES) == any(f"morgs_mi.{NAMES.get(name)}: " in error for error in errors)


@pytest.mark.slow
def test_extras__are_not_needed_to_collect_the_tests_of_the_rest(tmp_path):
    result = run_without(tmp_path, COLLECT, PACKAGE.parent / "tests", "extras")
    assert "error" not in result.stdout.splitlines()[-1]


def test_extras__of_another_package_register_by_an_entry_point(tmp_path):
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "__init__.py").write_text(
        "from morgs_mi.platform.extras import enter\n"
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


def test_extra__names_what_no_extra_has():
    with pytest.raises(
        ValueError, match=r"^integrators: expected an extra that adds tracer, found none; install"
    ):
        extra("integrators", "tracer")
