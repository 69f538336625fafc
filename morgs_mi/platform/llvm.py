"""Search for a libLLVM that Dr.Jit can use, before Dr.Jit looks for one itself.

Dr.Jit compiles its CPU kernels with the LLVM that it finds when `drjit` is first imported. It
refuses version 14 and older; 15 and 16 abort the whole process on recent CPUs (``LLVM ERROR: Cannot
select: f32 = fminimum``) and are refused here; 17 and newer work. This module needs the standard
library only: it can run during set-up before anything is installed. ``python -P
morgs_mi/platform/llvm.py`` prints the library in use, or a sentence with exit status 1.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
import warnings
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
SAFE_MAJOR = 17
REMEDY = (
    "install one (Debian: apt-get install libllvm19; Ubuntu: the newest of libllvm17 to libllvm20; "
    f"conda: conda install -c conda-forge libllvm19) or set {VARIABLE} to its path"
)
# For a path that cannot be opened Dr.Jit raises an exception; with a library that it cannot use it
# ends the process.
_NOWHERE = f"/nonexistent/libLLVM-{SAFE_MAJOR}-or-newer.so"
_NAME = re.compile(r"libLLVM(?:-(\d+)[\d.]*)?\.so(?:\.(\d+)[\d.]*)?(?:git)?")


def llvm_major(path: Path) -> int:
    """Return the major version in the name of a file or of a link's target, or 0."""
    for name in (path.name, path.resolve().name):
        if (match := _NAME.fullmatch(name)) and (major := match[1] or match[2]):
            return int(major)
    return 0


def search_folders() -> list[Path]:
    """Return the folders where distributions, LLVM's own packages and conda install libLLVM."""
    prefixes = [os.environ.get("CONDA_PREFIX"), sys.prefix, sys.base_prefix]
    paths = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    usr = Path("/usr/lib")
    return [
        *(Path(p, "lib") for p in prefixes if p),
        *(Path(p) for p in paths if p),
        Path("/usr/lib64"),
        Path("/usr/local/lib"),
        usr,
        usr / f"{os.uname().machine}-linux-gnu",
        *sorted(usr.glob("llvm-*/lib")),
    ]


def find_llvm() -> list[Path]:
    """Return the libLLVM files in `search_folders`, newest first, without duplicates."""
    folders = search_folders()
    files = {path.resolve(): path for folder in folders for path in folder.glob("libLLVM*.so*")}
    libraries = [path for path in files.values() if _NAME.fullmatch(path.name)]
    return sorted(libraries, key=llvm_major, reverse=True)


def usable(path: Path) -> bool:
    """Return whether the name of a file, or of a link's target, is that of a libLLVM that Dr.Jit
    can use.
    """
    return path.is_file() and llvm_major(path) >= SAFE_MAJOR


def choose_llvm(choice: str | None = None) -> tuple[Path | None, str]:
    """Return the library to use (None if there is none) and a sentence that describes the problem
    (empty if none).

    Args:
        choice: the user's choice, which takes precedence if it is usable.
    """
    if choice and usable(Path(choice)):
        return Path(choice), ""
    libraries = find_llvm()
    best = next(filter(usable, libraries), None)
    if choice:
        rest = f"{best} is used instead." if best else f"No other was found: {REMEDY}."
        return best, (
            f"{VARIABLE}={choice} is no libLLVM whose name has a version of {SAFE_MAJOR} or newer, "
            f"such as libLLVM.so.19.1. {rest}"
        )
    if best:
        return best, ""
    others = ", ".join(map(str, libraries)) or "none"
    return None, (
        f"Dr.Jit's CPU backend needs LLVM {SAFE_MAJOR} or newer, found {others}; {REMEDY}."
    )


def has_cuda() -> bool:
    """Return whether an NVIDIA driver can be loaded: the variants cuda_* may then work without
    LLVM.
    """
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def ensure_llvm() -> None:
    """Point Dr.Jit to a usable libLLVM through ``DRJIT_LIBLLVM_PATH``; Linux only, elsewhere do
    nothing.

    With a CUDA driver a missing LLVM is a warning, and choosing a variant ``llvm_*`` then raises
    Mitsuba's ImportError instead of ending the process.

    Raises:
        RuntimeError: no usable LLVM and no CUDA driver.
    """
    if not sys.platform.startswith("linux"):
        return
    choice = os.environ.get(VARIABLE)
    if choice == _NOWHERE:  # a parent process has already warned
        return
    path, problem = choose_llvm(choice)
    if not path and not has_cuda():
        raise RuntimeError(problem)
    if problem:
        warnings.warn(problem, RuntimeWarning, stacklevel=3)
    os.environ[VARIABLE] = str(path or _NOWHERE)
    # Dr.Jit reads the variable once, when it is imported.
    major = sys.modules["drjit"].detail.llvm_version()[0] if "drjit" in sys.modules else 0
    if 0 < major < SAFE_MAJOR:
        warnings.warn(
            f"Dr.Jit was imported before morgs_mi and has loaded LLVM {major}, which can abort the "
            "process; import morgs_mi before mitsuba and drjit.",
            RuntimeWarning,
            stacklevel=3,
        )


if __name__ == "__main__":
    chosen, sentence = choose_llvm(os.environ.get(VARIABLE))
    sys.stderr.write(f"{sentence}\n" if sentence else "")
    sys.stdout.write(f"{chosen}\n" if chosen else "")
    sys.exit(chosen is None)
