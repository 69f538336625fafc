"""Multi-channel float32 EXR files with the channel names of the renderer's AOVs (`motion.X`, ...)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from morgs_mi.core.files import atomic_path

__all__ = ["read_exr", "write_exr"]


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray]) -> None:
    """Write `channels`, each [H, W], as one float32 EXR file, atomically.

    Raises:
        ValueError: there is no channel, or the channels differ in shape.
        OSError: the file cannot be written.
    """
    shapes = {name: np.shape(channel) for name, channel in channels.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 2 for shape in shapes.values()):
        raise ValueError(f"write_exr(): `channels` must share one shape [H, W], got {shapes}; pass one image each.")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.ascontiguousarray(channel, np.float32) for name, channel in channels.items()}
    with atomic_path(path, "write_exr()") as partial:
        try:
            OpenEXR.File(header, pixels).write(str(partial))
        except RuntimeError as error:
            raise OSError(str(error)) from error


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Return the channels of an EXR file by name, each [H, W] as float32.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it is not a readable EXR file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"read_exr(): there is no file {path}; check the path.")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise OSError(f"read_exr(): cannot read {path}: {error}; the file may be truncated.") from error
