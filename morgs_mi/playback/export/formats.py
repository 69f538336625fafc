"""Formats of exports: files, or folders of files, chosen by the name of the output."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from morgs_mi.capture.outputs import check_output
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import STREAM, atomic_folder, atomic_path


@dataclass(frozen=True)
class Format:
    """A format of an export."""

    name: str  #: Of the format, which its files end in; empty: it is a folder alone.
    #: Name of the output beside a stream; ``{}`` stands for the name of a camera or a path.
    default: str
    #: Whether it is a folder with a file per frame, or one for a web server.
    folder: bool = False
    endings: tuple[str, ...] = ()  #: Ends of the names of such folders; none: no suffix.

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The suffix of its files; none for a folder for a web server."""
        return (f".{self.name}",) if self.name else ()

    def is_file(self, output: str | Path) -> bool:
        """Return whether an output of this format is a file."""
        return not self.folder or Path(output).name.lower().endswith(self.suffixes)


PLY = (
    Format("ply", "ply", folder=True),
    Format("compressed.ply", "compressed-ply", folder=True, endings=("compressed-ply",)),
)
GLTF = (Format("glb", "gltf", folder=True),)
USD = tuple(Format(name, f"stream.{name}") for name in ("usdc", "usd", "usda", "usdz"))
VIDEO = (Format("mp4", "{}.mp4"), Format("webm", "{}.webm"))
WEB = (Format("html", "player.html"), Format("", "web", folder=True))
SHEET = (Format("png", "{}.png"),)
IMAGES = (
    *VIDEO,
    Format("exr", "{}-exr", folder=True, endings=("exr",)),
    Format("png", "{}-png", folder=True, endings=("png",)),
)


def choose_format(formats: Sequence[Format], output: str | Path | None = None) -> Format:
    """Return the format that an output's name determines.

    Without an output, it is the first one. A name without a suffix is a folder of the first format
    with folders.

    Raises:
        ValueError: the output has another ending.
    """
    if output is None:
        return formats[0]
    name = Path(output).name.lower()
    for choice in sorted(formats, key=lambda choice: len(choice.name), reverse=True):
        if name.endswith((*choice.suffixes, *choice.endings)):
            return choice
    suffix = re.search(r"\.[a-z]\w*$", name)
    folders = [choice for choice in formats if choice.folder]
    if suffix is None and folders:
        return folders[0]
    names = [f"FILE.{choice.name}" for choice in formats if choice.name]
    names += [" ending in ".join(("a folder", *choice.endings)) for choice in folders]
    raise ValueError(
        f"{output}: the output must be {' or '.join(names)}, got "
        f"{suffix[0] if suffix else name!r}; name such a one, and convert it by another program, "
        "such as ffmpeg for videos."
    )


@contextmanager
def frame_files(
    output: str | Path, is_file: bool, suffix: str, place: str
) -> Iterator[Callable[[int], Path]]:
    """Write frames as ``0000.SUFFIX``, ``0001.SUFFIX``, ... into a new folder, or one frame as a
    file; atomically. The context is the function that returns the path for a frame.

    Args:
        output: the folder or the file.
        is_file: whether it is a file.
        suffix: of the files in a folder, with its dot.
        place: where an error's sentence begins.

    Raises:
        ValueError: several frames for one file.
        OSError: the folder exists, or a file cannot be written.
    """
    frames: list[int] = []
    with (atomic_path if is_file else atomic_folder)(output, place) as partial:

        def file_of(frame: int) -> Path:
            frames.append(frame)
            require(
                not is_file or len(frames) == 1,
                output,
                "expected one frame for one file",
                "several",
                "select one (--frames), or name a folder",
            )
            return partial if is_file else partial / f"{frame:04d}{suffix}"

        yield file_of


def destination(
    stream: Path,
    output: Path | None,
    formats: Sequence[Format],
    stem: str = "",
) -> tuple[Path, Format]:
    """Return the path of an export and its format.

    Args:
        stream: path of the stream, beside which an output without a name is written; the name of a
            file begins with its own.
        output: the given file or folder, or None.
        formats: formats of the export.
        stem: name of a camera or a path, for the name of the output.

    Raises:
        ValueError: as `choose_format` and `check_output`, a folder stands where a file is to be
            written, or the output is the stream itself, by any of its names.
    """
    choice = choose_format(formats, output)
    # Files of several scenes may lie in one folder.
    scene = "" if stream.name == STREAM else f"{stream.name.partition('.')[0]}-"
    path = check_output(output or stream.with_name(scene + choice.default.format(stem)))
    remedy = "choose another name"
    is_writable = not (choice.is_file(path) and path.is_dir())
    require(is_writable, path, "expected a file to write", "a folder", remedy)
    is_source = path.exists() and stream.exists() and path.samefile(stream)
    require(not is_source, path, "expected an output beside its source", "the source", remedy)
    return path, choice
