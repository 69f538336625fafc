"""Legends of the modes as HTML for the page: a bar or a disc of colours with their values and units."""

from __future__ import annotations

import base64

import numpy as np

from morgs_mi.io.png import png_bytes
from morgs_mi.playback.player import OFFSET_SCALE
from morgs_mi.playback.visualise import confidence_image, depth_image, depth_range, grey_image, motion_wheel

__all__ = ["legend_html"]

_BAR = (
    '<div style="padding:0 1em .3em;font-size:.8em"><img alt="" style="display:block;width:100%;height:.9em" src="{}">'
    '<div style="display:flex;justify-content:space-between">{}</div>{}</div>'
)
_DISC = (
    '<div style="padding:0 1em .3em;font-size:.8em;display:flex;align-items:center;gap:1em">'
    '<img alt="" style="width:5.5em;border-radius:50%" src="{}"><div>{}</div></div>'
)


def legend_html(mode: str, values: np.ndarray, motion_scale: float) -> str:
    """Return the legend of a mode; empty for colours.

    Args:
        mode: one of `MODES`.
        values: the values that are shown, in the channel's units; they determine the range of the depth.
        motion_scale: speed of full saturation in pixels, as for `channel_image`.
    """
    if mode == "color":
        return ""
    if mode in ("motion", "offset"):
        scale = motion_scale * (OFFSET_SCALE if mode == "offset" else 1)
        meaning = f"Hue: direction on the screen<br>Rim: {scale:.3g} px per frame or more<br>White: no {mode}"
        return _DISC.format(_source(motion_wheel(scale)), meaning)
    ramp = np.linspace(0, 1, 256)[None]
    if mode == "confidence":
        return _bar(confidence_image(ramp), ("0 static", "0.5", "1 moving"), "")
    if mode == "depth":
        near, far = depth_range(values)
        inverse = (1 - ramp) / near + ramp / far
        ends = (f"{near:.3g} near", f"{2 / (1 / near + 1 / far):.3g}", f"{far:.3g} far")
        return _bar(depth_image(1 / inverse, near, far), ends, "Depth in world units, linear in 1 / depth")
    return _bar(grey_image(ramp), ("0", "0.5", "1"), "")


def _bar(colors: np.ndarray, ticks: tuple[str, ...], unit: str) -> str:
    return _BAR.format(_source(colors), "".join(f"<span>{tick}</span>" for tick in ticks), unit)


def _source(image: np.ndarray) -> str:
    """Return an image [H, W, 3] as the address of an HTML image."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(image)).decode()
