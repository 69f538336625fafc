"""Formats of exports: files, or folders of files, chosen by the name of the output or by the name
of the format.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from morgs_mi.capture.outputs import check_output


@dataclass(frozen=True)
class Format:
    """A format of an export."""

    name: str  #: Of the format.
    ending: str  #: End of the names of its outputs; empty: of names without a suffix.
    #: Name of the output beside a stream; ``{}`` stands for the name of a camera or a path.
    default: str
    #: Whether it is a folder with a file per frame, or for a web server. With an `ending`, the file
    #: of a single frame is one, too.
    folder: bool = False

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs of this format in words."""
        if not self.folder:
            return (f"FILE{self.ending}",)
        if not self.ending:
            return ("a folder",)
        ending = "" if self.ending.startswith(".") else f" ending in {self.ending}"
        return (f"a folder{ending}", f"FILE{self._suffix} for one frame")

    @property
    def _suffix(self) -> str:
        return f".{self.ending.removeprefix('.')}"

    def is_file(self, output: str | Path) -> bool:
        """Return whether an output of this format is a file."""
        return not self.folder or (
            bool(self.ending) and Path(output).name.lower().endswith(self._suffix)
        )


PLY = (
    Format("ply", ".ply", "ply", True),
    Format("compressed.ply", ".compressed.ply", "compressed-ply", True),
)
GLTF = (Format("glb", ".glb", "gltf", True),)
USD = tuple(Format(name, f".{name}", f"stream.{name}") for name in ("usdc", "usd", "usda", "usdz"))
VIDEO = (Format("mp4", ".mp4", "{}.mp4"),)
TRACKS = (Format("npz", ".npz", "tracks.npz"),)
WEB = (Format("html", ".html", "player.html"), Format("folder", "", "web", True))
IMAGES = (*VIDEO, Format("exr", "exr", "{}-exr", True), Format("png", "png", "{}-png", True))


def choose_format(
    formats: Sequence[Format], output: str | Path | None = None, name: str | None = None
) -> Format:
    """Return the format of an output: the one called `name`, or the one that the output's name
    determines.

    Without either, it is the first one. A name without a suffix is a folder of the first format
    with folders.

    Raises:
        ValueError: no format is called `name`, or the output has another ending.
    """
    choices = [choice for choice in formats if name in (None, choice.name)]
    if not choices:
        raise ValueError(
            f"choose_format(): `format` must be {_listed([f.name for f in formats])}, got {name!r}."
        )
    if output is None or (name is not None and choices[0].folder):
        return choices[0]
    return _format_of_name(choices, output)


def _format_of_name(choices: Sequence[Format], output: str | Path) -> Format:
    """Return the format with the longest ending that the output's name has."""
    name = Path(output).name.lower()
    if matches := [choice for choice in choices if choice.ending and name.endswith(choice.ending)]:
        return max(matches, key=lambda choice: len(choice.ending))
    suffix = re.search(r"\.[a-z]\w*$", name)
    if suffix is None and (folders := [choice for choice in choices if choice.folder]):
        return folders[0]
    raise ValueError(
        f"{output}: the output must be {_outputs(choices)}, got {suffix[0] if suffix else name!r}."
    )


def _outputs(formats: Sequence[Format]) -> str:
    return _listed(list(dict.fromkeys(text for choice in formats for text in choice.outputs)))


def destination(
    stream: Path,
    output: Path | None,
    formats: Sequence[Format],
    name: str | None = None,
    stem: str = "",
) -> tuple[Path, Format]:
    """Return the path of an export and its format.

    Args:
        stream: path of the stream, beside which an output without a name is written.
        output: the given file or folder, or None.
        formats: formats of the export.
        name: name of the given format, or None.
        stem: name of a camera or a path, for the name of the output.

    Raises:
        ValueError: as `choose_format` and `check_output`, a folder stands where a file is to be
            written, or the output is the stream itself, by any of its names.
    """
    choice = choose_format(formats, output, name)
    path = check_output(output or stream.with_name(choice.default.format(stem)))
    if choice.is_file(path) and path.is_dir():
        raise ValueError(f"{path}: expected a file to write, got a folder; choose another name.")
    _check_not_source(path, stream)
    return path, choice


def _check_not_source(output: Path, stream: Path) -> None:
    if output.exists() and stream.exists() and output.samefile(stream):
        raise ValueError(
            f"{output}: expected an output beside its source, got the source itself; choose "
            "another name."
        )


def _listed(names: Sequence[str]) -> str:
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
