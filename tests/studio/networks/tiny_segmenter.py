"""Two networks with SAM2's signature, as ONNX files: they segment pixels redder than blue around
the prompts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import helper

from tests.scenes.tiny_network import write

SIZE = 1024
CELL = 4
# Radius around a point on the object within which pixels are segmented, in pixels of the network's
# image.
REACH = 300.0
# Index of the decoder's mask with the highest predicted IoU, of three.
BEST = 1
MEAN = np.array([0.485, 0.456, 0.406])
DEVIATION = np.array([0.229, 0.224, 0.225])


def export_encoder(path: Path, open_size: bool = False) -> Path:
    """Write an encoder with the image itself as features, at a quarter, an eighth and a sixteenth
    of its side.
    """
    names = {"high_res_feats_0": 4, "high_res_feats_1": 8, "image_embed": 16}
    nodes = [
        helper.make_node("AveragePool", ["image"], [name], kernel_shape=[k, k], strides=[k, k])
        for name, k in names.items()
    ]
    sides = ("h", "w") if open_size else (SIZE, SIZE)
    outputs = {
        name: (1, 3, None, None) if open_size else (1, 3, SIZE // k, SIZE // k)
        for name, k in names.items()
    }
    return write(path, nodes, {"image": (1, 3, *sides)}, outputs, {})


def export_decoder(path: Path, extra: str = "", scale: float = 1.0) -> Path:
    """Write a decoder that returns three masks, of which the second is the correct one.

    It contains the pixels that are redder than blue by more than 0.2, inside the box (the first two
    points), and within `REACH` of a point of label 1. It is empty if there is a mask on input, or
    labels other than 2 and 3 for the box.
    """
    cells = SIZE // CELL
    centres = (np.arange(cells, dtype=np.float32) + 0.5) * CELL - 0.5
    x = np.broadcast_to(centres, (1, 1, cells, cells))
    y = np.broadcast_to(centres[:, None], (1, 1, cells, cells))
    # Of normalised colours, R - B - 0.2 of the colours themselves.
    color = np.array([DEVIATION[0], 0, -DEVIATION[2]], np.float32)[None, :, None, None]
    constants = {
        "color": color,
        "bias": np.array([MEAN[0] - MEAN[2] - 0.2], np.float32),
        "x": x.copy(),
        "y": y.copy(),
        "zero": np.array([0]),
        "one": np.array([1]),
        "two": np.array([2]),
        "last": np.array([2**31]),
        "axis1": np.array([1]),
        "axis2": np.array([2]),
        "column": np.array([1, -1, 1, 1]),
        "on_object": np.float32(1),
        "far": np.float32(1e9),
        "reach": np.float32(REACH**2),
        "corners": np.array([[2, 3]], np.float32),
        "scale": np.float32(scale),
        "quality": np.array([[0.3, 0.9, 0.5]], np.float32),
        "flat": np.zeros((1, 1, cells, cells), np.float32) + 1,
    }

    def node(kind: str, inputs: str, output: str, **settings: int) -> object:
        return helper.make_node(kind, inputs.split(), [output], **settings)

    nodes = [
        node("Conv", "high_res_feats_0 color bias", "redness"),
        node("Slice", "point_coords zero one axis1", "upper_left"),
        node("Slice", "point_coords one two axis1", "lower_right"),
        node("Slice", "upper_left zero one axis2", "left"),
        node("Slice", "upper_left one two axis2", "upper"),
        node("Slice", "lower_right zero one axis2", "right"),
        node("Slice", "lower_right one two axis2", "lower"),
        node("Sub", "x left", "inside_left"),
        node("Sub", "right x", "inside_right"),
        node("Sub", "y upper", "inside_upper"),
        node("Sub", "lower y", "inside_lower"),
        # Squared distance to the nearest point of label 1: [1, P, cells, cells].
        node("Slice", "point_coords zero one axis2", "points_x"),
        node("Slice", "point_coords one two axis2", "points_y"),
        node("Reshape", "points_x column", "column_x"),
        node("Reshape", "points_y column", "column_y"),
        node("Sub", "x column_x", "dx"),
        node("Sub", "y column_y", "dy"),
        node("Mul", "dx dx", "dx2"),
        node("Mul", "dy dy", "dy2"),
        node("Sub", "point_labels on_object", "label_difference"),
        node("Abs", "label_difference", "label_distance"),
        node("Mul", "label_distance far", "labels_apart"),
        node("Reshape", "labels_apart column", "column_apart"),
        node("Sum", "dx2 dy2 column_apart", "distances"),
        node("ReduceMin", "distances", "distance", axes=[1], keepdims=1),
        node("Sub", "reach distance", "near"),
        # 0 if labels and mask inputs are as expected, and otherwise far below.
        node("Slice", "point_labels zero two axis1", "corner_labels"),
        node("Sub", "corner_labels corners", "corners_off"),
        node("Abs", "corners_off", "corners_wrong"),
        node("ReduceSum", "corners_wrong", "wrong_labels", keepdims=0),
        node("ReduceMax", "mask_input", "mask_given", keepdims=0),
        node("ReduceSum", "has_mask_input", "mask_flag", keepdims=0),
        node("Sum", "wrong_labels mask_given mask_flag", "wrong"),
        node("Mul", "wrong far", "penalty"),
        node("Mul", "redness far", "sharp_redness"),
        node(
            "Min", "sharp_redness inside_left inside_right inside_upper inside_lower near", "bare"
        ),
        node("Sub", "bare penalty", "right_mask"),
        node("Neg", "right_mask", "inverse"),
        node("Concat", "flat right_mask inverse", "all", axis=1),
        node("Mul", "all scale", "masks"),
        node("Identity", "quality", "iou_predictions"),
    ]
    inputs = {
        "image_embed": (1, 3, 64, 64),
        "high_res_feats_0": (1, 3, cells, cells),
        "high_res_feats_1": (1, 3, 128, 128),
        "point_coords": (1, "points", 2),
        "point_labels": (1, "points"),
        "mask_input": (1, 1, cells, cells),
        "has_mask_input": (1,),
    }
    if extra:
        inputs[extra] = (1,)
    return write(
        path, nodes, inputs, {"masks": (1, 3, cells, cells), "iou_predictions": (1, 3)}, constants
    )
