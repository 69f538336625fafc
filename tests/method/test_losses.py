"""The losses against float64 reference implementations, and their derivatives against central
differences.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.core.arrays import from_numpy
from morgs_mi.method.objective import flow_loss, mask_loss, recon_loss
from morgs_mi.method.ssim import Target
from morgs_mi.render.region import Region
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.reference import ssim_by_windows
from tests.scenes.derivatives import difference, gradient
from tests.scenes.kernels import compiled_by

SIZE = (19, 23, 3)


@pytest.fixture(scope="module")
def images():
    """Return a noisy image and its target."""
    rng = np.random.default_rng(0)
    target = rng.uniform(0, 1, SIZE).astype(np.float32)
    return (target + rng.normal(0, 0.2, SIZE)).astype(np.float32), target


def item(value):
    return np.asarray(value).item()


def slow_recon(image, target, weight):
    """Eq. 2 in float64, window by window, zeros outside."""
    image = image.astype(np.float64)
    x, y = (np.pad(v, ((5, 5), (5, 5), (0, 0))) for v in (image, target))
    similarity = np.mean([ssim_by_windows(x[..., c], y[..., c]) for c in range(3)])
    return (1 - weight) * np.abs(image - target).mean() + weight * (1 - similarity)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_recon_loss__agrees_with_the_reference(images, weight):
    image, target = images
    loss = item(recon_loss(mi.TensorXf(image), Target(target), weight))
    assert loss == pytest.approx(slow_recon(image, target, weight), rel=tol.LOSS_REL)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_recon_loss__gradient_agrees_with_central_differences(images, weight):
    image, target = images
    x = mi.TensorXf(image)
    dr.enable_grad(x)
    dr.backward(recon_loss(x, Target(target), weight))
    grad = gradient(x)
    rng = np.random.default_rng(1)
    for _ in range(3):
        # Steps that do not cross the kink of |I - I*|.
        v = rng.normal(size=SIZE) * (np.abs(image - target) > 2e-3)
        slope = difference(lambda image: slow_recon(image, target, weight), image, v, 1e-4)
        assert np.vdot(grad, v) == pytest.approx(slope, rel=tol.LOSS_GRADIENT_REL, abs=1e-6)


@pytest.mark.parametrize("share", [1, 0.5])
def test_target__has_the_errors_of_its_valid_pixels_and_of_a_constant_image(images, share):
    image, pixels = images
    mask = np.random.default_rng(0).random(SIZE[:2]) <= share
    target = Target(pixels, mask)
    recon_loss(mi.TensorXf(image), target, 0.2)
    assert item(target.mse) == pytest.approx(np.square(image - pixels)[mask].mean(), rel=1e-5)
    assert target.constant_error() == pytest.approx(pixels[mask].var(), rel=1e-4)
    drawn = np.zeros((3, 6), bool)
    drawn[1, 2:] = True
    region = Region.of(np.kron(drawn, np.ones((8, 4), bool))[: SIZE[0], : SIZE[1]])
    recon_loss(mi.TensorXf(region.crop(image)), target, 0.2, region)
    valid = mask & region.mask
    assert item(target.mse) == pytest.approx(np.square(image - pixels)[valid].mean(), rel=1e-5)
    assert target.constant_error(region) == pytest.approx(pixels[valid].var(), rel=1e-4)


def test_flow_loss__is_the_mean_endpoint_error():
    rng = np.random.default_rng(3)
    motion, observed = rng.normal(size=(2, 8, 9, 2)).astype(np.float32)
    reliable = (rng.uniform(size=(8, 9)) > 0.3).astype(np.float32)
    x = mi.TensorXf(motion)
    dr.enable_grad(x)
    loss = flow_loss(x, mi.TensorXf(observed), mi.TensorXf(reliable), 1 / reliable.size)
    error = np.linalg.norm(motion - observed, axis=-1)
    assert item(loss) == pytest.approx((error * reliable).mean(), rel=1e-3)
    dr.backward(loss)
    expected = (motion - observed) / error[..., None] * reliable[..., None] / reliable.size
    assert_close(dr.grad(x), expected, atol=1e-2 / reliable.size)


def test_flow_loss__has_a_finite_gradient_where_both_agree():
    x = from_numpy(mi.TensorXf, np.ones((4, 4, 2), np.float32))
    dr.enable_grad(x)
    dr.backward(flow_loss(x, dr.ones(mi.TensorXf, (4, 4, 2)), dr.ones(mi.TensorXf, (4, 4)), 1 / 16))
    assert gradient(x).max() == 0


def test_mask_loss__is_the_mean_absolute_difference():
    rng = np.random.default_rng(4)
    confidence = rng.uniform(size=(6, 5, 1)).astype(np.float32)
    mask = rng.uniform(size=(6, 5)) > 0.5
    loss = item(
        mask_loss(mi.TensorXf(confidence), mi.TensorXf(mask.astype(np.float32)), 1 / mask.size)
    )
    assert loss == pytest.approx(np.abs(confidence[..., 0] - mask).mean(), rel=1e-5)


@pytest.mark.parametrize(("width", "block"), [(64, None), (77, None), (77, 4), (101, 12), (64, 16)])
@pytest.mark.parametrize("masked", [False, True])
def test_recon_loss__gradient_on_a_region_agrees_with_the_full_view(width, block, masked):
    """If only a region has changed, its derivative is the full view's, and the value changes by the
    same amount.
    """
    height = 150
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:height, :width]
    drawn = (x - 30) ** 2 + (y - 100) ** 2 < 15**2
    drawn[0, 0] = drawn[-1, -1] = drawn[70, 5] = True
    region = Region.of(drawn, RenderConfig(block_width=block))
    truth = np.float32(rng.uniform(size=(height, width, 3)))
    changed = (
        region.crop(truth)
        + np.float32(rng.normal(size=region.shape(3)))
        * region.crop(np.ones((region.height, region.width), bool))[..., None]
        * 0.1
    )
    pixels = region.uncropped(changed)[:height, :width]
    new_image = np.where(region.mask[..., None], pixels, truth)
    target = Target(truth, rng.uniform(size=drawn.shape) < 0.8 if masked else None)

    def evaluate(image, where):
        tensor = mi.TensorXf(np.float32(image))
        dr.enable_grad(tensor)
        loss = recon_loss(tensor, target, 0.3, where)
        dr.backward(loss)
        return item(loss), gradient(tensor)

    region_loss, region_grad = evaluate(changed, region)
    expected, expected_grad = evaluate(new_image, None)
    scale = np.abs(expected_grad).max()
    assert_close(region_grad, region.crop(expected_grad), atol=tol.SUM_ORDER_REL * scale)
    old, _ = evaluate(truth, None)
    old_on_region, _ = evaluate(region.crop(truth), region)
    assert region_loss - old_on_region == pytest.approx(expected - old, abs=tol.LOSS_REL * expected)
    again, again_grad = evaluate(changed, region)  # the surroundings are unchanged
    assert (again, np.abs(again_grad - region_grad).max()) == (region_loss, 0)


def test_recon_loss__compiles_its_kernels_once_for_all_sizes():
    rng = np.random.default_rng(0)

    def step(height, width):
        # An array of NumPy may not be aligned, which needs a kernel of its own.
        image = from_numpy(mi.TensorXf, rng.uniform(size=(height, width, 3))) * dr.opaque(
            mi.Float, 1
        )
        dr.eval(image)
        dr.enable_grad(image)
        dr.backward(recon_loss(image, Target(np.asarray(image)), 0.2))
        dr.eval(dr.grad(image))
        dr.sync_thread()

    step(40, 48)
    assert not compiled_by(lambda: step(90, 72))
