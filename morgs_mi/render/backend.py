"""Building blocks of the kernels: choices that depend on the backend of the active variant, LLVM
(CPU), or CUDA or Metal (GPU), and the exponential of the blending loops.
"""

from __future__ import annotations

from math import log

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Float, Int32, Jit, UInt32
from morgs_mi.render.render_config import RenderConfig

# Minimax over [-1/2, 1/2], highest power first: relative error 2.7e-6 in float32, like Taylor's
# fifth degree.
_EXP2 = (
    0.009570102207362652,
    0.05591786280274391,
    0.240247443318367,
    0.6931217908859253,
    0.9999992847442627,
)
_LN2 = log(2.0)


def on_cpu() -> bool:
    """Return whether the active variant runs on the CPU."""
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


def block_shape(config: RenderConfig) -> tuple[int, int]:
    """Return (width, height) in pixels of one lane's block: 8x4 on a CPU, 4x4 on a GPU, unless
    `config` sets it.
    """
    default_width = 8 if on_cpu() else 4
    return config.block_width or default_width, config.block_height or 4


def elements(values: Jit, places: UInt32) -> Jit:
    """Return the elements of an array at some places."""
    return dr.gather(type(values), values, places)


def stable_order(keys: UInt32, buckets: int) -> UInt32:
    """Return the permutation that stably sorts `keys`, which are all below `buckets`.

    On a CPU one counting pass suffices. On a GPU that pass is stable for few buckets only.
    """
    if on_cpu():
        return dr.detail.block_mkperm(keys, dr.width(keys), buckets)
    return dr.argsort(keys)


def sections(lanes: int) -> tuple[int, int, int]:
    """Return (launches, sections, lanes) that divide the lanes of a kernel: each launch has equally
    many sections, each section equally many lanes, the last ones without work.

    Dr.Jit 1.5 divides a kernel on the CPU into two work units per thread, if they have at most
    16384 lanes each (`LLVMThreadState::launch`). One thread runs the lanes of a unit in their
    order. With records of its own, each unit adds without atomics and in a fixed order. On a GPU
    all lanes add to the same records.
    """
    if not on_cpu():
        return 1, 1, lanes
    units = 2 * dr.thread_count()
    launches = -(-lanes // (16384 * units))
    # Whole SIMD packets, of up to 32 lanes.
    return launches, units, -(-lanes // (launches * units * 32)) * 32


def on_aligned_stack(value: UInt32 | Int32) -> UInt32 | Int32:
    """Return an integer unchanged, in a way that aligns the stack of the kernel that computes it.

    LLVM aligns a kernel's stack only for variables that require it, and adds its own spilled
    packets later: they straddle cache lines, and the step takes 3 to 6 % longer. An array that is
    indexed at run time requires alignment.
    """
    if not on_cpu():
        return value
    local = dr.alloc_local(type(value), 2)
    place = mi.UInt32(value) & 1
    local[place] = value
    return local[place]


def exp2(p: Float) -> Float:
    """Return 2^p for |p| < 126, relative error 3e-6; out of that range the result is undefined,
    without a trap.

    Adding 1.5 * 2^23 rounds to an integer in the low mantissa bits, which is then shifted into the
    exponent.
    """
    x = dr.detach(p)
    total = x + 12582912.0
    f = x - (total - 12582912.0)
    value = mi.Float(_EXP2[0])
    for coefficient in _EXP2[1:]:
        value = dr.fma(value, f, coefficient)
    exponent = dr.reinterpret_array(mi.Int32, total) << 23  # pyright: ignore[reportOperatorIssue]
    bits = dr.reinterpret_array(mi.Int32, value) + exponent
    power: Float = dr.reinterpret_array(mi.Float, bits)
    return dr.replace_grad(power, _LN2 * power * p) if dr.grad_enabled(p) else power
