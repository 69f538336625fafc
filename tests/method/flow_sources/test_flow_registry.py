"""Flow sources by name, and the page that describes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FlowConfig
from morgs_mi.method.flow_sources.opencv_flow import FLOW_METHODS

ROOT = Path(__file__).parents[3]


def test_flow_source__is_cached_by_name_and_config():
    assert FLOW_SOURCES.make("dis") is FLOW_SOURCES.make("dis", FlowConfig())
    assert FLOW_SOURCES.make("dis") is not FLOW_SOURCES.make("dis", FlowConfig(fine_width=0))


def test_flow_sources__include_every_method_of_opencv():
    assert FLOW_SOURCES.usages[: len(FLOW_METHODS)] == tuple(FLOW_METHODS)


@pytest.mark.parametrize("method", ["raft", "files", "files:", "dis:", "dis:1", "", ":FLOW"])
def test_flow_source__rejects_unknown_methods_with_the_known_ones(method):
    names_text = (
        "one of dis, dis-fine, .*, files:FOLDER, onnx:FILE, onnx-unit:FILE, onnx-signed:FILE, got "
    )
    with pytest.raises(
        ValueError, match=rf"MotionConfig\(\): `flow_method` must be {names_text}{method!r}\."
    ):
        FLOW_SOURCES.make(method)


def test_flow_page__lists_every_source():
    text = (ROOT / "docs/flow.md").read_text(encoding="utf-8")
    assert [usage for usage in FLOW_SOURCES.usages if f"`{usage}`" not in text] == []
