"""A view of a recording: a camera with its clip. Images of the clip are undistorted, so that a
pinhole camera shows them, and are read at the timestamps that all clips share.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from morgs_mi.capture.interpolation import FrameInterpolation
from morgs_mi.capture.layouts.calibration import CalibratedView
from morgs_mi.capture.lens import Lens, Undistortion, undistortion
from morgs_mi.capture.masks import scaled_mask, used_in_clip
from morgs_mi.capture.timeline import ClipTimes
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_light, display_image, encode_light
from morgs_mi.core.view import View
from morgs_mi.io.clip_readers import FrameReader
from morgs_mi.io.images import ImageOrError
from morgs_mi.platform.bounded import JsonObject


@dataclass(frozen=True, eq=False)
class RecordedView(View):
    """A view of a recording: a camera with its clip and the processing of its images."""

    reader: FrameReader = field(kw_only=True, repr=False)  #: Reader of the clip.
    #: The clip's frames that show the timestamps of the recording.
    times: ClipTimes = field(kw_only=True, repr=False)
    #: The lens that the clip was recorded through.
    lens: Lens = field(default_factory=Lens, repr=False)
    #: The pixel maps that remove the lens distortion, or None.
    undistortion: Undistortion | None = field(default=None, repr=False)
    #: Radial terms k1, k2 of the distortion left in the images, which is removed as well.
    distortion: tuple[float, float] = (0.0, 0.0)
    #: The mask of the recorded pixels that are neither transparent nor masked out [H, W], or None
    #: if all are.
    recorded_mask: np.ndarray | None = field(default=None, repr=False)
    #: Stops by which linear light is brightened and shown in 8 bits; None: it is not shown.
    display_exposure: float | None = None
    notes: tuple[str, ...] = ()  #: Sentences on its masks.

    @classmethod
    def of(cls, view: CalibratedView, reader: FrameReader, times: ClipTimes) -> RecordedView:
        """Return the view of a clip at its size.

        Args:
            view: the calibrated camera, at the clip's size.
            reader: of the clip.
            times: frames that show the timestamps.

        Raises:
            FileNotFoundError: a mask is missing.
            ValueError: a mask cannot be read, or no pixel is left.
        """
        mask, notes = used_in_clip(reader, view.masks, view.name)
        return cls(
            view.camera,
            reader=reader,
            times=times,
            lens=view.lens,
            undistortion=undistortion(view.camera, view.lens),
            recorded_mask=mask,
            notes=tuple(notes),
        )

    @property
    def recorded_size(self) -> tuple[int, int]:
        """Width and height of the clip, px."""
        return self.reader.width, self.reader.height

    def with_camera(self, camera: Camera) -> RecordedView:
        """Return the view with a camera of another size, and its mask."""
        return replace(self, camera=camera, mask=self._valid(camera))

    def at_recorded_size(self) -> RecordedView:
        """Return the view without downscaling."""
        return self.with_camera(self.camera.resized(*self.recorded_size))

    def refined(self, camera: Camera, k1: float, k2: float) -> RecordedView:
        """Return the view with a refined camera, and images from which the radial distortion k1, k2
        is removed.
        """
        if not (k1 or k2):
            return replace(self, camera=camera)
        recorded = self.camera.resized(*self.recorded_size)
        refined = camera.resized(*self.recorded_size), Lens("RADIAL", (k1, k2))
        maps = undistortion(recorded, self.lens, refined)
        return replace(self, undistortion=maps, distortion=(k1, k2)).with_camera(camera)

    def images(
        self, start: int = 0, stop: int | None = None
    ) -> Generator[ImageOrError, None, None]:
        """Yield the processed images of the timestamps start..stop-1, with an error in place of a
        missing image.
        """
        indices = self.times.frame_indices[start:stop]
        images = self._processed(indices[indices >= 0].tolist())
        for timestamp, index in enumerate(indices, start):
            if index >= 0:
                yield next(images)
            else:
                yield ValueError(f"{self.reader.path}: no frame at timestamp {timestamp}.")

    def at_first_timestamp(self, first: View) -> View:
        """Return the view `first` with an image that is interpolated at the first timestamp if the
        clip has a delay; one that cannot be interpolated stays as it is.
        """
        if not (first.has_image and self.times.delay):
            return first
        position = self.times.positions[0]
        index = int(position)
        earlier, later = self._processed([index, index + 1])
        if isinstance(earlier, Exception) or isinstance(later, Exception):
            return first
        return first.at(FrameInterpolation(earlier, later).at(position - index))

    def _processed(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the processed frames of the clip, or errors."""
        for image in self.reader.pick(indices):
            yield self.process(image) if isinstance(image, np.ndarray) else image

    def process(self, image: np.ndarray) -> np.ndarray:
        """Return a recorded image [H, W, 3] as frames have it: undistorted, downscaled and
        colour-corrected.
        """
        if self.undistortion and image.dtype == np.uint8:
            image = self.undistortion(image)
        elif self.undistortion:
            # The cubic filter rings less in encoded values, in which lamps are less far from their
            # surroundings.
            image = np.maximum(decode_light(self.undistortion(encode_light(image))), 0)
        size = self.camera.size
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if self.display_exposure is not None:
            image = display_image(image, self.display_exposure)
        return image

    def _valid(self, camera: Camera) -> np.ndarray | None:
        """Return the mask of the valid pixels of `camera` [H, W] bool, or None if all are valid."""
        valid = self.recorded_mask
        if self.undistortion is not None:
            valid = self.undistortion.mask
            if self.recorded_mask is not None:
                # Other pixels must not contribute; cubic weights can also be negative.
                weights = self.undistortion(self.recorded_mask.astype(np.float32))
                valid = valid & (np.abs(weights - 1) < 1e-3)
        if valid is None or valid.all():
            return None
        return scaled_mask(valid, camera.width, camera.height)

    def metadata(self) -> JsonObject:
        """Return the reading of the clip in JSON types."""
        camera = self.camera
        delays = {"delay": camera.delay, "readout": camera.readout}
        return {
            "name": camera.name,
            "first_frame": int(self.times.frame_indices[0]),
            "recorded_size": list(self.recorded_size),
            "size": [camera.width, camera.height],
            "K": camera.K.tolist(),
            "lens": self.lens.model,
            "distortion": list(self.lens.distortion),
            "undistortion": "none" if self.undistortion is None else "cubic, same intrinsics",
            "valid_share": 1.0 if self.mask is None else float(self.mask.mean()),
            **{name: value for name, value in delays.items() if value},
        }
