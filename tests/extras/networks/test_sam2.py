"""SAM2: inputs of its two networks, and the mask from their outputs."""

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import pdist

from morgs_mi.evaluate.metrics import iou
from morgs_mi.extras.networks.sam2 import SegmentNetwork, prompts
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from tests.extras.networks.tiny_segmenter import export_decoder, export_encoder
from tests.scenes.tiny_network import export as export_flow

pytest.importorskip("onnxruntime")

RED = (0.9, 0.3, 0.2)
BACK = (0.4, 0.5, 0.45)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sam2")
    return export_encoder(folder / "encoder.onnx"), export_decoder(folder / "decoder.onnx")


@pytest.fixture(scope="module")
def network(files):
    return SegmentNetwork(*files)


def discs(height, width, *centres, radius=20):
    """Return an image with red discs on a grey background, and the mask of each."""
    y, x = np.mgrid[:height, :width] + 0.5
    masks = [np.hypot(x - u, y - v) < radius for u, v in centres]
    return np.where(np.any(masks, axis=0)[..., None], RED, BACK), masks


@pytest.mark.parametrize("size", [(160, 120), (1100, 1400)])
def test_segment_network__segments_an_object_to_the_pixel_at_any_size(network, size):
    height, width = size
    image, (disc,) = discs(height, width, (0.4 * width, 0.55 * height), radius=0.2 * height)
    # A cell of the network's mask is width / 256 pixels wide; half a cell may be wrong around the
    # disc.
    off = np.pi * 0.4 * height * (max(size) / 256) / 2
    assert iou(network(image, disc), disc) > 1 - off / disc.sum()
    assert not network(image[..., ::-1], disc).any(), "colours are RGB"
    assert not network(image, np.zeros(size, bool)).any()


def test_segment_network__prompts_with_each_connected_component(network):
    image, (one, other, still) = discs(240, 320, (60, 60), (220, 60), (140, 180))
    result = network(image, one | other)
    assert iou(result, one | other) > 0.9
    assert not result[still].any()


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
    assert labels.tolist() == [2, 3, 1, 1, 1]
    assert coordinates[:2].tolist() == [[10, 20], [70, 50]]
    columns, rows = np.floor(coordinates[2:]).astype(int).T
    assert pdist(coordinates[2:]).min() >= 60 / 4
    # Only the corner of the L is deeper than 5 pixels.
    assert cv2.erode(np.uint8(component), np.ones((7, 7)))[rows, columns].all()


def test_motion_mask__is_the_union_of_flow_mask_and_sam2_objects(files):
    image, (disc,) = discs(240, 320, (160, 120), radius=40)
    motion = np.zeros((240, 320, 2))
    motion[disc] = 3
    motion[110:125, 150:170] = 0  # a hole in the moving object
    motion[10:14, 10:40] = 3  # the network segments nothing here
    method = f"sam2:{files[0]},{files[1]}"
    reliable = np.ones((240, 320), bool)
    mask = motion_mask(image, motion, reliable, method, MaskConfig())
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


def test_mask_config__limits_prompts_to_the_largest(files):
    image, (small, large) = discs(240, 320, (60, 60), (220, 120))
    hole = np.zeros((240, 320), bool)
    hole[55:65, 55:65] = hole[115:122, 215:222] = True
    both, one = (
        MASK_REFINERS.make(f"sam2:{files[0]},{files[1]}", config)(image, (small | large) & ~hole)
        for config in (None, MaskConfig(prompts=1))
    )
    assert both[hole].mean() > 0.9
    assert one[hole & large].mean() > 0.9
    assert not one[hole & small].any()
