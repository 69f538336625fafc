"""A stream as an OpenUSD stage with `ParticleField3DGaussianSplat` prims (schema UsdVol, OpenUSD
26.03 and newer).

Each frame is a time code. The attributes follow the schema, which differs from the layout of 3D
Gaussian Splatting:

    positions                                   point3f[N]    centres
    orientations                                quatf[N]      unit quaternions
    scales                                      float3[N]     standard deviations, no logarithms
    opacities                                   float[N]      0 to 1, not logits
    radiance:sphericalHarmonicsDegree           int           the same for all Gaussians and times
    radiance:sphericalHarmonicsCoefficients     float3[N K]   RGB, the K of a Gaussian in a row
    extent                                      float3[2]     box around three standard deviations

A prim has an element for each Gaussian that lives in any frame, in the order of their ids. In
frames outside of its life its opacity is 0, and its other attributes are as at its birth or death.
USD would also accept arrays with lengths that change with time. But between two time samples, as
for motion blur, it interpolates arrays of equal length element by element: where as many Gaussians
die as are born, it would mix different ones, and where the numbers differ, nothing would move. With
constant lengths all survivors move, and a Gaussian fades in during the frame before its birth and
out during the frame after its last. Arrays that do not change have no further samples, and few
Gaussians are born in later frames. The additional elements take little room.

Where a keyframe starts a new set of Gaussians, a new prim begins, and `visibility` switches between
them.

The stage has y up, like glTF's: centres, rotations and harmonics are rotated, because not every
renderer rotates the harmonics with a prim. The unit of a capture is unknown; `metersPerUnit` is 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.special import expit

from morgs_mi.codec.frame_source import FrameSource, FrameState
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances, rotated, unit_quats
from morgs_mi.core.types import Arrays
from morgs_mi.extras.exports.gltf_export import gltf_axes
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import atomic_path
from morgs_mi.platform.progress import StepReport, unreported
from morgs_mi.playback.export.formats import USD, choose_format
from morgs_mi.playback.stream_header import stream_origin

_COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
_DEGREE = "radiance:sphericalHarmonicsDegree"
# Types of the arrays in pxr.Vt, as float and as half. Half positions would have steps of a
# thousandth of the scene.
_TYPES = {
    "positions": ("Vec3fArray", None),
    "orientations": ("QuatfArray", "QuathArray"),
    "scales": ("Vec3fArray", "Vec3hArray"),
    "opacities": ("FloatArray", "HalfArray"),
    _COEFFICIENTS: ("Vec3fArray", "Vec3hArray"),
    "extent": ("Vec3fArray", None),
}
_LARGEST_HALF = 65504.0
_EXTENT_SIGMAS = 3.0
UNSAVED_BYTES = 2**28  # of samples in memory
_INSTALL = "install it with pip install 'morgs-mi[usd]'"


def write_usd(
    stream: FrameSource,
    path: str | Path,
    frames: Sequence[int],
    half: bool = False,
    progress: StepReport = unreported,
) -> None:
    """Write frames of a stream as an OpenUSD stage; the file is written atomically. See the module
    for its content.

    The stream is decoded twice: the first time for the lives of the Gaussians. Motion and
    confidence are not written.

    Args:
        stream: the file.
        path: the stage, ``FILE.usdc`` or ``.usd`` (binary), ``.usda`` (text) or ``.usdz``
            (package).
        frames: indices of the frames, ascending.
        half: write all attributes but the positions in half precision, in the attributes that the
            schema has for it.
        progress: called with (frames done, number of frames).

    Raises:
        ValueError: another suffix, a broken packet, or the package usd-core is missing.
        OSError: the file cannot be written.
    """
    path = Path(path)
    choose_format(USD, path)
    pxr = _pxr()
    with atomic_path(path, "write_usd()") as partial:
        try:
            with TemporaryDirectory() as folder:
                is_package = path.suffix.lower() == ".usdz"
                content = Path(folder) / f"{path.stem}.usdc" if is_package else partial
                _write_stage(pxr, stream, content, frames, half, progress)
                if is_package:
                    pxr.UsdUtils.CreateNewUsdzPackage(str(content), str(partial))
        except pxr.Tf.ErrorException as error:
            # Errors of OpenUSD are file system errors here. The first one has the reason, the
            # others follow from it.
            raise OSError(getattr(error.args[0], "commentary", str(error))) from error


def _write_stage(
    pxr: Any,
    stream: FrameSource,
    path: Path,
    frames: Sequence[int],
    half: bool,
    progress: StepReport,
) -> None:
    """Write a file that is not a package; the arguments are the same as for `write_usd`."""
    axes = gltf_axes(stream.cameras)
    sets = _sets(_states(stream, frames), axes)
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(stream.fps)
    stage.SetFramesPerSecond(stream.fps)
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[-1])
    xform = pxr.UsdGeom.Xform.Define(stage, "/Stream")
    if (origin := stream_origin(stream)).any():
        xform.AddTranslateOp().Set(pxr.Gf.Vec3d(*(axes @ origin)))
    root = xform.GetPrim()
    pxr.Usd.ModelAPI(root).SetKind(pxr.Kind.Tokens.component)
    # Rotation back to the capture's axes, of row vectors: x_world = x_usd M.
    root.SetCustomDataByKey("world_from_usd", pxr.Gf.Matrix3d(np.asarray(axes, np.float64)))
    stage.SetDefaultPrim(root)
    # A prim for each set, with what does not change.
    fields = {}
    ends = [*(gaussians.start for gaussians in sets.values()), None][1:]
    for number, ((first_id, gaussians), end) in enumerate(zip(sets.items(), ends, strict=True)):
        prim_path = f"/Stream/Gaussians{number or ''}"
        splats = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, prim_path)
        prim = splats.GetPrim()
        prim.GetAttribute(_DEGREE).Set(gaussians.degree)
        splats.CreateProjectionModeHintAttr("perspective")
        splats.CreateSortingModeHintAttr("zDepth")
        # As far as the schema goes: it does not state the space of the coefficients.
        prim.GetAttribute(_COEFFICIENTS + ("h" if half else "")).SetColorSpace(
            pxr.Gf.ColorSpaceNames.SRGBRec709
        )
        # The prim is visible until the next set starts.
        visibility = splats.CreateVisibilityAttr
        if gaussians.start > frames[0]:
            visibility().Set("invisible", frames[0])
            visibility().Set("inherited", gaussians.start)
        if end is not None:
            visibility().Set("inherited", gaussians.start)
            visibility().Set("invisible", end)
        fields[first_id] = _Field(pxr, prim, gaussians, half)
    unsaved_bytes = 0
    for count, state in enumerate(_states(stream, frames), start=1):
        unsaved_bytes += fields[state.first_id].put(state, axes)
        # A binary file is appended to, which bounds the memory; a text would be written again.
        if unsaved_bytes > UNSAVED_BYTES and path.suffix.lower() != ".usda":
            stage.Save()
            unsaved_bytes = 0
        progress(count, len(frames))
    stage.Save()


def _states(stream: FrameSource, frames: Sequence[int]) -> Iterator[FrameState]:
    """Return the states of some frames."""
    selection = set(frames)
    return (state for state in stream.states() if state.frame in selection)


@dataclass
class _Set:
    """The Gaussians that begin with one keyframe."""

    start: int  # the first frame
    degree: int  # of the spherical harmonics
    ids: np.ndarray  # uint32 [M], ascending
    births: Arrays  # attributes [M, ...] at birth, by the names of the schema


def _sets(states: Iterator[FrameState], axes: np.ndarray) -> dict[int, _Set]:
    """Return the sets of Gaussians by the number that is added to their ids."""
    parts_of: dict[int, list[tuple[np.ndarray, Arrays]]] = {}
    starts: dict[int, tuple[int, int]] = {}
    for state in states:
        parts = parts_of.setdefault(state.first_id, [])
        starts.setdefault(state.first_id, (state.frame, state.gaussians.sh_degree))
        last_id = parts[-1][0][-1] if parts else -1
        births = state.ids.astype(np.int64) > last_id
        if births.any():
            parts.append(
                (state.ids[births], _values(rotated(state.gaussians.select(births), axes)))
            )
    sets = {}
    for first_id, parts in parts_of.items():
        ids = np.concatenate([np.zeros(0, np.uint32), *(ids for ids, _ in parts)])
        names = parts[0][1] if parts else ()
        births = {name: np.concatenate([values[name] for _, values in parts]) for name in names}
        sets[first_id] = _Set(*starts[first_id], ids, births)
    return sets


def _values(gaussians: Gaussians) -> Arrays:
    """Return the attributes float32 [N, ...] by the names of the schema; quaternions are xyzw, as
    in memory.
    """
    raw = gaussians.numpy()
    values = {
        "positions": raw["means"],
        "orientations": np.roll(unit_quats(gaussians), -1, axis=1),
        "scales": np.exp(raw["log_scales"]),
        "opacities": expit(raw["logit_opacities"]),
        _COEFFICIENTS: raw["sh_coeffs"],
    }
    return {name: value.astype(np.float32) for name, value in values.items()}


class _Field:
    """Writer of the time samples of one prim."""

    def __init__(self, pxr: Any, prim: Any, gaussians: _Set, half: bool) -> None:
        self._ids = gaussians.ids
        self._state = {name: value.copy() for name, value in gaussians.births.items()}
        self._samples = {}
        for name, types in _TYPES.items():
            is_half = half and types[1] is not None
            attribute = prim.GetAttribute(f"{name}h" if is_half else name)
            array = getattr(pxr.Vt, types[is_half])
            self._samples[name] = _Samples(attribute, array, np.float16 if is_half else np.float32)

    def put(self, state: FrameState, axes: np.ndarray) -> int:
        """Write a frame and return the number of bytes of its samples."""
        if not len(self._ids):
            return 0
        gaussians = rotated(state.gaussians, axes)
        rows = np.searchsorted(self._ids, state.ids)
        self._state["opacities"][:] = 0
        for name, value in _values(gaussians).items():
            self._state[name][rows] = value
        # The corners of the box around all Gaussians.
        extent = np.zeros((2, 3), np.float32)
        if len(gaussians):
            means = gaussians.numpy()["means"]
            reach = _EXTENT_SIGMAS * np.sqrt(np.diagonal(covariances(gaussians), axis1=1, axis2=2))
            extent[:] = (means - reach).min(axis=0), (means + reach).max(axis=0)
        values = {**self._state, "extent": extent}
        return sum(self._samples[name].put(state.frame, value) for name, value in values.items())


@dataclass
class _Samples:
    """Time samples of an attribute; a value that stays the same has one at its begin and one at its
    end.

    `UsdUtils.SparseAttrValueWriter` does the same for values that are equal up to a tolerance.
    """

    attribute: Any
    array: Any
    dtype: type
    last: np.ndarray = field(default_factory=lambda: np.empty(0))
    last_time: int | None = None

    def put(self, time: int, values: np.ndarray) -> int:
        if np.array_equal(values, self.last):
            self.last_time = time
            return 0
        if self.last_time is not None:
            self._set(self.last_time, self.last)
        self.last = values.copy()
        self.last_time = None
        self._set(time, values)
        return values.nbytes

    def _set(self, time: int, values: np.ndarray) -> None:
        rows = values.reshape(-1, values.shape[-1]) if values.ndim > 1 else values
        if self.dtype is np.float16:
            rows = np.clip(rows, -_LARGEST_HALF, _LARGEST_HALF)
        rows = np.ascontiguousarray(rows, self.dtype)
        self.attribute.Set(self.array.FromNumpy(rows), time)


def _pxr() -> Any:
    """Return the modules of OpenUSD.

    Raises:
        ValueError: OpenUSD, or its schema of Gaussians, is missing.
    """
    names = ("Gf", "Kind", "Tf", "Usd", "UsdGeom", "UsdUtils", "UsdVol", "Vt")
    try:
        modules = SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in names})
    except ImportError as error:
        raise ValueError(
            f"write_usd(): expected the package usd-core, found none; {_INSTALL}."
        ) from error
    require(
        hasattr(modules.UsdVol, "ParticleField3DGaussianSplat"),
        "write_usd()",
        "expected OpenUSD 26.3 or newer",
        ".".join(map(str, modules.Usd.GetVersion()[1:])),
        _INSTALL,
    )
    return modules
