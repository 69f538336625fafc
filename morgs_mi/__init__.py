"""Dynamic Gaussian splatting for Mitsuba 3."""

from morgs_mi.llvm import ensure_llvm

# Before anything imports Dr.Jit, which looks for LLVM at that moment.
ensure_llvm()
