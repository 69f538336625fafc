"""Baseline renderer: one lane per pixel traverses all Gaussians of its 16x16 tile.

It shares only the projection and the cut-offs with the package, hence renders the same image. Its lists have one level
and test only the bounding box, every pixel gathers every record itself, and its adjoint scatters nine numbers for every
pair of pixel and Gaussian. The notation follows `morgs_mi.render.compositing`.
"""

from __future__ import annotations

from math import log, log2
from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi import Camera, Gaussians, RenderConfig
from morgs_mi.render.projection import Splats, project

TILE = 16


def render(gaussians: Gaussians, camera: Camera, config: RenderConfig) -> Any:
    """Return the colour [H, W, 3]; no gradients."""
    with dr.suspend_grad():
        splats = project(gaussians, camera, ("color",), config)
        color, _ = _blend(_columns(splats), _tile_lists(splats, camera), camera, config)
    values: Any = dr.ravel(mi.Color3f(*color))
    return mi.TensorXf(values, (camera.height, camera.width, 3))


def step(gaussians: Gaussians, camera: Camera, target: Any, config: RenderConfig) -> list[Any]:
    """Return the gradients of the mean |colour - target| with respect to all attributes; target [3]."""
    splats = project(gaussians, camera, ("color",), config)
    inputs = _columns(splats)
    columns = dr.detach(inputs)
    with dr.suspend_grad():
        lists = _tile_lists(splats, camera)
        color, _ = _blend(columns, lists, camera, config)
        scale = 1 / (3 * camera.width * camera.height)
        g = [dr.sign(c - t) * scale for c, t in zip(color, target, strict=True)]
        gradients = _adjoint(columns, color, g, lists, camera, config)
    for value, gradient in zip(inputs, gradients, strict=True):
        dr.set_grad(value, gradient)
        dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    gradients = [dr.grad(value) for value in gaussians.items().values()]
    dr.eval(gradients)
    for value in gaussians.items().values():
        dr.clear_grad(value)
    return gradients


def _columns(splats: Splats) -> list[Any]:
    """Return the nine numbers of a record: geometry and colour."""
    return [*splats.shape, *splats.channels["color"]]


def _tile_lists(splats: Splats, camera: Camera) -> tuple[Any, Any, Any]:
    """Return (entries, first, end): Gaussians sorted by tile and depth, and the range of each tile."""
    UInt32, size = mi.UInt32, dr.opaque(mi.UInt32, TILE)
    across, down = (dr.opaque(UInt32, -(-edge // TILE)) for edge in (camera.width, camera.height))
    order = dr.argsort(dr.select(splats.valid, splats.depths, dr.inf))

    def span(center: Any, half: Any, tiles: Any) -> tuple[Any, Any]:
        low = dr.clip(dr.floor((center - half) / mi.Float(size)), 0, mi.Float(tiles))
        high = dr.clip(dr.floor((center + half) / mi.Float(size)) + 1, 0, mi.Float(tiles))
        return UInt32(low), UInt32(high)

    x0, x1 = span(splats.shape[0], splats.extent[0], across)
    y0, y1 = span(splats.shape[1], splats.extent[1], down)
    columns = x1 - x0
    counts = dr.select(splats.valid, columns * (y1 - y0), 0)
    dr.eval(x0, y0, columns, counts)
    x0, y0, columns, counts = (dr.gather(UInt32, v, order) for v in (x0, y0, columns, counts))
    ends = dr.cumsum(counts)
    total, tiles = int(ends[-1]), -(-camera.width // TILE) * -(-camera.height // TILE)
    tile_of, entries = dr.empty(UInt32, max(total, 1)), dr.empty(UInt32, max(total, 1))

    def enter(k, tile_of, entries, x0, y0, columns, counts, first, order, across):
        row = k // columns
        tile = (y0 + row) * across + x0 + k - row * columns
        dr.scatter(tile_of, tile, first + k)
        dr.scatter(entries, order, first + k)
        return k + 1, tile_of, entries, x0, y0, columns, counts, first, order, across

    # Inactive lanes also divide, and an integer division by zero ends the process.
    columns = dr.maximum(columns, 1)
    state = (UInt32(0), tile_of, entries, x0, y0, columns, counts, ends - counts, order, across)
    _, tile_of, entries, *_ = dr.while_loop(state, lambda k, *s: k < s[5], enter, label="plain: tile entries")
    dr.eval(tile_of, entries)
    perm = dr.argsort(tile_of)
    length = dr.zeros(UInt32, tiles)
    dr.scatter_add(length, 1, tile_of, active=dr.opaque(UInt32, total) > 0)
    end = dr.cumsum(length)
    entries, first = dr.gather(UInt32, entries, perm), end - length
    dr.eval(entries, first, end)
    return entries, first, end


def _pixels(lists: tuple[Any, Any, Any], camera: Camera) -> tuple[Any, Any, Any, Any]:
    """Return (x, y, first, end) of every pixel."""
    width = dr.opaque(mi.UInt32, camera.width)
    lane = dr.arange(mi.UInt32, camera.width * camera.height)
    x, y = lane % width, lane // width
    tile = (y // TILE) * ((width + (TILE - 1)) // TILE) + x // TILE
    _, first, end = lists
    return mi.Float(x) + 0.5, mi.Float(y) + 0.5, dr.gather(mi.UInt32, first, tile), dr.gather(mi.UInt32, end, tile)


def _alpha(record: list[Any], x: Any, y: Any, config: RenderConfig) -> tuple[Any, Any, Any, Any, Any]:
    """Return (alpha, alpha before the cap, dx, dy, u) of a Gaussian at the pixels."""
    mean_x, mean_y, a, b, c, log2_opacity = record[:6]
    dx, dy = x - mean_x, y - mean_y
    u, v = a * dx + b * dy, c * dy
    p = log2_opacity - u * u - v * v
    full = dr.exp2(p)
    return dr.select(p >= log2(config.alpha_min), dr.minimum(full, config.alpha_max), 0), full, dx, dy, u


def _blend(
    columns: list[Any], lists: tuple[Any, Any, Any], camera: Camera, config: RenderConfig
) -> tuple[list[Any], Any]:
    """Return the colour of every pixel, three floats [H W], and its transmittance."""
    x, y, first, end = _pixels(lists, camera)
    stop = config.stop_transmittance

    def body(j, end, x, y, T, color, columns, entries):
        i = dr.gather(mi.UInt32, entries, j)
        record = [dr.gather(mi.Float, column, i) for column in columns]
        w = T * _alpha(record, x, y, config)[0]
        color = [dr.fma(w, c, total) for c, total in zip(record[6:], color, strict=True)]
        return j + 1, end, x, y, T - w, color, columns, entries

    state = (first, end, x, y, mi.Float(1), [mi.Float(0) for _ in range(3)], columns, lists[0])
    *_, T, color, _, _ = dr.while_loop(
        state, lambda j, end, x, y, T, *_: (j < end) & (stop <= T), body, label="plain: blend"
    )
    dr.eval(T, color)
    return color, T


def _adjoint(
    columns: list[Any],
    color: list[Any],
    g: list[Any],
    lists: tuple[Any, Any, Any],
    camera: Camera,
    config: RenderConfig,
) -> list[Any]:
    """Return dL/d(column), nine floats [N], given the gradient g of every pixel's colour."""
    x, y, first, end = _pixels(lists, camera)
    stop = config.stop_transmittance
    sums = [dr.zeros(mi.Float, dr.width(columns[0])) for _ in columns]

    def body(j, end, x, y, T, S, g, columns, entries, sums):
        i = dr.gather(mi.UInt32, entries, j)
        record = [dr.gather(mi.Float, column, i) for column in columns]
        a, b, c = record[2:5]
        alpha, full, dx, dy, u = _alpha(record, x, y, config)
        w, product = T * alpha, sum(gc * v for gc, v in zip(g, record[6:], strict=True))
        S = S - w * product
        d = dr.select(full <= config.alpha_max, log(2) * (w * product - alpha * S / (1 - alpha)), 0)
        geometry = (2 * d * u * a, 2 * d * (u * b + c * c * dy), -2 * d * u * dx, -2 * d * u * dy, -2 * d * c * dy * dy)
        for total, value in zip(sums, [*geometry, d, *(w * gc for gc in g)], strict=True):
            dr.scatter_add(total, value, i, active=alpha > 0)
        return j + 1, end, x, y, T - w, S, g, columns, entries, sums

    suffix = sum(gc * c for gc, c in zip(g, color, strict=True))
    state = (first, end, x, y, mi.Float(1), suffix, g, columns, lists[0], sums)
    *_, sums = dr.while_loop(state, lambda j, end, x, y, T, *_: (j < end) & (stop <= T), body, label="plain: adjoint")
    return sums
