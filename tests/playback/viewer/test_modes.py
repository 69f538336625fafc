"""Colours of single splats against the renderer's images."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core import attributes
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.playback.player import MOTION_SCALE, channel_image, render
from morgs_mi.playback.viewer import modes
from morgs_mi.playback.viewer.modes import MODES, available_modes, scale_text
from morgs_mi.playback.visualise import confidence_image, motion_image
from morgs_mi.render.rasterize import Image, rasterize
from morgs_mi.render.render_config import RenderConfig
from tests.assertions import assert_close
from tests.scenes.changing_splats import rig, write_stream


@pytest.fixture
def states(tmp_path) -> list[CodedFrame]:
    return write_stream(tmp_path / "stream.morgs", 2)


def splat_colors(gaussians: Any, camera: Camera, mode: str, modes: ModuleType = modes) -> np.ndarray:
    """Return the colours of the Gaussians that a camera sees."""
    return modes.value_colors(mode, modes.splat_values(gaussians, camera, mode), MOTION_SCALE * camera.width)


def test_value_colors__of_one_splat_equal_those_of_the_renderer(states):
    camera = rig(65, 49)[1]
    for k in range(5):
        one = states[1].gaussians.select([k])
        mean = one.numpy()["means"][0]
        facing = Camera.look_at(camera.position, mean, (0, 0, 1), 45, 65, 49)
        rendered = rasterize(one, facing, ("color", "alpha", "motion", "confidence"))
        alpha = np.array(rendered.alpha)[24, 32]
        color = np.clip(np.array(rendered.color)[24, 32] / alpha, 0, 1)
        assert_close(splat_colors(one, facing, "color")[0] / 255, color, atol=0.01)
        motion = motion_image(np.array(rendered.motion)[24:25, 32:33], MOTION_SCALE * 65)[0, 0].astype(int)
        assert_close(splat_colors(one, facing, "motion")[0], motion, atol=2)
        offset = channel_image("offset", render(one, facing, ("offset",), RenderConfig())["offset"])[24, 32]
        assert_close(splat_colors(one, facing, "offset")[0].astype(int), offset, atol=2)
        assert offset.astype(int).min() < 200, "the first half of the splats moves"
        confidence = confidence_image(np.array(rendered.confidence)[24:25, 32:33] / alpha)[0, 0].astype(int)
        assert_close(splat_colors(one, facing, "confidence")[0], confidence, atol=3)


def test_value_colors__every_mode_colours_every_splat(states):
    for mode in MODES:
        colors = splat_colors(states[1].gaussians, rig()[0], mode)
        assert (colors.dtype, colors.shape) == (np.uint8, (40, 3))
    assert (splat_colors(states[0].gaussians, rig()[0], "offset") == 255).all(), "the first frame stores no offset"
    with pytest.raises(ValueError, match="the mode must be one of color, motion, confidence, offset, depth"):
        splat_colors(states[1].gaussians, rig()[0], "quats")


class WithWetness:
    """Gaussians with one more attribute."""

    def __init__(self, gaussians: Gaussians, wetness: np.ndarray | None) -> None:
        self.gaussians, self.logit_wetness, self.wetness = gaussians, wetness, wetness

    def __len__(self) -> int:
        return len(self.gaussians)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.gaussians, name)


def test_modes__include_a_new_row_of_the_attribute_table(states, monkeypatch):
    def load(name: str) -> ModuleType:
        """Return a second instance of a module, which reads the extended table."""
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        monkeypatch.setitem(sys.modules, name, module)
        return module

    row = attributes.Attribute("logit_wetness", (), "wetness", attributes.SIGMOID, channel="wetness")
    monkeypatch.setattr(attributes, "ATTRIBUTES", (*attributes.ATTRIBUTES, row))
    player, modes = load("morgs_mi.playback.player"), load("morgs_mi.playback.viewer.modes")
    wet = WithWetness(states[1].gaussians, np.linspace(0, 1, 40, dtype=np.float32))
    dry = WithWetness(states[1].gaussians, None)
    assert "wetness" in player.CHANNELS
    assert player.available_channels(wet) == (*player.available_channels(dry), "wetness")
    assert set(modes.available_modes(wet)) - set(modes.available_modes(dry)) == {"wetness"}
    image = Image(color=np.zeros((2, 3, 3)), others={"wetness": np.ones((2, 3, 1))})
    monkeypatch.setattr(player, "rasterize", lambda *_, **__: image)
    assert player.render(wet, rig()[0], ("color", "wetness"), RenderConfig())["wetness"].all()
    grey = np.rint(255 * wet.wetness)
    assert np.abs(splat_colors(wet, rig()[0], "wetness", modes) - grey[:, None]).max() <= 1
    with pytest.raises(ValueError, match="got 'wetness'"):
        splat_colors(dry, rig()[0], "wetness", modes)


def test_available_modes__exclude_missing_attributes(states):
    gaussians = states[1].gaussians
    assert available_modes(gaussians) == MODES
    bare = Gaussians(*(getattr(gaussians, n) for n in ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs")))
    assert available_modes(bare) == tuple(mode for mode in MODES if mode != "confidence")


@pytest.mark.parametrize(
    ("mode", "texts"),
    [
        ("color", ()),
        ("motion", ("direction on the screen", "12 px per frame", "no motion")),
        ("offset", ("direction on the screen", "1.2 px per frame", "no offset")),
        ("confidence", ("0, static", "1, moving")),
        ("depth", ("Red: 2.06", "blue: 7.94 world units")),
        ("wetness", ("Black: 0", "white: 1")),
    ],
)
def test_scale_text__has_values_and_units(mode: str, texts: tuple[str, ...]) -> None:
    depths = np.r_[np.linspace(2, 8, 101), np.nan, -1][:, None]
    text = scale_text(mode, depths, 12.0)
    assert all(part in text for part in texts), text
    assert bool(text) == (mode != "color")
