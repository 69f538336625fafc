"""Motion masks refined by SAM2, a promptable segmentation network in two ONNX files, run on the CPU
by `onnxruntime`.

SAM2 (Ravi et al., "SAM 2: Segment anything in images and videos", 2024) is exported as an image
encoder, run once per image, and a mask decoder, run once per prompt. Names and shapes are those
that `samexporter` writes:

    encoder   image [1, 3, 1024, 1024] -> high_res_feats_0, high_res_feats_1, image_embed
    decoder   these three, point_coords [1, P, 2], point_labels [1, P],
              mask_input [1, 1, 256, 256], has_mask_input [1]
              -> masks [1, M, 256, 256], logits, and iou_predictions [1, M]

Images are stretched to the encoder's size and normalised by ImageNet's mean and standard deviation.
A point's label is 1 for a point on the object, 2 and 3 for the upper left and lower right corner of
its box. The package contains no weights; docs/masks.md explains how to export them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.onnx_file import OnnxNetwork, imagenet_blob, written_shapes
from morgs_mi.method.mask_refiners.mask_registry import MaskConfig, MaskRefiner
from morgs_mi.method.mask_refiners.opencv_masks import clean_mask
from morgs_mi.platform.checks import require
from morgs_mi.platform.documentation import page

# SAM2's own size, for an encoder that leaves it open.
_SIZE = 1024
# The decoder's optional mask input, which is left empty here, has a quarter of the image's side.
_MASK_SHRINK = 4
_PROMPTS = ("point_coords", "point_labels", "mask_input", "has_mask_input")
_RESULTS = ("masks", "iou_predictions")
_ON_OBJECT = 1
_UPPER_LEFT = 2
_LOWER_RIGHT = 3


class SegmentNetwork:
    """SAM2: called with an image and a mask, it returns the objects that the mask's connected
    components lie on.

    Args:
        encoder: the image encoder's ONNX file.
        decoder: the mask decoder's ONNX file.
        count: largest connected components that become prompts.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: `onnxruntime` is not installed, cannot load a file, or the networks' inputs and
            outputs are not as in the module's docstring.
    """

    def __init__(
        self, encoder: str | Path, decoder: str | Path, count: int = MaskConfig.prompts
    ) -> None:
        self._count = count
        self._encoder = OnnxNetwork(encoder)
        self._decoder = OnnxNetwork(decoder)
        shapes = list(self._encoder.inputs.values())
        require(
            len(shapes) == 1 and len(shapes[0]) == 4 and shapes[0][1] == 3,
            encoder,
            f"expected an image encoder with one input [1, 3, {_SIZE}, {_SIZE}]",
            written_shapes(shapes),
            "give the encoder first, then the decoder",
        )
        height, width = (side or _SIZE for side in shapes[0][2:])
        self._size = (width, height)
        names = {*self._encoder.outputs, *_PROMPTS}
        inputs = self._decoder.inputs
        outputs = self._decoder.outputs
        require(
            set(_PROMPTS[:2]) <= set(inputs) <= names and set(_RESULTS) <= set(outputs),
            decoder,
            f"expected a mask decoder with inputs among {', '.join(sorted(names))} and outputs "
            f"{' and '.join(_RESULTS)}",
            f"{', '.join(inputs)} and {', '.join(outputs)}",
            f"export both networks as described in {page('masks')}",
        )

    def __call__(self, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return the mask of the objects [H, W] bool; it is empty if `mask` is.

        Args:
            image: [H, W, 3], RGB, uint8 or float in [0, 1].
            mask: [H, W] bool.

        Raises:
            ValueError: the decoder cannot run on the encoder's outputs, or its results differ from
                SAM2's.
        """
        objects = np.zeros(mask.shape, bool)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        if count == 1:
            return objects
        # The largest components first; 0 is the background.
        order = 1 + np.argsort(-stats[1:count, cv2.CC_STAT_AREA], kind="stable")
        features = self._encoder.run(
            {next(iter(self._encoder.inputs)): imagenet_blob(image, *self._size)}
        )
        height, width = mask.shape
        input_width, input_height = self._size
        # The decoder adds half a pixel: its pixel centres have whole coordinates.
        scale = np.array((input_width / width, input_height / height), np.float32)
        quarter = input_height // _MASK_SHRINK, input_width // _MASK_SHRINK
        for label in order[: self._count]:
            points, point_labels = prompts(labels == label)
            inputs = {
                **features,
                "point_coords": (points * scale - np.float32(0.5))[None],
                "point_labels": point_labels[None],
                "mask_input": np.zeros((1, 1, *quarter), np.float32),
                "has_mask_input": np.zeros(1, np.float32),
            }
            results = self._decoder.run({name: inputs[name] for name in self._decoder.inputs})
            masks, quality = (results[name] for name in _RESULTS)
            require(
                masks.ndim == 4 and quality.shape == masks.shape[:2] and len(masks) == 1,
                self._decoder.path,
                "expected masks [1, M, H, W] and iou_predictions [1, M]",
                f"{list(masks.shape)} and {list(quality.shape)}",
                "export the decoder again",
            )
            # The mask with the highest predicted IoU.
            logits = masks[0, np.argmax(quality[0])].astype(np.float32)
            objects |= cv2.resize(logits, (width, height), interpolation=cv2.INTER_LINEAR) > 0
        return objects


def prompts(component: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return SAM2's prompt for the object under a connected component: its box and up to three
    points deep inside it.

    Each point is the deepest one at least a quarter of the box's longer side from the others.

    Args:
        component: [H, W] bool, not empty.

    Returns:
        Coordinates [P, 2] in pixels of the image, float32, pixel centres at +0.5, and labels [P],
        float32; first the box's corners, then the points.
    """
    columns, rows = (np.flatnonzero(component.any(axis)) for axis in range(2))
    upper_left = (columns[0], rows[0])
    lower_right = (columns[-1] + 1, rows[-1] + 1)
    distance = max(np.subtract(lower_right, upper_left)) / 4
    depth = cv2.distanceTransform(np.pad(component, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.mgrid[: component.shape[0], : component.shape[1]]
    points = []
    while len(points) < 3 and depth.any():
        row, column = np.unravel_index(np.argmax(depth), depth.shape)
        points.append((column + 0.5, row + 0.5))
        depth = np.where(np.hypot(x - column, y - row) < distance, 0, depth)
    labels = [_UPPER_LEFT, _LOWER_RIGHT] + [_ON_OBJECT] * len(points)
    return np.array([upper_left, lower_right, *points], np.float32), np.array(labels, np.float32)


def sam2(files: str, config: MaskConfig) -> MaskRefiner:
    """Return the mask refiner of two files, ENCODER.onnx,DECODER.onnx."""
    encoder, _, decoder = files.partition(",")
    require(
        encoder and decoder,
        "MotionConfig()",
        "`mask_method` must be sam2:ENCODER.onnx,DECODER.onnx",
        repr(f"sam2:{files}"),
        "name both files",
    )
    network = SegmentNetwork(encoder, decoder, config.prompts)
    return lambda image, mask: mask | network(image, clean_mask(mask))
