"""The blocks of docs/mitsuba.md run, and its tables name the properties and channels that exist."""

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.render.channels import aov_names, channel_sizes, exr_names, required_attributes
from morgs_mi.surfaces import gaussian_splat

TEXT = (Path(__file__).parents[2] / "docs/mitsuba.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
FILES = dict(re.findall(r"<!-- file ([^ ]+) -->\n```\w+\n(.*?)```", TEXT, re.DOTALL))


def rows(title):
    """Return the names in the first column of the table whose first column is `title`."""
    (table,) = re.findall(rf"^\| {title} \|.*\n((?:\|.*\n)+)", TEXT, re.MULTILINE)
    return set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE))


def test_mitsuba_page__blocks_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    space = {}
    for block in BLOCKS:
        exec(compile(block, "docs/mitsuba.md", "exec"), space)
        if "image = mi.render" in block:
            assert np.array(space["image"]).shape == (32, 48, 7)
            assert np.ptp(np.array(space["image"]), axis=(0, 1)).min() > 0.01, (
                "every channel shows something"
            )
    assert space["both"].shape == (32, 96, 7)
    space["test_gradient_of_data"]()
    assert not dr.grad_enabled(mi.Float(0))


def test_mitsuba_page__lists_all_properties():
    docstring = gaussian_splat.GaussianSplatIntegrator.__doc__
    properties = {
        name
        for names in re.findall(r"^ +\* - ([\w, ]+)$", docstring, re.MULTILINE)
        for name in names.split(", ")
    }
    assert rows(r"parameter \| type") == properties


def test_mitsuba_page__lists_all_channels():
    (row,) = re.findall(r"^\| `aovs` \|.*", TEXT, re.MULTILINE)
    assert set(re.findall(r"`(\w+)` \(", row)) == {*aov_names()}
    for channel in aov_names():
        assert all(f"`{name}`" in row for name in exr_names(channel, channel_sizes()[channel]))
        attribute = required_attributes()[channel]
        assert attribute is None or f"`SHAPE.{attribute.activated_name}`" in TEXT
