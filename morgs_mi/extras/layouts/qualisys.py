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
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from morgs_mi.capture.layouts.calibration import (
    CalibratedImage,
    Calibration,
    PoseConvention,
    Reader,
    calibration_files,
    only_calibration,
)
from morgs_mi.capture.lens import opencv_lens
from morgs_mi.core.camera import Camera, pose_at, rigid
from morgs_mi.platform.bounded import check_claim, read_bytes, warn_unread
from morgs_mi.platform.checks import LARGEST, bounded, errors_at, require

_LOG = logging.getLogger(__name__)

_PATTERN = "*.qca.txt"
_SUBPIXELS = 64
# Memory of an element or an attribute, which a few characters may describe.
_VALUE_BYTES = 200
_METRES = 1e-3
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
# Attributes of a camera's elements that are read.
_EDGES = ("left", "top", "right", "bottom")
_AXES = [f"r{row}{column}" for row in "123" for column in "123"]
_PINHOLE = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
_DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)
# Others that QTM writes and that say nothing about the images.
_SENSOR = ("focallength", "sensorMinU", "sensorMaxU", "sensorMinV", "sensorMaxV")
_HARMLESS = {"fov_marker", "fov_marker_max", "fov_video_max"}
_READ = {
    "fov_video": {*_EDGES},
    "transform": {*"xyz", *_AXES},
    "intrinsic": {*_PINHOLE, *_DISTORTION, *_SENSOR, "skew"},
}
_REMEDY = "export the calibration again"


def read_qualisys(path: Path) -> list[CalibratedImage]:
    """Return the active cameras, named by their serial numbers; world units are metres.

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
    require(active, path, "expected an element `camera` for each camera", "none", _REMEDY)
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
            unread |= set(element.keys()) - _READ[element.tag]
            if element.get("skew", "").strip("0."):  # a skew of 0 changes nothing
                unread.add("skew")
        elif element.tag not in _HARMLESS:
            unread.add(element.tag)
    warn_unread(path, unread)
    return [_camera(path, element) for element in active]


class _Plain(ElementTree.TreeBuilder):
    """Builder of a document without a document type, because its entities could expand without
    bound.
    """

    def doctype(self, *_: str | None) -> None:
        raise ValueError("it declares a document type")


def _camera(path: Path, element: Element) -> CalibratedImage:
    serial = element.get("serial", "")
    where = f"{path}, camera {serial!r}"
    require(serial, path, "every `camera` must have a `serial`", "one without", _REMEDY)
    left, top, right, bottom = _numbers(where, element, "fov_video", _EDGES)
    fu, fv, cu, cv = _numbers(where, element, "intrinsic", _PINHOLE)
    K = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, _SUBPIXELS]]) / _SUBPIXELS
    K[:2, 2] -= left, top
    R = _OPENCV_FROM_OPENGL @ np.reshape(_numbers(where, element, "transform", _AXES), (3, 3))
    position = _METRES * np.array(_numbers(where, element, "transform", "xyz"))
    viewmat = rigid(where, pose_at(R, position))
    lens = opencv_lens(_numbers(where, element, "intrinsic", _DISTORTION))
    with errors_at(where):
        width = round(right - left + 1)
        camera = Camera(K, viewmat, width, round(bottom - top + 1), serial)
    return CalibratedImage(camera, lens)


def _numbers(where: str, camera: Element, name: str, keys: Sequence[str]) -> list[float]:
    """Return attributes of a camera's element `name`."""
    element = camera.find(name)
    if element is None:
        raise ValueError(f"{where}: expected an element `{name}`, found none; {_REMEDY}.")
    numbers = []
    for key in keys:
        text = element.get(key, "none")
        try:
            numbers.append(float(text))
        except ValueError:
            numbers.append(np.nan)
        require(
            bounded(numbers[-1]),
            where,
            f"`{key}` of `{name}` must be a finite number of at most {LARGEST:g}",
            text,
            "calibrate in QTM and export again",
        )
    return numbers


def _read_calibration(path: Path) -> Calibration:
    """Return the cameras that have a clip; marker cameras have none."""
    files = calibration_files(path, _PATTERN)
    return only_calibration(path, files, "one file *.qca.txt", read_qualisys)


READER = Reader(
    "Qualisys",
    ("*.qca.txt",),
    lambda path: bool(calibration_files(path, _PATTERN)),
    _read_calibration,
    PoseConvention("camera to world", "OpenGL"),
)
