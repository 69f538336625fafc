"""Files of Gaussians in other formats than those that are read, recognised by their names."""

from __future__ import annotations

from pathlib import Path

_CONVERTED = (".spz", ".ksplat", ".sog", ".sogs", "meta.json", ".lcc")
_EXPORTED = (
    *(".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz"),
    *(".splatv", ".gsz", ".rad", ".splatz", ".cply", ".npz", ".npy", ".pt", ".pth", ".ckpt"),
)
_PACKED = (".zip", ".7z", ".tar", ".gz", ".tgz")
# What to do with files of some endings.
_REMEDIES = {
    _CONVERTED: "convert it to .ply with SuperSplat (superspl.at/editor) or splat-transform "
    "(@playcanvas/splat-transform)",
    _EXPORTED: "export it as .ply in the layout of 3D Gaussian Splatting from the program that "
    "wrote it",
    _PACKED: "unpack it, and name the .ply in it",
}


def refuse_foreign(path: str | Path) -> None:
    """Raise an error if a file has Gaussians in a format that is not read.

    Raises:
        ValueError: the format is another one; the sentence names what converts it.
    """
    name = Path(path).name.lower()
    remedy = next((words for endings, words in _REMEDIES.items() if name.endswith(endings)), None)
    if remedy is None and not name.endswith(".ply") and _is_ply(Path(path)):
        remedy = "rename it to .ply"
    if remedy is not None:
        raise ValueError(
            f"{path}: expected Gaussians as .ply, .compressed.ply or .splat, which {name} is not; "
            f"{remedy}."
        )


def _is_ply(path: Path) -> bool:
    """Return whether a path is a file that begins as PLY files do."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(4) in (b"ply\n", b"ply\r")
