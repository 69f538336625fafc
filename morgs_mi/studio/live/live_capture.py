"""The capture of a live fit: a folder with the calibration and the images that are fitted.

It is a capture like any other: a stream can be evaluated on it, and its frames fitted again.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.layouts.calibration import Calibration
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.reader_registry import find_reader
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.files import atomic_path, write_json
from morgs_mi.core.fit_names import CAPTURE
from morgs_mi.core.png import png_bytes
from morgs_mi.core.progress import Report
from morgs_mi.core.threads import map_in_threads
from morgs_mi.studio.calibration.calibrate import calibrate
from morgs_mi.studio.live.live_config import LiveConfig

_LOG = logging.getLogger(__name__)


def read_calibration(folder: Path) -> Calibration:
    """Return the cameras of an earlier capture of the same rig.

    Raises:
        FileNotFoundError, ValueError: it is missing or broken.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: expected a calibrated capture of the cameras, found none; check the path."
        )
    calibration = find_reader(folder).read(folder)
    if any(calibration.masks):
        _LOG.warning("%s: its masks are not used by a live fit.", folder)
    return calibration


def begin_capture(
    folder: Path,
    names: Sequence[str],
    images: Sequence[np.ndarray | None],
    config: LiveConfig,
    calibration: Calibration | None = None,
    on_stage: Report | None = None,
) -> Capture:
    """Write the first images and the calibration of live cameras, and return the capture, which has
    one frame.

    Args:
        folder: is made, and must not exist.
        names: names of the cameras.
        images: one per camera, uint8 [H, W, 3], RGB.
        config: settings.
        calibration: of the cameras; None: they are calibrated by the images.
        on_stage: called with (name, done, total) of the calibration.

    Raises:
        OSError: the disk is full or not writable.
        ValueError: the cameras cannot be calibrated, or the images do not have the calibrated
            sizes.
    """
    try:
        write_images(folder, names, images, 0)
        write_json(folder / CAPTURE, {"fps": config.fps})
        if calibration is not None:
            write_colmap(
                folder / "sparse" / "0",
                calibration.cameras,
                calibration.points,
                calibration.point_colors,
                calibration.lenses,
            )
        else:
            try:
                calibrate(folder, progress=on_stage)
            except ValueError as error:
                error.add_note(
                    f"The images are in {folder}: calibrate them with morgs-mi calibrate, which "
                    "has more options, and pass that folder with --calibration."
                )
                raise
        # A camera may stop: later frames are read without its images.
        return load_capture(
            folder, config.downscale, config.test_view or None, reading=ReadConfig(gaps=True)
        )
    except (OSError, ValueError) as error:
        # The fit can be started again; images that cannot be calibrated stay.
        if calibration is not None or isinstance(error, OSError):
            shutil.rmtree(folder, ignore_errors=True)
        raise


def write_images(
    folder: Path, names: Sequence[str], images: Sequence[np.ndarray | None], frame: int
) -> None:
    """Write the images of a frame into a capture, side by side.

    Raises:
        OSError: the disk is full or not writable.
    """

    def write(view: int) -> None:
        image = images[view]
        if image is not None:
            file = folder / names[view] / f"{frame:04d}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file, "fit_live()") as partial:
                partial.write_bytes(png_bytes(image))

    map_in_threads(write, range(len(names)))
