"""Configs: ranges of fields, nested values, TOML files and the sentences of their errors."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, field
from math import nan
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt, MultipleOf

from morgs_mi.fit.fit_config import DensityConfig, FitConfig, LearningRates
from morgs_mi.loop.stream_config import PRESETS, StreamConfig, apply_preset
from morgs_mi.platform.config import (
    apply_values,
    config_class,
    config_toml,
    read_config,
)
from morgs_mi.render.render_config import RenderConfig


@config_class
class Config:
    """A field of every kind."""

    kind: ClassVar[str] = "not a field"

    count: Annotated[int, Ge(1)] = 8
    width: Annotated[int, Ge(4), MultipleOf(4)] | None = None
    share: Annotated[float, Gt(0), Le(1)] = 1.0
    opacity: Annotated[float, Ge(0), Lt(1)] | None = 0.5
    number: float = 0.0
    seed: int = 0
    on: bool = True
    name: str = ""
    """Name of
    the config."""
    mode: Literal["off", "auto", "on"] = "off"
    blurs: tuple[Annotated[float, Gt(0)], ...] = (6.0, 3.0)
    size: tuple[int, int] | None = None
    offset: dict[str, float] = field(default_factory=dict)


@pytest.mark.parametrize(
    "config",
    [
        *(apply_preset(StreamConfig(), name) for name in PRESETS),
        StreamConfig(
            fit=FitConfig(
                density=DensityConfig(rounds=0, births=1 / 3), rates=LearningRates(means=1e-300)
            ),
            render=RenderConfig(block_width=4, block_height=None),
        ),
        Config(
            number=3e38,
            name='"quoted" \\ \n\t\x00\x1b\x7f é 漢 🙂',
            blurs=(),
            opacity=None,
            mode="auto",
            size=(2, 3),
        ),
        Config(number=-0.0, seed=2**63, name="none"),
    ],
)
def test_config_toml__is_read_back_as_the_same_config(config, tmp_path):
    (tmp_path / "a.toml").write_text(config_toml(config), encoding="utf-8")
    values = read_config(tmp_path / "a.toml")
    assert apply_values(type(config)(), values, "a.toml") == config


def test_config_toml__has_every_setting_with_its_docstring():
    text = config_toml(StreamConfig())
    tables = tomllib.loads(text)

    def settings(config):
        return {
            name: settings(value) if isinstance(value, dict) else None
            for name, value in config.items()
        }

    assert settings(tables) == settings(asdict(StreamConfig()))
    lines = text.splitlines()
    for index, line in enumerate(lines):
        if line and not line.startswith("#"):
            assert lines[index - 1].startswith("# "), line
    assert max(map(len, lines)) <= 120
    assert "# Name of the config.\n" in config_toml(Config())


def test_apply_values__replaces_only_what_is_named():
    values = {"seed": 5, "fit": {"epochs": 2, "density": {"births": 1}}}
    config = apply_values(StreamConfig(fit=FitConfig(sh_degree=3)), values)
    density = DensityConfig(births=1.0)
    assert config == StreamConfig(fit=FitConfig(sh_degree=3, epochs=2, density=density), seed=5)
    assert apply_values(StreamConfig(), {}) == StreamConfig()
    fit = FitConfig(epochs=3)
    assert apply_values(StreamConfig(), {"fit": fit}).fit is fit


@pytest.mark.parametrize(
    ("config", "text", "message"),
    [
        (StreamConfig(), "[fit]\nepoch = 2", "`fit.epoch` is unknown, expected `fit.epochs`."),
        (
            StreamConfig(),
            "[motion]\nflow_method = 1979-05-27",
            "`motion.flow_method` must be a string, got ",
        ),
        (
            StreamConfig(),
            "[[fit]]\nepochs = 1",
            "`fit` must be a table, got ({'epochs': 1},).",
        ),
        (
            StreamConfig(),
            "[fit.density]\nbirths = -1",
            "`fit.density.births` must be at least 0",
        ),
    ],
)
def test_apply_values__names_file_key_expected_and_given(config, text, message, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"a\.toml: ") as caught:
        apply_values(config, read_config(path), str(path))
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: {message}")
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (None, FileNotFoundError, "expected a TOML file with settings, found none; write one with"),
        (b"fit = ", ValueError, r"expected TOML, got a broken file \(Invalid value"),
    ],
)
def test_read_config__names_a_file_that_cannot_be_read(content, error, message, tmp_path):
    path = tmp_path / "a.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=f"a.toml: {message}"):
        read_config(path)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"count": 1, "width": 4, "share": 1, "opacity": 0, "seed": -(2**63), "number": -3e38},
        {"count": np.int64(3), "share": np.float32(0.5), "opacity": None, "seed": 2**64 - 1},
        {
            "mode": "auto",
            "blurs": (),
            "size": (2, 3),
            "offset": {"a": 1, "b": 0.5},
            "name": "none",
        },
    ],
)
def test_check_ranges__accepts_values_within_their_ranges(values):
    Config(**values)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("count", 2.5, "a whole number below 2^64, at least 1, got 2.5."),
        ("count", True, "a whole number below 2^64, at least 1, got True."),
        ("width", 6, "at least 4 and a multiple of 4, got 6."),
        ("share", 0, "above 0 and at most 1, got 0."),
        ("share", nan, "a finite number, above 0 and at most 1, got nan."),
        ("opacity", 1, "at least 0 and below 1, got 1."),
        ("offset", {"a": "1"}, "a table, each value a finite number, got {'a': '1'}."),
        ("number", 10**400, "a finite number, got 1000000"),
        ("on", 1, "true or false, got 1."),
        ("name", None, "a string, got None."),
        ("mode", "yes", "one of off, auto, on, got 'yes'."),
        ("blurs", (3, -1), "a list, each item above 0, got (3, -1)."),
        (
            "size",
            (1,),
            "a list of 2 items, got (1,).",
        ),
    ],
)
def test_check_ranges__names_the_field_its_range_and_the_value(name, value, expected):
    with pytest.raises(ValueError, match=r"^Config\(\): ") as caught:
        Config(**{name: value})
    assert str(caught.value).startswith(f"Config(): `{name}` must be {expected}")
