"""Kinds of Gaussians in PLY files of methods other than 3D Gaussian Splatting.

| kind | recognised by | read |
|---|---|---|
| discs of 2D Gaussian Splatting | `scale_0` and `scale_1` alone | with a third axis of size 0 |
| Mip-Splatting, Gaussian Opacity Fields | varying `filter_3D` | refused |
| several timestamps (Spacetime Gaussians, 4DGS, ...) | varying time or motion | refused |
| anchors of Scaffold-GS | `f_offset_*`, `f_anchor_feat_*` | refused |

Properties that are neither read nor known to be harmless are named in a warning.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from morgs_mi.core.types import Arrays
from morgs_mi.platform.checks import few, require

_log = logging.getLogger(__name__)

# Properties of a time, a change over time, a fourth axis and the second quaternion of a rotation in
# four dimensions, which differ among the Gaussians of several timestamps.
_TIME = re.compile(
    r"t|time|times|timestamp|instant|frame|frame_?(id|index|idx|number)|t_\w+|time_\w+|mu_?t"
    r"|cov_t.*|scale_?t\w*|sigma_?t|trbf_\w+|duration|life(time|span)"
    r"|(start|end|birth|death)_?(time|frame)"
    r"|(motion|omega|velocity|vel|speed|flow|deform\w*|v|acc\w*)_?(\d+|[xyz])"
    r"|scale_3|rot_[4-7]|rot_[lr]_\d"
)
_ANCHOR = re.compile(r"f_offset_\d+|f_anchor_feat_\d+")
_FILTER = re.compile("filter_3D")
_READ = re.compile(r"[xyz]|f_dc_[0-2]|f_rest_\d+|opacity|scale_[0-2]|rot_[0-3]")
_HARMLESS = re.compile(
    r"n[xyz]|normal_?[xyz]|red|green|blue|alpha|[rgba]|(diffuse_)?(red|green|blue)|label\w*"
    r"|\w*_?id|index|segment\w*|cluster\w*|class\w*|instance\w*|semantic\w*|object\w*|category"
    r"|selected|state|error|uncertainty|confidence"
)
# Kinds that are not read: properties that vary in them, what was expected, what it is, and the
# remedy.
_REFUSED = (
    (
        _TIME,
        "expected the Gaussians of one timestamp",
        "several timestamps, as of Spacetime Gaussians or 4D Gaussian Splatting",
        "export a .ply of each timestamp with the program that trained them, which `morgs-mi "
        "import` turns into a stream",
    ),
    (
        _ANCHOR,
        "expected Gaussians",
        "anchors of Scaffold-GS, of which a network makes the Gaussians of a view",
        "export Gaussians with the program that trained them",
    ),
    (
        _FILTER,
        "expected Gaussians without a filter",
        "the 3D filter of Mip-Splatting or Gaussian Opacity Fields",
        "export fused Gaussians with its program, such as create_fused_ply.py of Mip-Splatting",
    ),
)
_GAUSSIAN = {"f_dc_0", "opacity", "scale_0", "rot_0"}
# Folders and what their files have that is not read: a sequence has a file for every frame.
_named: set[tuple[Path, str]] = set()


def as_3dgs(path: str | Path, vertices: Arrays) -> Arrays:
    """Return the properties of Gaussians of any kind as 3D Gaussian Splatting has them.

    Args:
        path: the file.
        vertices: its properties by name, [N] each.

    Raises:
        ValueError: the kind cannot be drawn, or is none.
    """
    if vertices.keys().isdisjoint(_GAUSSIAN):
        return vertices
    for pattern, expected, kind, remedy in _REFUSED:
        names = [n for n, v in vertices.items() if pattern.fullmatch(n) and (v != v[:1]).any()]
        require(not names, path, expected, f"{kind} ({few(sorted(names))})", remedy)
    integers = [n for n, v in vertices.items() if _READ.fullmatch(n) and v.dtype.kind != "f"]
    require(
        not integers,
        path,
        "expected Gaussians with floats",
        f"integers, which stand for entries of a codebook ({few(integers)})",
        "export the Gaussians uncompressed",
    )
    unread = [name for name in vertices if not (_READ.fullmatch(name) or _HARMLESS.fullmatch(name))]
    folder = Path(path).parent
    names = few(sorted([*unread, *[network.name for network in folder.glob("deformation*.pth")]]))
    if names and (folder, names) not in _named:
        _named.add((folder, names))
        _log.warning("%s: it is drawn without %s, which may change the image.", path, names)
    if "scale_2" in vertices or not vertices.keys() >= {"scale_0", "scale_1", "opacity"}:
        return vertices
    _log.warning(
        "%s: it has discs of 2D Gaussian Splatting (no scale_2); they are drawn with a third axis "
        "of size 0.",
        path,
    )
    return {**vertices, "scale_2": np.full(len(vertices["scale_0"]), -np.inf, np.float32)}
