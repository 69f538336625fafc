"""SAM2: inputs of its two networks, and the mask from their outputs."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.evaluate.metrics import iou
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from morgs_mi.studio.networks.sam2 import SegmentNetwork, prompts
from tests.scenes.tiny_network import export as export_flow
from tests.studio.networks.tiny_segmenter import export_decoder, export_encoder

pytest.importorskip("onnxruntime")

RED = (0.9, 0.3, 0.2)
BLUE = (0.1, 0.3, 0.9)
BACK = (0.4, 0.5, 0.45)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sam2")
    return export_encoder(folder / "encoder.onnx"), export_decoder(folder / "decoder.onnx")


@pytest.fixture(scope="module")
def network(files):
    return SegmentNetwork(*files)


def discs(height, width, *centres, radius=20, color=RED):
    """Return an image with discs on a grey background, and the mask of each."""
    y, x = np.mgrid[:height, :width] + 0.5
    masks = [np.hypot(x - u, y - v) < radius for u, v in centres]
    image = np.broadcast_to(np.array(BACK), (height, width, 3)).copy()
    image[np.any(masks, axis=0)] = color
    return image, masks


@pytest.mark.parametrize("size", [(120, 160), (160, 120), (480, 640), (1100, 1400)])
def test_segment_network__segments_an_object_to_the_pixel_at_any_size(network, size):
    height, width = size
    image, (disc,) = discs(height, width, (0.4 * width, 0.55 * height), radius=0.2 * height)
    # A cell of the network's mask is width / 256 pixels wide; half a cell may be wrong around the
    # disc.
    off = np.pi * 0.4 * height * (max(size) / 256) / 2
    assert iou(network(image, disc), disc) > 1 - off / disc.sum()


def test_segment_network__returns_an_empty_mask_for_an_empty_mask(network):
    image, _ = discs(60, 80, (30, 30))
    assert not network(image, np.zeros((60, 80), bool)).any()


def test_segment_network__prompts_with_each_connected_component(network):
    image, (one, other, still) = discs(240, 320, (60, 60), (220, 60), (140, 180))
    result = network(image, one | other)
    assert iou(result, one | other) > 0.9
    assert not result[still].any()


def test_segment_network__passes_colours_as_rgb(network):
    image, (disc,) = discs(120, 160, (80, 60), color=BLUE)
    assert not network(image, disc).any()


def test_segment_network__normalises_as_imagenet(network):
    # The tiny decoder's limit is R - B = 0.2 of the input colours: a ramp of R crosses it at R =
    # 0.5.
    image = np.full((64, 256, 3), 0.3)
    image[..., 0] = (np.arange(256) + 0.5) / 256
    mask = np.ones((64, 256), bool)
    mask[:, :100] = False
    row = network(image, mask)[32]
    # R >= 0.5 within reach of the points; half a cell on either side.
    assert np.flatnonzero(row)[0] == pytest.approx(128, abs=1)


def test_prompts__points_lie_deep_and_apart_inside_the_box():
    component = np.zeros((60, 80), bool)
    component[20:30, 10:70] = True
    component[30:50, 10:20] = True
    coordinates, labels = prompts(component)
    np.testing.assert_array_equal(labels, [2, 3, 1, 1, 1])
    np.testing.assert_array_equal(coordinates[:2], [[10, 20], [70, 50]])
    points = coordinates[2:]
    columns, rows = np.floor(points).astype(int).T
    assert component[rows, columns].all()
    distances = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(3, 1)]
    assert distances.min() >= 60 / 4
    # Only the corner of the L is deeper than 5 pixels.
    for column, row in zip(columns, rows, strict=True):
        assert component[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4].all()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1)])
def test_prompts__of_the_smallest_components(size):
    coordinates, labels = prompts(np.ones(size, bool))
    assert len(coordinates) == len(labels) >= 3
    np.testing.assert_array_equal(coordinates[:2], [[0, 0], size[::-1]])


def test_motion_mask__is_the_union_of_flow_mask_and_sam2_objects(files):
    image, (disc,) = discs(240, 320, (160, 120), radius=40)
    motion = np.zeros((240, 320, 2))
    motion[disc] = 3
    motion[110:125, 150:170] = 0  # a hole in the moving object
    motion[10:14, 10:40] = 3  # the network segments nothing here
    method = f"sam2:{files[0]},{files[1]}"
    mask = motion_mask(image, motion, method=method)
    assert mask[motion[..., 0] > 0].all()
    assert mask[disc].all()
    assert MASK_REFINERS.make(method) is MASK_REFINERS.make(method)


def test_segment_network__accepts_an_encoder_of_open_size(tmp_path, files):
    image, (disc,) = discs(120, 160, (80, 60))
    result = SegmentNetwork(export_encoder(tmp_path / "open.onnx", open_size=True), files[1])(
        image, disc
    )
    assert iou(result, disc) > 0.9


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        (
            lambda encoder, decoder, _: (decoder, encoder),
            "decoder.onnx: expected an image encoder .* give the encoder first",
        ),
        (
            lambda encoder, _, other: (encoder, export_flow(other)),
            "other.onnx: expected a mask decoder .* got image1, image2 and flow_low, flow_up",
        ),
        (
            lambda encoder, _, other: (encoder, export_decoder(other, extra="orig_im_size")),
            "other.onnx: expected a mask decoder with inputs among .*orig_im_size and masks",
        ),
    ],
    ids=["swapped", "flow", "extra"],
)
def test_mask_refiner__rejects_files_that_are_not_sam2(tmp_path, files, pair, message):
    encoder, decoder = pair(*files, tmp_path / "other.onnx")
    with pytest.raises(ValueError, match=message):
        MASK_REFINERS.make(f"sam2:{encoder},{decoder}")


def test_segment_network__rejects_masks_that_are_not_finite(tmp_path, files):
    image, (disc,) = discs(60, 80, (40, 30))
    with pytest.raises(ValueError, match=r"decoder\.onnx, output masks: expected finite"):
        SegmentNetwork(files[0], export_decoder(tmp_path / "decoder.onnx", scale=float("inf")))(
            image, disc
        )


def test_prompts__limits_points_and_their_spacing():
    component = np.ones((10, 100), bool)
    assert len(prompts(component, count=2)[0]) == 2 + 2
    points = prompts(component, count=9, spacing=0.4)[0][2:]
    distances = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(len(points), 1)]
    assert len(points) == 3
    assert distances.min() >= 0.4 * 100


def test_mask_config__limits_prompts_to_the_largest(files):
    image, (small, large) = discs(240, 320, (60, 60), (220, 120))
    hole = np.zeros((240, 320), bool)
    hole[55:65, 55:65] = hole[115:122, 215:222] = True
    mask = (small | large) & ~hole
    config = MaskConfig(prompts=1)
    for model, filled in (
        (MASK_REFINERS.make(f"sam2:{files[0]},{files[1]}", config), large),
        (SegmentNetwork(*files), hole),
    ):
        assert model(image, mask)[hole & filled].mean() > 0.9
    assert not MASK_REFINERS.make(f"sam2:{files[0]},{files[1]}", config)(image, mask)[
        hole & small
    ].any()
