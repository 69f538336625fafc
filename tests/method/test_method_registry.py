"""Registries of flow sources and mask refiners: look-up by string, and extension by one file."""

import os
import re
import shutil
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES
from morgs_mi.method.flow_sources.opencv_flow import FLOW_METHODS
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
from morgs_mi.method.method_registry import Registry
from tests.scenes.programs import run_script

ROOT = Path(__file__).parents[2]


@pytest.fixture
def registry():
    registry = Registry("paint()", "brush", int)
    registry.register("file", "PATH")(lambda argument, config: f"file {argument} {config}")
    registry.register("round")(lambda argument, config: f"round {argument}{config}")
    return registry


def test_registry__makes_what_a_string_selects(registry):
    assert registry.make("round", 3) == "round 3"
    assert registry.make("file:a:b.png", 3) == "file a:b.png 3"


def test_registry__makes_the_same_once(registry):
    registry.register("new")(lambda argument, config: object())
    assert registry.make("new", 1) is registry.make("new", 1)
    assert registry.make("new", 1) is not registry.make("new", 2)


def test_registry__lists_names_without_argument_first(registry):
    assert registry.usages == ("round", "file:PATH")


@pytest.mark.parametrize("text", ["flat", "file:", "round:3"])
def test_registry__rejects_other_strings_with_the_known_ones(registry, text):
    with pytest.raises(
        ValueError, match=rf"^paint\(\): `brush` must be one of round, file:PATH, got '{text}'\.$"
    ):
        registry.make(text, 3)


@pytest.mark.parametrize(
    ("name", "message"), [("", "got ''"), ("a:b", "got 'a:b'"), ("round", "got 'round'")]
)
def test_registry__rejects_bad_and_taken_names(registry, name, message):
    with pytest.raises(ValueError, match=message):
        registry.register(name)


def test_motion_config__refuses_names_that_are_not_registered():
    for setting in ("flow_method", "mask_method", "model"):
        with pytest.raises(ValueError, match=rf"^MotionConfig\(\): `{setting}` must be one of"):
            morgs_mi.MotionConfig(**{setting: "x"})


@pytest.mark.parametrize(
    ("page", "registry", "line"),
    [("flow.md", FLOW_SOURCES, "`{}`"), ("masks.md", MASK_REFINERS, "- `{}`: ")],
)
def test_registry__is_listed_on_its_page(page, registry, line):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert [usage for usage in registry.usages if line.format(usage) not in text] == []
    assert {*FLOW_METHODS} < {*FLOW_SOURCES.usages}


# Both run in a copy of the package, in which the page's example is one more module.
FLOW = """
import numpy as np
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair
source = FLOW_SOURCES.make(MotionConfig(flow_method="constant:3,0").flow_method)
flow, forward_flow = source(FramePair(*np.zeros((2, 4, 5, 3))))
assert flow.shape == forward_flow.shape == (4, 5, 2)
assert (forward_flow == (3, 0)).all() and (flow == (-3, 0)).all()
"""
MASKS = """
import sys
import numpy as np
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
mask = np.zeros((9, 9), bool)
mask[4, 4] = True
refiner = MASK_REFINERS.make(MotionConfig(mask_method="dilate:1").mask_method)
assert refiner(np.zeros((9, 9, 3)), mask).sum() == 5
assert "onnxruntime" not in sys.modules  # imported by the refiner that needs it
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "module", "program"),
    [
        ("flow.md", "flow_sources/constant.py", FLOW),
        ("masks.md", "mask_refiners/dilate.py", MASKS),
    ],
)
def test_registry__finds_a_new_module_of_its_package(tmp_path, page, module, program):
    shutil.copytree(
        Path(morgs_mi.__file__).parent,
        tmp_path / "morgs_mi",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    (example,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.DOTALL
    )
    (tmp_path / "morgs_mi/method" / module).write_text(example, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    result = run_script(program, cwd=tmp_path, env=environment)
    assert result.returncode == 0, result.stderr
