"""The front door: what `import morgs_mi` provides."""

from __future__ import annotations

import ast
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import morgs_mi
from tests.scenes.cameras import QUAD, look_at_cameras

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
    names = subprocess.run(
        [sys.executable, "-c", IMPORT], capture_output=True, text=True, check=True
    ).stdout.split()
    assert sum(name.startswith("morgs_mi") for name in names) <= 15
    assert not {"cv2", "scipy", "pycolmap", "colour", "rich", "tyro", "OpenEXR"} & set(names)


def test_front_door__completes_the_public_names():
    assert dir(morgs_mi) == sorted(morgs_mi.__all__)


def test_front_door__names_are_documented():
    for name in morgs_mi.__all__:
        if name not in ("SH_C0", "render_lock"):  # data, which has no docstring at run time
            assert inspect.getdoc(getattr(morgs_mi, name)), name


@pytest.mark.parametrize("name", WITH_EXAMPLE)
def test_front_door__examples_compile(name):
    lines = re.findall(
        r"^\s*(?:>>>|\.\.\.) ?(.*)$", inspect.getdoc(getattr(morgs_mi, name)) or "", re.MULTILINE
    )
    assert lines
    assert any("morgs_mi." in line for line in lines)
    ast.parse("\n".join(lines))


def test_front_door__has_what_readme_and_notebooks_import():
    code = "\n".join(
        re.findall(
            r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
        )
    )
    for path in ("01_render", "02_stream"):
        cells = json.loads((ROOT / f"notebooks/{path}.ipynb").read_text(encoding="utf-8"))["cells"]
        code += "\n" + "\n".join(
            "".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"
        )
    lines = [line for line in code.splitlines() if not line.startswith("%")]
    imports = [
        node for node in ast.walk(ast.parse("\n".join(lines))) if isinstance(node, ast.ImportFrom)
    ]
    inner = [node.module for node in imports if (node.module or "").startswith("morgs_mi.")]
    assert inner == []


def test_front_door__reprs_are_short():
    stream = morgs_mi.open_stream(ROOT / "tests/codec/streams/version2.morgs")
    packet = next(iter(stream))
    report = morgs_mi.FrameReport(3, 1.25, 400, {"recon": 0.1}, 20)
    loop = morgs_mi.StreamLoop(look_at_cameras(QUAD), [], [])
    assert repr(stream).startswith(f"PlayableStream('{stream.path}', ")
    assert f"{len(stream.cameras)} cameras, {stream.fps:g} frames per second)" in repr(stream)
    assert repr(packet) == f"Packet(KEYFRAME, frame 0, {len(packet.arrays)} arrays)"
    assert repr(report) == "FrameReport(frame 3, 20 Gaussians, 400 bytes, 1.2 s, ok)"
    assert repr(loop) == "StreamLoop(4 cameras, frame 0 is next, None)"


@pytest.mark.parametrize(
    "method", [{"flow_method": "files:none"}, {"mask_method": "sam2:a.onnx,b.onnx"}]
)
def test_stream_loop__refuses_missing_files_before_the_first_frame(method):
    config = morgs_mi.StreamConfig(motion=morgs_mi.MotionConfig(**method))
    with pytest.raises(FileNotFoundError):
        morgs_mi.StreamLoop(look_at_cameras(QUAD), [], [], config)
