"""Kernels that Dr.Jit compiles."""

import drjit as dr


def compiled_by(step):
    """Return the kernels that a function compiles, without those in the cache."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        step()
        kernels = dr.kernel_history()
    return [k for k in kernels if k["type"] == dr.KernelType.JIT and not k["cache_hit"]]
