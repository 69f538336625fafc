"""Optical flow that another program has computed, read from files.

Layout of a folder of flow, one folder per camera of the capture and direction:

    FLOW/cam00/forward/0000.flo     from frame 0 to frame 1, on frame 0's grid
    FLOW/cam00/backward/0001.flo    from frame 1 to frame 0, on frame 1's grid

A file has the number of the frame that its pixel grid belongs to. Flow tools name their output
after the first image of a pair, so run the tool over the frames in order, then again in reverse
order. The number is the last one in the file's name, with any prefix and any number of zeros
(`frame_0001.flo`); frames count from 0.

Flow is in pixels of the images that the package fits (undistorted, downscaled), x to the right and
y down. A `.flo` file (Middlebury) holds the float32 202021.25, width and height as int32, then x
and y of every pixel row by row as float32, all little-endian. An EXR file holds the channels
`flow.X` and `flow.Y`, `X` and `Y`, `u` and `v`, or `R` and `G`. The renderer's own `motion.X` and
`motion.Y` point the other way and are rejected.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi.io.exr import read_exr
from morgs_mi.io.listing import listed
from morgs_mi.io.numbering import frames_by_number
from morgs_mi.method.flow_sources.flow_registry import (
    FLOW_SOURCES,
    FlowConfig,
    FlowSource,
    FramePair,
)

_SUFFIXES = (".flo", ".exr")

_MAGIC = 202021.25
_HEADER = np.dtype([("magic", "<f4"), ("width", "<i4"), ("height", "<i4")])
_CHANNELS = (("flow.X", "flow.Y"), ("X", "Y"), ("u", "v"), ("R", "G"))
# In Middlebury's files, a larger value marks a pixel of unknown flow.
_UNKNOWN = 1e9


def read_flow(path: Path) -> np.ndarray:
    """Return the flow [H, W, 2] in pixels, float32, of a `.flo` or EXR file.

    Raises:
        OSError: an EXR file cannot be read.
        ValueError: a `.flo` file without its magic number or of another length than its header
            states, an EXR file without exactly one known pair of channels, or pixels without flow.
    """
    try:
        flow = _read_flo(path) if path.suffix.lower() == ".flo" else _read_exr(path)
        unknown = ~(np.abs(flow) < _UNKNOWN).all(axis=2)
        if unknown.any():
            y, x = np.argwhere(unknown)[0]
            raise ValueError(
                f"a flow at every pixel, got none at {unknown.sum()} of {unknown.size}, the first "
                f"at x={x}, y={y}; use a method that returns dense flow"
            )
    except ValueError as error:
        raise ValueError(f"{path}: expected {error}.") from None
    return flow


def _read_flo(path: Path) -> np.ndarray:
    data = path.read_bytes()
    header = np.frombuffer(data[: _HEADER.itemsize].ljust(_HEADER.itemsize, b"\0"), _HEADER)[0]
    width = int(header["width"])
    height = int(header["height"])
    length = _HEADER.itemsize + 8 * width * height
    is_flo = header["magic"] == np.float32(_MAGIC)
    if not is_flo or min(width, height) < 1 or len(data) != length:
        raise ValueError(
            f"{length} bytes for {width}x{height} pixels, got {len(data)}; the file may be cut "
            "short"
            if is_flo
            else f"a .flo file, which begins with the float {_MAGIC}, got {data[:4]!r}"
        )
    numbers = np.frombuffer(data, "<f4", offset=_HEADER.itemsize)
    return numbers.reshape(height, width, 2).astype(np.float32)


def _read_exr(path: Path) -> np.ndarray:
    channels = read_exr(path)
    pairs = [pair for pair in _CHANNELS if set(pair) <= channels.keys()]
    # The renderer's files hold colours beside the motion: their R and G are not flow.
    if len(pairs) != 1 or "motion.X" in channels:
        names = ", ".join(map("/".join, _CHANNELS))
        raise ValueError(
            f"one pair of the channels {names}, and no motion map, got "
            f"{', '.join(sorted(channels))}"
        )
    return np.stack([channels[name] for name in pairs[0]], axis=-1)


@FLOW_SOURCES.register("files", "FOLDER")
def flow_files(folder: str, config: FlowConfig) -> FlowSource:
    """Return the flow of files in the layout above; files may be added later.

    Raises:
        FileNotFoundError: there is no such folder, or later no file of a frame.
        ValueError: later, a frame has two files, a flow has another size than its images, or as
            `read_flow`.
    """
    if not Path(folder).is_dir():
        raise FileNotFoundError(
            f"{folder}: expected a folder of flow files, found none; check the path."
        )
    numbered: dict[Path, dict[int, Path]] = {}

    def flow(pair: FramePair, direction: str, frame: int) -> np.ndarray:
        place = Path(folder) / pair.camera / direction
        if frame not in numbered.get(place, {}):  # files may have been added since
            content = listed(place) if place.is_dir() else ()
            paths = {path.name: path for path in content if path.suffix.lower() in _SUFFIXES}
            numbered[place] = frames_by_number(place, paths) if paths else {}
        files = numbered[place]
        if frame not in files:
            content = f"files of frames {min(files)} to {max(files)}" if files else "no flow at all"
            raise FileNotFoundError(
                f"{place}: expected a .flo or .exr file of frame {frame}, found {content}; name "
                "each file after the frame on whose grid its flow lives, counting from 0."
            )
        vectors = read_flow(files[frame])
        rows, columns = pair.image.shape[:2]
        if vectors.shape != (rows, columns, 2):
            raise ValueError(
                f"{files[frame]}: expected {columns}x{rows} pixels as the images of {pair.camera} "
                f"have, got {vectors.shape[1]}x{vectors.shape[0]}; compute the flow on undistorted "
                "and downscaled images."
            )
        return vectors

    return lambda pair: (
        flow(pair, "backward", pair.frame),
        flow(pair, "forward", pair.frame - 1),
    )
