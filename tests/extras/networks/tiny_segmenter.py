"""Two networks with SAM2's signature, as ONNX files: they segment pixels redder than blue around
the prompts.
"""

import numpy as np

from tests.scenes.tiny_network import write

SIZE = 1024
CELL = 4
# Radius around a point on the object within which pixels are segmented, in pixels of the network's
# image.
REACH = 300.0
MEAN = np.array([0.485, 0.456, 0.406])
DEVIATION = np.array([0.229, 0.224, 0.225])


def export_encoder(path, open_size=False):
    """Write an encoder with the image itself as features, at a quarter, an eighth and a sixteenth
    of its side.
    """
    sides = ["h, w", "?, ?", "?, ?", "?, ?"]
    if not open_size:
        sides = [f"{SIZE // k}, {SIZE // k}" for k in (1, 4, 8, 16)]
    image, quarter, eighth, sixteenth = (f"float[1, 3, {side}]" for side in sides)
    graph = f"""encoder ({image} image) => (
      {quarter} high_res_feats_0, {eighth} high_res_feats_1, {sixteenth} image_embed
    ) {{
      high_res_feats_0 = AveragePool <kernel_shape = [4, 4], strides = [4, 4]> (image)
      high_res_feats_1 = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (image)
      image_embed = AveragePool <kernel_shape = [16, 16], strides = [16, 16]> (image)
    }}"""
    return write(path, graph)


def export_decoder(path, extra="", scale=1.0):
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
    graph = f"""decoder (
      float[1, 3, 64, 64] image_embed, float[1, 3, {cells}, {cells}] high_res_feats_0,
      float[1, 3, 128, 128] high_res_feats_1, float[1, points, 2] point_coords,
      float[1, points] point_labels, float[1, 1, {cells}, {cells}] mask_input,
      float[1] has_mask_input{extra and f", float[1] {extra}"}
    ) => (float[1, 3, {cells}, {cells}] masks, float[1, 3] iou_predictions) {{
      redness = Conv(high_res_feats_0, color, bias)
      upper_left = Slice(point_coords, zero, one, axis1)
      lower_right = Slice(point_coords, one, two, axis1)
      left = Slice(upper_left, zero, one, axis2)
      upper = Slice(upper_left, one, two, axis2)
      right = Slice(lower_right, zero, one, axis2)
      lower = Slice(lower_right, one, two, axis2)
      inside_left = Sub(x, left)
      inside_right = Sub(right, x)
      inside_upper = Sub(y, upper)
      inside_lower = Sub(lower, y)
      # Squared distance to the nearest point of label 1: [1, P, cells, cells].
      points_x = Slice(point_coords, zero, one, axis2)
      points_y = Slice(point_coords, one, two, axis2)
      column_x = Reshape(points_x, column)
      column_y = Reshape(points_y, column)
      dx = Sub(x, column_x)
      dy = Sub(y, column_y)
      dx2 = Mul(dx, dx)
      dy2 = Mul(dy, dy)
      label_difference = Sub(point_labels, on_object)
      label_distance = Abs(label_difference)
      labels_apart = Mul(label_distance, far)
      column_apart = Reshape(labels_apart, column)
      distances = Sum(dx2, dy2, column_apart)
      distance = ReduceMin <axes = [1], keepdims = 1> (distances)
      near = Sub(reach, distance)
      # 0 if labels and mask inputs are as expected, and otherwise far below.
      corner_labels = Slice(point_labels, zero, two, axis1)
      corners_off = Sub(corner_labels, corners)
      corners_wrong = Abs(corners_off)
      wrong_labels = ReduceSum <keepdims = 0> (corners_wrong)
      mask_given = ReduceMax <keepdims = 0> (mask_input)
      mask_flag = ReduceSum <keepdims = 0> (has_mask_input)
      wrong = Sum(wrong_labels, mask_given, mask_flag)
      penalty = Mul(wrong, far)
      sharp_redness = Mul(redness, far)
      bare = Min(sharp_redness, inside_left, inside_right, inside_upper, inside_lower, near)
      right_mask = Sub(bare, penalty)
      inverse = Neg(right_mask)
      all = Concat <axis = 1> (flat, right_mask, inverse)
      masks = Mul(all, scale)
      iou_predictions = Identity(quality)
    }}"""
    return write(
        path,
        graph,
        color=color,
        bias=np.array([MEAN[0] - MEAN[2] - 0.2], np.float32),
        x=x.copy(),
        y=y.copy(),
        zero=np.array([0]),
        one=np.array([1]),
        two=np.array([2]),
        axis1=np.array([1]),
        axis2=np.array([2]),
        column=np.array([1, -1, 1, 1]),
        on_object=np.float32(1),
        far=np.float32(1e9),
        reach=np.float32(REACH**2),
        corners=np.array([[2, 3]], np.float32),
        scale=np.float32(scale),
        quality=np.array([[0.3, 0.9, 0.5]], np.float32),
        flat=np.ones((1, 1, cells, cells), np.float32),
    )
