"""Choices that depend on the backend of the active variant: LLVM (CPU), or CUDA or Metal (GPU)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Int32, UInt32
from morgs_mi.render.render_config import RenderConfig


def _backend() -> dr.JitBackend:
    return dr.backend_v(mi.Float)


def block_shape(config: RenderConfig) -> tuple[int, int]:
    """Return (width, height) in pixels of one lane's block: 8x4 on a CPU, 4x4 on a GPU, unless
    `config` sets it.
    """
    default_width = 8 if _backend() == dr.JitBackend.LLVM else 4
    return config.block_width or default_width, config.block_height or 4


def stable_order(keys: UInt32, buckets: int) -> UInt32:
    """Return the permutation that stably sorts `keys`, which are all below `buckets`.

    On a CPU one counting pass suffices. On a GPU that pass is stable for few buckets only.
    """
    if _backend() == dr.JitBackend.LLVM:
        return dr.detail.block_mkperm(keys, dr.width(keys), buckets)
    return dr.argsort(keys)


def add_mode() -> dr.ReduceMode:
    """Return the mode of scatter-additions to one record per Gaussian.

    On few CPU cores, one copy of the target per thread is 1.8 times faster than atomics (`Direct`)
    on two threads.
    """
    return dr.ReduceMode.Expand if _backend() == dr.JitBackend.LLVM else dr.ReduceMode.Auto


def on_aligned_stack(value: UInt32 | Int32) -> UInt32 | Int32:
    """Return an integer unchanged, in a way that aligns the stack of the kernel that computes it.

    LLVM aligns a kernel's stack only for variables that require it, and adds its own spilled
    packets later: they straddle cache lines, and the step takes 3 to 6 % longer. An array that is
    indexed at run time requires alignment.
    """
    if _backend() != dr.JitBackend.LLVM:
        return value
    local = dr.alloc_local(type(value), 2)
    place = mi.UInt32(value) & 1
    local[place] = value
    return local[place]
