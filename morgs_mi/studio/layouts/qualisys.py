"""Calibrations that Qualisys Track Manager exports: XML in a file ``*.qca.txt``.

A ``camera`` has a ``serial``, and three elements:

- ``fov_video``: the first and last column and row of the image on the sensor, in pixels;
- ``transform``: the camera's position x, y, z in millimetres, and in r11 r12 r13, r21 r22 r23, r31
  r32 r33 its axes (x right, y up, z backward) in the world;
- ``intrinsic``: focal lengths and principal point in 1/64 pixel from the sensor's corner, and the
  distortion coefficients of OpenCV's model, which have no unit.

The format is not documented. Signs and units follow files of Qualisys systems and the programs that
read them. Pose2Sim also divides the distortion coefficients by 64, which makes them negligible.
Positions are converted to metres.
"""

from __future__ import annotations

import logging
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from morgs_mi.capture.layouts.calibration import (
    Calibration,
    PoseConvention,
    Reader,
    calibration_files,
    match_clips,
    only_calibration,
    required_clips,
)
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.bounded import check_claim, read_bytes
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.io.unread import warn_unread

_LOG = logging.getLogger(__name__)

_PATTERN = "*.qca.txt"
_SUBPIXELS = 64
# Memory of an element or an attribute, which a few characters may describe.
_VALUE_BYTES = 200
_METRES = 1e-3
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
# Attributes of a camera's elements that are read, and others that QTM writes and that say nothing
# about the images.
_READ = {
    "fov_video": {"left", "top", "right", "bottom"},
    "transform": {*"xyz", *(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))},
    "intrinsic": {
        "focalLengthU",
        "focalLengthV",
        "centerPointU",
        "centerPointV",
        "focallength",
        "radialDistortion1",
        "radialDistortion2",
        "radialDistortion3",
        "tangentalDistortion1",
        "tangentalDistortion2",
        "sensorMinU",
        "sensorMaxU",
        "sensorMinV",
        "sensorMaxV",
    },
}
_HARMLESS = {"fov_marker", "fov_marker_max", "fov_video_max"}
_DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
)


def read_qualisys(path: Path) -> tuple[list[Camera], list[Lens]]:
    """Return the active cameras, named by their serial numbers, and their lenses; world units are
    metres.

    Raises:
        ValueError: the file is broken, an element or attribute of a camera is missing or is no
            number, or its axes are not orthonormal.
    """
    data = read_bytes(path)
    values = data.count(b"<") + data.count(b"=")
    check_claim(path, _VALUE_BYTES * values, f"{values} elements and attributes")
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Plain()))
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(
            f"{path}: expected XML, got a broken file ({error}); export it again."
        ) from None
    active = [element for element in root.iter("camera") if element.get("active", "1") != "0"]
    if not active:
        raise ValueError(
            f"{path}: expected an element `camera` for each camera, found none; export the "
            "calibration again."
        )
    if serials := [
        element.get("serial", "?") for element in active if element.get("viewrotation", "0") != "0"
    ]:
        _LOG.warning(
            "%s: QTM displays %s rotated (viewrotation); their clips must show the images as the "
            "sensor recorded them.",
            path,
            ", ".join(serials),
        )
    unread: set[str] = set()
    for element in (element for camera in active for element in camera):
        if element.tag in _READ:
            others = set(element.keys()) - _READ[element.tag]
            # A `skew` of 0 changes nothing.
            if not element.get("skew", "").strip("0."):
                others.discard("skew")
            unread |= others
        elif element.tag not in _HARMLESS:
            unread.add(element.tag)
    warn_unread(path, unread)
    pairs = [_camera(path, element) for element in active]
    return [camera for camera, _ in pairs], [lens for _, lens in pairs]


class _Plain(ElementTree.TreeBuilder):
    """Builder of a document without a document type, because its entities could expand without
    bound.
    """

    def doctype(self, *_: str | None) -> None:
        raise ValueError("it declares a document type")


def _camera(path: Path, element: Element) -> tuple[Camera, Lens]:
    serial = element.get("serial", "")
    where = f"{path}, camera {serial!r}"
    if not serial:
        raise ValueError(
            f"{path}: every `camera` must have a `serial`, got one without; export the "
            "calibration again."
        )
    left, top, right, bottom = _numbers(
        where, element, "fov_video", "left", "top", "right", "bottom"
    )
    fu, fv, cu, cv = _numbers(
        where, element, "intrinsic", "focalLengthU", "focalLengthV", "centerPointU", "centerPointV"
    )
    K = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, _SUBPIXELS]]) / _SUBPIXELS
    K[:2, 2] -= left, top
    axes = _numbers(
        where,
        element,
        "transform",
        *(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
    )
    R = _OPENCV_FROM_OPENGL @ np.reshape(axes, (3, 3))
    position = _METRES * np.array(_numbers(where, element, "transform", "x", "y", "z"))
    viewmat = rigid(where, np.column_stack([R, -R @ position]))
    k1, k2, p1, p2 = _numbers(where, element, "intrinsic", *_DISTORTION)
    (k3,) = _numbers(where, element, "intrinsic", "radialDistortion3")
    try:
        camera = Camera(K, viewmat, round(right - left + 1), round(bottom - top + 1), serial)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return camera, opencv_lens((k1, k2, p1, p2, k3))


def _numbers(where: str, camera: Element, name: str, *keys: str) -> list[float]:
    """Return attributes of a camera's element `name`."""
    element = camera.find(name)
    if element is None:
        raise ValueError(
            f"{where}: expected an element `{name}`, found none; export the calibration again."
        )
    numbers = []
    for key in keys:
        text = element.get(key)
        try:
            numbers.append(float(text or "nan"))
        except ValueError:
            numbers.append(np.nan)
        if not bounded(numbers[-1]):
            got = "none" if text is None else repr(text)
            raise ValueError(
                f"{where}: `{key}` of `{name}` must be a finite number of at most {LARGEST:g}, "
                f"got {got}; calibrate in QTM and export again."
            )
    return numbers


def _read_calibration(path: Path) -> Calibration:
    """Return the cameras that have a clip; marker cameras have none."""
    source = only_calibration(path, calibration_files(path, _PATTERN), "one file *.qca.txt")
    cameras, lenses = read_qualisys(source)
    return match_clips(path, source, required_clips(path), cameras, lenses)[0]


READER = Reader(
    "Qualisys",
    ("*.qca.txt",),
    lambda path: bool(calibration_files(path, _PATTERN)),
    _read_calibration,
    PoseConvention("camera to world", "OpenGL"),
)
