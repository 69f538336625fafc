"""The clip of one camera, converted to the frames of a pinhole camera on the common timeline."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.capture.interpolation import image_between
from morgs_mi.capture.lens import Lens, Undistortion, undistortion
from morgs_mi.capture.masks import scaled_mask, used_in_clip
from morgs_mi.capture.timeline import ClipTimes
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_light, display_image, encode_light
from morgs_mi.io.clip_readers import FrameReader
from morgs_mi.io.images import ImageOrError


@dataclass(frozen=True)
class CameraSource:
    """One camera's clip and the processing of its images."""

    reader: FrameReader  #: Reader of the clip.
    lens: Lens  #: The lens that the clip was recorded through.
    undistortion: Undistortion | None  #: The pixel maps that remove the lens distortion, or None.
    times: ClipTimes  #: The clip's frames that show the timestamps of the recording.
    #: The mask of the recorded pixels that are neither transparent nor masked out [H, W], or None
    #: if all are.
    recorded_mask: np.ndarray | None = None
    #: Stops by which linear light is brightened and shown in 8 bits; None: it is not shown.
    display_exposure: float | None = None
    notes: tuple[str, ...] = ()  #: Sentences on its masks.

    @classmethod
    def of(
        cls,
        reader: FrameReader,
        lens: Lens,
        camera: Camera,
        masks: Sequence[Path],
        times: ClipTimes,
    ) -> CameraSource:
        """Return the source of a clip.

        Args:
            reader: of the clip.
            lens: the lens that it was recorded through.
            camera: the pinhole camera at the clip's size.
            masks: files with masks of the pixels that are used.
            times: frames that show the timestamps.

        Raises:
            FileNotFoundError: a mask is missing.
            ValueError: a mask cannot be read, or no pixel is left.
        """
        mask, notes = used_in_clip(reader, masks, camera.name)
        return cls(reader, lens, undistortion(camera, lens), times, mask, notes=tuple(notes))

    def at_timestamps(self) -> CameraSource:
        """Return the source without a delay: its images are interpolated instead."""
        positions = self.times.frame_indices - self.times.delay
        indices = np.floor(positions).astype(int)
        return replace(self, times=ClipTimes(indices, positions - indices, 0.0, self.times.rate))

    def images(
        self, camera: Camera, start: int, stop: int | None
    ) -> Generator[ImageOrError, None, None]:
        """Yield the processed images of the timestamps start..stop-1, with an error in place of a
        missing image.
        """
        indices = self.times.frame_indices[start:stop]
        if self.times.shares is None:
            frames = self.reader.pick(indices[indices >= 0].tolist())
            for timestamp, index in enumerate(indices, start):
                if index < 0:
                    yield ValueError(f"{self.reader.path}: no frame at timestamp {timestamp}.")
                    continue
                image = next(frames)
                yield self.process(image, camera) if isinstance(image, np.ndarray) else image
            return
        frames = self.reader.pick(np.stack([indices, indices + 1], axis=1).ravel().tolist())
        for share in self.times.shares[start:stop]:
            first = next(frames)
            second = next(frames)
            if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
                yield image_between(
                    self.process(first, camera), self.process(second, camera), share
                )
            else:
                yield second if isinstance(first, np.ndarray) else first

    def process(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """Return a recorded image undistorted, downscaled to the size of `camera` and
        colour-corrected.
        """
        if self.undistortion and image.dtype == np.uint8:
            image = self.undistortion(image)
        elif self.undistortion:
            # The cubic filter rings less in encoded values, in which lamps are less far from their
            # surroundings.
            image = np.maximum(decode_light(self.undistortion(encode_light(image))), 0)
        size = camera.size
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if self.display_exposure is not None:
            image = display_image(image, self.display_exposure)
        return image

    def mask(self, camera: Camera) -> np.ndarray | None:
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
