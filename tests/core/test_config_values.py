"""Values of configs: nested values, TOML files and their error messages."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import pytest

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.core.config_values import apply_values, config_toml, read_config, relocated
from morgs_mi.fit.fit_config import DensityConfig, FitConfig, LearningRates
from morgs_mi.loop.stream_config import PRESETS, StreamConfig, apply_preset
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True)
class Leaf:
    """Every type of value that a config may hold."""

    number: float = 1e-5
    """Length in px."""
    count: int = 3
    name: str = "a"
    """Name of
    the leaf."""
    on: bool = False
    sizes: tuple[int, ...] = (1, 2)
    pair: tuple[str, float] = ("x", 0.5)
    pairs: tuple[tuple[float, float], ...] = ()
    limit: float | None = 0.5
    """Limit; None: no limit."""
    mode: Literal["fast", "exact"] | None = None
    labels: tuple[str | None, ...] = ("a", None)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"Leaf(): `count` must not be negative, got {self.count}; take 0.")


@dataclass(frozen=True)
class Branch:
    """A config between others, with a setting behind a nested one."""

    leaf: Leaf = field(default_factory=Leaf)
    """Inner settings."""
    extra: Leaf | None = None
    weight: float = 2.0


@dataclass(frozen=True)
class Root:
    """A config two levels deep."""

    branch: Branch = field(default_factory=Branch)
    seed: int = 0


def round_trip(config: Any, path: Path) -> Any:
    path.write_text(config_toml(config), encoding="utf-8")
    return apply_values(type(config)(), read_config(path), str(path))


@pytest.mark.parametrize(
    "config",
    [
        StreamConfig(),
        *(apply_preset(StreamConfig(), name) for name in PRESETS),
        StreamConfig(
            fit=FitConfig(
                density=DensityConfig(rounds=0, births=1 / 3), rates=LearningRates(means=1e-300)
            ),
            motion=MotionConfig(mask_method="none", cohesion_weight=1e22),
            render=RenderConfig(block_width=4, block_height=None, reproducible=True),
            codec=CodecConfig(quality=0.1 + 0.2),
            seed=3,
        ),
        Leaf(),
        Leaf(
            number=1e308,
            name='"quoted" \\ \n\t\x00\x1b\x7f é 漢 🙂',
            sizes=(),
            limit=None,
            mode="exact",
        ),
        Leaf(pair=("", -0.0), pairs=((1.0, 2.5), (-1e-9, 3.0)), labels=(), count=2**63),
        Root(),
        Root(Branch(Leaf(count=7), extra=Leaf(name="none"), weight=-1.0), seed=4),
    ],
)
def test_config_toml__is_read_back_as_the_same_config(config: Any, tmp_path: Path) -> None:
    assert round_trip(config, tmp_path / "a.toml") == config


def test_config_toml__restores_a_config_over_other_values(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(config_toml(Leaf(limit=None)))
    assert apply_values(
        Leaf(limit=2.0, count=9, sizes=(7,)), read_config(tmp_path / "a.toml")
    ) == Leaf(limit=None)


def test_config_toml__has_every_setting_with_its_docstring() -> None:
    text = config_toml(StreamConfig())
    tables = tomllib.loads(text)

    def settings(config: dict[str, Any]) -> dict[str, Any]:
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
    assert "# Name of the leaf.\n" in config_toml(Leaf())


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        (
            Leaf(name=b"a"),
            TypeError,
            "expected numbers, strings, booleans, tuples or None, got b'a'",
        ),  # type: ignore
        (Leaf(mode="none"), ValueError, "`mode` must not be the string 'none'"),  # type: ignore[arg-type]
    ],
)
def test_config_toml__rejects_what_could_not_be_read_back(config, error, message) -> None:
    with pytest.raises(error, match=message):
        config_toml(config)


def test_apply_values__replaces_only_what_is_named() -> None:
    values = {"seed": 5, "fit": {"epochs": 2, "density": {"births": 1}}}
    config = apply_values(StreamConfig(fit=FitConfig(sh_degree=3)), values)
    density = DensityConfig(births=1.0)
    assert config == StreamConfig(fit=FitConfig(sh_degree=3, epochs=2, density=density), seed=5)
    assert isinstance(config.fit.density.births, float)
    assert apply_values(StreamConfig(), {}) == StreamConfig()
    fit = FitConfig(epochs=3)
    assert apply_values(StreamConfig(), {"fit": fit}).fit is fit


def test_apply_values__builds_and_removes_an_optional_config() -> None:
    assert apply_values(Branch(), {"extra": {"count": 5}}).extra == Leaf(count=5)
    assert apply_values(Branch(extra=Leaf(count=5)), {"extra": "none"}).extra is None
    branch = Branch(extra=Leaf(count=5))
    assert apply_values(branch, {"extra": {"on": True}}) == replace(
        branch, extra=Leaf(count=5, on=True)
    )


@pytest.mark.parametrize(
    ("config", "text", "message"),
    [
        (
            StreamConfig(),
            "epochs = 2",
            "`epochs` is unknown, expected `fit` or `motion` or `render` or `codec` or `seed`",
        ),
        (StreamConfig(), "[fit]\nepoch = 2", "`fit.epoch` is unknown, expected `fit.epochs`."),
        (
            StreamConfig(),
            "[fit]\nepochs = 'many'",
            "`fit.epochs` must be a whole number below 2^64, at least 1, got 'many'.",
        ),
        (
            StreamConfig(),
            "[fit]\nepochs = 99999999999999999999",
            "`fit.epochs` must be a whole number below 2^64, at least 1, got 99999999999999999999.",
        ),
        (
            StreamConfig(),
            "[fit]\nskip_static = 1",
            "`fit.skip_static` must be true or false, got 1.",
        ),
        (
            StreamConfig(),
            "[motion]\nflow_method = 1",
            "`motion.flow_method` must be a string, got 1.",
        ),
        (
            StreamConfig(),
            "[motion]\nflow_method = 1979-05-27",
            "`motion.flow_method` must be a string, got ",
        ),
        (StreamConfig(), "fit = 1", "`fit` must be a table (FitConfig), got 1."),
        (
            StreamConfig(),
            "[[fit]]\nepochs = 1",
            "`fit` must be a table (FitConfig), got [{'epochs': 1}].",
        ),
        (StreamConfig(), "[fit]\nepochs = 0", "`fit.epochs` must be at least 1, got 0."),
        (Leaf(), "sizes = 1", "`sizes` must be a list (each a whole number below 2^64), got 1."),
        (
            Leaf(),
            "sizes = [1, 'a']",
            "`sizes` must be a list (each a whole number below 2^64), got (1, 'a').",
        ),
        (Leaf(), "pair = ['a']", "`pair` must be a list (a string, a finite number), got ['a']."),
        (Leaf(), "mode = 'slow'", "`mode` must be fast or exact or none, got 'slow'."),
        (
            Root(),
            "[branch.leaf]\ncount = -1",
            "`branch.leaf.count` must not be negative, got -1; take 0.",
        ),
        (
            StreamConfig(),
            "[fit.detail]\nmost_gaussians = 10",
            "`fit.detail.least_gaussians` must be 1 to `fit.detail.most_gaussians` = 10, got 4000.",
        ),
        (
            Root(),
            "[branch.extra]\ncount = -1",
            "`branch.extra.count` must not be negative, got -1; take 0.",
        ),
    ],
)
def test_apply_values__names_file_key_expected_and_given(
    config: Any, text: str, message: str, tmp_path: Path
) -> None:
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
        (
            b"a = 1\na = 2",
            ValueError,
            r"expected TOML, got a broken file \(Cannot overwrite a value",
        ),
        (b"\xff", ValueError, r"expected text in UTF-8, got other bytes \('utf-8' codec"),
    ],
)
def test_read_config__names_a_file_that_cannot_be_read(
    content, error, message, tmp_path: Path
) -> None:
    path = tmp_path / "a.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=f"a.toml: {message}"):
        read_config(path)


def test_relocated__changes_only_errors_that_name_a_field() -> None:
    error = ValueError("other(): `b` must be 1.")
    assert relocated(error, "f.toml", "x.", ["a"]) is error
    text = str(relocated(ValueError("A.b(): `a` must be less than `b`."), "f.toml", "x.", ["a"]))
    assert text == "f.toml: `x.a` must be less than `b`."
