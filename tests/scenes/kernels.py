"""What Dr.Jit launches and compiles."""

import drjit as dr


def launches(step):
    """Return all that a function launches: kernels, memsets, sorts, copies."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        step()
        return dr.kernel_history()


def compiled_by(step):
    """Return the kernels that a function compiles, without those in the cache."""
    return [k for k in launches(step) if k["type"] == dr.KernelType.JIT and not k["cache_hit"]]
