"""Search for a libLLVM that Dr.Jit can use, before Dr.Jit looks for one itself.

Dr.Jit compiles its CPU kernels with the LLVM that it finds when `drjit` is first imported. It
refuses version 14 and older; 15 and 16 abort the whole process on recent CPUs (``LLVM ERROR: Cannot
select: f32 = fminimum``); 17 and newer work. This module needs the standard library only: it can
run during set-up before anything is installed. ``python -P morgs_mi/platform/llvm.py`` prints the
library in use, or a sentence with exit status 1.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
SAFE_MAJOR = 17
DOUBTFUL_MAJOR = 15
REMEDY = (
    "install one (Debian: apt-get install libllvm19; Ubuntu: the newest of libllvm17 to libllvm20; "
    f"conda: conda install -c conda-forge libllvm19) or set {VARIABLE} to its path"
)
# For a path that cannot be opened Dr.Jit raises an exception; with a library that it cannot use it
# ends the process.
_NOWHERE = f"/nonexistent/libLLVM-{SAFE_MAJOR}-or-newer.so"
_NAME = re.compile(r"libLLVM(?:-(\d+)[\d.]*)?\.so(?:\.(\d+)[\d.]*)?")
_TRIAL = (
    "import drjit as dr; from drjit.llvm import Float; dr.eval(dr.minimum(dr.arange(Float, 4), 2))"
)


def llvm_major(path: Path) -> int | None:
    """Return the major version in the name of a file or of a link's target, or None."""
    for name in (path.name, path.resolve().name):
        if (match := _NAME.fullmatch(name)) and (major := match[1] or match[2]):
            return int(major)
    return None


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
    return sorted(libraries, key=lambda path: llvm_major(path) or 0, reverse=True)


def works(path: Path) -> bool:
    """Return whether Dr.Jit compiles a kernel with this library, tested in a separate process.

    Success is cached per file and machine in ``~/.cache/morgs_mi``; failure is not, because an
    update of Dr.Jit may change it.
    """
    home = os.path.expanduser("~/.cache")  # a temporary folder for a user without a home folder
    usual = tempfile.gettempdir() if home.startswith("~") else home
    cache = Path(os.environ.get("XDG_CACHE_HOME") or usual, "morgs_mi", "llvm.txt")
    key = f"{os.uname().nodename} {sys.executable} {path.resolve()} {path.stat().st_mtime_ns}"
    with suppress(OSError):
        if key in cache.read_text().splitlines():
            return True
    environment = os.environ | {VARIABLE: str(path)}
    # -P: not a drjit.py of the current folder.
    command = [sys.executable, "-P", "-c", _TRIAL]
    trial = subprocess.run(command, env=environment, capture_output=True)
    if trial.returncode != 0:
        return False
    with suppress(OSError):
        cache.parent.mkdir(parents=True, exist_ok=True)
        with cache.open("a") as file:
            file.write(key + "\n")
    return True


def usable(path: Path) -> bool:
    """Return whether Dr.Jit can use this libLLVM, from its version, or by a test where that is
    inconclusive.
    """
    if not path.is_file():
        return False
    major = llvm_major(path)
    if major is None or DOUBTFUL_MAJOR <= major < SAFE_MAJOR:
        return works(path)
    return major >= SAFE_MAJOR


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
        return best, f"{VARIABLE}={choice} is not a libLLVM that Dr.Jit can use here. {rest}"
    if best:
        return best, ""
    remark = f" (only {', '.join(map(str, libraries))}, too old for this CPU)" if libraries else ""
    return None, (
        f"Dr.Jit's CPU backend needs LLVM {SAFE_MAJOR} or newer and none was found{remark}: "
        f"{REMEDY}."
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
