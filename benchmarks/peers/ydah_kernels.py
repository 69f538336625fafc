"""The C kernels of ydah/gsplat: forward and backward pass on Gaussians that this package has projected.

Their shared library is made by `build.sh`. Lists of 16x16 tiles are made here, in NumPy, and are not part of any time.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from math import log
from pathlib import Path

import numpy as np

from morgs_mi import Camera, Gaussians, RenderConfig
from morgs_mi.render.projection import project

_TILE = 16
_GRADIENTS = {"means": (2,), "conics": (3,), "colors": (3,), "opacities": ()}


class _Forward(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("means", "conics", "colors", "opacities", "backgrounds", "masks")),
        *((name, ctypes.c_void_p) for name in ("offsets", "ids", "image", "alphas", "last")),
        *((name, ctypes.c_size_t) for name in ("cameras", "gaussians", "channels", "entries")),
        *((name, ctypes.c_int) for name in ("width", "height", "tile", "across", "down")),
    )


class _Backward(ctypes.Structure):
    _fields_ = (
        ("forward", _Forward),
        *((name, ctypes.c_void_p) for name in ("alphas", "last", "grad_image", "grad_alphas")),
        *((name, ctypes.c_void_p) for name in ("means", "conics", "colors", "opacities", "background", "means_abs")),
    )


@dataclass(frozen=True)
class Kernels:
    """Both kernels on N Gaussians in one view; the arrays that they write are reused.

    Attributes:
        library: the shared library.
        arrays: float32 and int32 arrays by name.
        size: width and height in pixels.
    """

    library: ctypes.CDLL
    arrays: dict[str, np.ndarray]
    size: tuple[int, int]

    @classmethod
    def of(cls, path: Path, gaussians: Gaussians, camera: Camera) -> Kernels:
        """Load the library, project the Gaussians and list them by tile and depth."""
        splats = project(gaussians, camera, ("color",), RenderConfig())
        x, y, a, b, c, log2_opacity = (np.asarray(v, np.float64) for v in splats.shape)
        valid, extent = np.asarray(splats.valid), [np.asarray(v, np.float64) for v in splats.extent]
        # This package has alpha = 2^(log2_opacity - u^2 - v^2) with u = a dx + b dy, v = c dy.
        conics = 2 * log(2) * np.stack([a * a, a * b, b * b + c * c], axis=1)
        across, down = -(-camera.width // _TILE), -(-camera.height // _TILE)
        axes = [*zip((x, y), extent, (across, down), strict=True)]
        low = [np.clip((v - e) // _TILE, 0, tiles).astype(int) for v, e, tiles in axes]
        high = [np.clip((v + e) // _TILE + 1, 0, tiles).astype(int) for v, e, tiles in axes]
        columns = np.where(valid, high[0] - low[0], 0)
        counts = columns * np.where(valid, high[1] - low[1], 0)
        ids = np.repeat(np.arange(len(x)), counts)
        place = np.arange(len(ids)) - np.repeat(np.cumsum(counts) - counts, counts)
        tile = (low[1][ids] + place // columns[ids]) * across + low[0][ids] + place % columns[ids]
        order = np.lexsort((np.asarray(splats.depths)[ids], tile))
        pixels, N = camera.width * camera.height, len(x)
        arrays = {
            "means": np.stack([x, y], axis=1),
            "conics": conics,
            "colors": np.stack([np.asarray(v) for v in splats.channels["color"]], axis=1),
            "opacities": np.exp2(log2_opacity),
            "image": np.zeros((pixels, 3)),
            "alphas": np.zeros(pixels),
            "grad_image": np.zeros((pixels, 3)),
            "grad_alphas": np.zeros(pixels),
            **{f"grad_{name}": np.zeros((N, *size)) for name, size in _GRADIENTS.items()},
        }
        found: dict[str, np.ndarray] = {}
        for name, value in arrays.items():
            found[name] = np.ascontiguousarray(value, np.float32)
        found["offsets"] = np.searchsorted(tile[order], np.arange(across * down)).astype(np.int32)
        found["ids"], found["last"] = ids[order].astype(np.int32), np.zeros(pixels, np.int32)
        return cls(ctypes.CDLL(str(path.resolve())), found, (camera.width, camera.height))

    def step(self, target: np.ndarray) -> dict[str, np.ndarray]:
        """Return the gradients of the mean L1 distance to a colour [3], by name."""
        for name in ("image", "alphas", "last", *(f"grad_{name}" for name in _GRADIENTS)):
            self.arrays[name].fill(0)
        forward = self._forward()
        self.library.gs_raster_forward_without_gvl(ctypes.byref(forward))
        np.sign(self.arrays["image"] - target, out=self.arrays["grad_image"])
        self.arrays["grad_image"] /= self.arrays["image"].size
        at = self._at
        gradients = (at("grad_means"), at("grad_conics"), at("grad_colors"), at("grad_opacities"), None, None)
        inputs = (at("alphas"), at("last"), at("grad_image"), at("grad_alphas"))
        self.library.gs_raster_backward_without_gvl(ctypes.byref(_Backward(forward, *inputs, *gradients)))
        return {name: self.arrays[f"grad_{name}"] for name in _GRADIENTS}

    def _forward(self) -> _Forward:
        width, height = self.size
        across, down = -(-width // _TILE), -(-height // _TILE)
        arrays = [self._at(name) for name in ("means", "conics", "colors", "opacities")]
        arrays += [None, None, *(self._at(name) for name in ("offsets", "ids", "image", "alphas", "last"))]
        sizes = (1, len(self.arrays["means"]), 3, len(self.arrays["ids"]))
        return _Forward(*arrays, *sizes, width, height, _TILE, across, down)

    def _at(self, name: str) -> int:
        return self.arrays[name].ctypes.data
