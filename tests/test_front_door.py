"""The front door: what `import morgs_mi` provides."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import morgs_mi
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.programs import run_script

ROOT = Path(__file__).parents[1]
WITH_EXAMPLE = (
    "Camera",
    "Gaussians",
    "StreamConfig",
    "StreamLoop",
    "ellipsoids",
    "load_capture",
    "open_stream",
    "rasterize",
)


# Prints the modules that `import morgs_mi` loads and `import mitsuba` does not.
IMPORT = """
import sys
import mitsuba
before = set(sys.modules)
import morgs_mi
print(*(set(sys.modules) - before))
"""


def test_front_door__is_lazy():
    names = run_script(IMPORT, check=True).stdout.split()
    own_names = [name for name in names if name.startswith("morgs_mi")]
    assert len([name for name in own_names if not name.startswith("morgs_mi.extras")]) <= 16
    assert all(name.count(".") <= 2 for name in own_names if name.startswith("morgs_mi.extras"))
    assert not {"cv2", "scipy", "pycolmap", "colour", "rich", "tyro", "OpenEXR"} & set(names)


def test_front_door__completes_the_public_names():
    assert dir(morgs_mi) == sorted(morgs_mi.__all__)


def test_front_door__names_are_documented():
    for name in morgs_mi.__all__:
        if name not in ("SH_C0", "render_lock"):  # data, which has no docstring at run time
            assert inspect.getdoc(getattr(morgs_mi, name)), name


@pytest.mark.parametrize("name", WITH_EXAMPLE)
def test_front_door__examples_compile(name):
    doc = inspect.getdoc(getattr(morgs_mi, name)) or ""
    code = "\n".join(re.findall(r"^\s*(?:>>>|\.\.\.) ?(.*)$", doc, re.MULTILINE))
    assert "morgs_mi." in code
    ast.parse(code)


@pytest.mark.parametrize(
    "path", ["README.md", "notebooks/01_render.ipynb", "notebooks/02_stream.ipynb"]
)
def test_front_door__has_what_readme_and_notebooks_import(path):
    text = (ROOT / path).read_text(encoding="utf-8")
    assert "morgs_mi" in text
    assert re.findall(r"(?:from|import) morgs_mi\.\w+", text) == []


def test_front_door__reprs_are_short():
    stream = morgs_mi.open_stream(ROOT / "tests/codec/streams/version2.morgs")
    packet = next(iter(stream))
    assert repr(stream).startswith(f"PlayableStream('{stream.path}', ")
    assert f"{len(stream.cameras)} cameras, {stream.fps:g} frames per second)" in repr(stream)
    for value, text in (
        (packet, f"Packet(KEYFRAME, frame 0, {len(packet.arrays)} arrays)"),
        (
            morgs_mi.FrameReport(3, 1.25, 400, {"recon": 0.1}, 20),
            "FrameReport(frame 3, 20 Gaussians, 400 bytes, 1.2 s, ok)",
        ),
        (
            morgs_mi.StreamLoop(look_at_cameras(QUAD), [], []),
            "StreamLoop(4 cameras, frame 0 is next)",
        ),
    ):
        assert repr(value) == text


@pytest.mark.parametrize(
    "method", [{"flow_method": "files:none"}, {"mask_method": "sam2:a.onnx,b.onnx"}]
)
def test_stream_loop__refuses_missing_files_before_the_first_frame(method):
    config = morgs_mi.StreamConfig(motion=morgs_mi.MotionConfig(**method))
    with pytest.raises(FileNotFoundError):
        morgs_mi.StreamLoop(look_at_cameras(QUAD), [], [], config)
