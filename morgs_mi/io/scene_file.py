"""Scenes in Python files, which define a function `build`."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import Any

from morgs_mi.platform.checks import require


def build_of(path: Path, expected: str) -> Callable[..., Any]:
    """Return the function `build` of a Python file, after running it.

    Raises:
        ValueError: it has none with the signature `expected`, or it fails.
    """
    spec = importlib.util.spec_from_file_location(f"morgs_mi_scene_{path.stem}", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up the names of their postponed annotations in `sys.modules`.
    sys.modules[spec.name] = module
    with failures_in(path):
        spec.loader.exec_module(module)
    build: Any = getattr(module, "build", None)
    require(callable(build), path, f"it must define `{expected}`", "none", "add that function")
    return build


@contextmanager
def failures_in(path: Path) -> Iterator[None]:
    """Raise `ValueError` with the line of the file at `path` for any error of the code in it."""
    try:
        yield
    except Exception as error:
        # The file name of a frame is absolute. A syntax error has no frame, but names its line.
        frames = extract_tb(error.__traceback__)
        file = path.resolve()
        lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == file]
        place = f"{path}, line {lines[-1]}" if lines else str(path)
        kind = type(error).__name__
        raise ValueError(
            f"{place}: {kind}: {str(error).rstrip('.')}; correct the scene file."
        ) from error
