"""Change detection: against noise, for slow changes, and for flow in the box around a change."""

import cv2
import numpy as np
import pytest

from morgs_mi.method.change import box_around, change_mask, moving_region
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair

H = 120
W = 160
NOISE = 3.0


def noisy_image(rng, level=0.0, disc=None, noise=NOISE):
    """Return a textured image with camera noise in grey levels, and perhaps a disc that is 40
    levels brighter.
    """
    y, x = np.mgrid[:H, :W]
    image = 120 + 60 * np.sin(x / 7)[..., None] * np.cos(y / 9)[..., None] * np.ones(3) + level
    if disc is not None:
        image[(x - disc[0]) ** 2 + (y - disc[1]) ** 2 < 15**2] += 40
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def changed(reference, image, valid=None):
    return change_mask(reference, image, valid)


def test_change_mask__ignores_noise():
    rng = np.random.default_rng(0)
    assert not any(changed(noisy_image(rng), noisy_image(rng)).any() for _ in range(20))


def test_change_mask__finds_a_disc():
    rng = np.random.default_rng(1)
    mask = changed(noisy_image(rng), noisy_image(rng, disc=(70, 50)))
    y, x = np.mgrid[:H, :W]
    disc = (x - 70) ** 2 + (y - 50) ** 2 < 15**2
    assert mask[disc].all()
    assert not mask[(x - 70) ** 2 + (y - 50) ** 2 > 19**2].any()
    valid = x < 70
    assert not changed(noisy_image(rng), noisy_image(rng, disc=(70, 50)), valid)[~valid].any()


def test_change_mask__covers_a_change_of_light():
    rng = np.random.default_rng(2)
    assert changed(noisy_image(rng), noisy_image(rng, level=12)).mean() > 0.99


def test_change_mask__covers_an_image_without_static_pixels():
    rng = np.random.default_rng(5)
    noise = cv2.resize(
        rng.integers(0, 255, (15, 20, 3), np.uint8), (W, H), interpolation=cv2.INTER_NEAREST
    )
    assert changed(noise, np.roll(noise, 8, axis=1)).mean() > 0.8


def test_change_mask__ignores_noise_that_is_larger_in_some_places():
    """As in a penumbra of a path tracer: 20 grey levels in a part of the image, 3 elsewhere."""
    rng = np.random.default_rng(6)
    noise = np.where((np.mgrid[:H, :W][1] > 100)[..., None], 20, NOISE)
    image, next_image = (
        np.clip(128 + rng.normal(0, 1, (H, W, 3)) * noise, 0, 255).astype(np.uint8)
        for _ in range(2)
    )
    assert changed(image, next_image).mean() < 0.005


@pytest.mark.parametrize("change", [(12, -12, 0), (4, 4, -8)])
def test_change_mask__finds_a_change_of_colour_alone(change):
    rng = np.random.default_rng(7)
    image = noisy_image(rng)
    next_image = noisy_image(rng)
    next_image[40:60, 50:80] = np.clip(next_image[40:60, 50:80] + np.array(change), 0, 255)
    mask = changed(image, next_image)
    assert mask[42:58, 52:78].all()
    assert not mask[:34].any()


@pytest.mark.parametrize(("size", "step"), [(8, (2, 2, 2)), (16, (3, -3, 0))])
def test_change_mask__ignores_blocks_of_compressed_video(monkeypatch, size, step):
    rng = np.random.default_rng(9)
    image = noisy_image(rng, noise=1)
    next_image = noisy_image(rng, noise=1)
    flips = rng.random((-(-H // size), -(-W // size))) < 0.1
    next_image += (
        (np.kron(flips, np.ones((size, size)))[:H, :W, None] * step).astype(np.int8).view(np.uint8)
    )
    assert not changed(image, next_image).any()
    monkeypatch.setattr("morgs_mi.method.change.MIN_PEAK", 0)
    assert changed(image, next_image).mean() > 0.02


def test_change_mask__has_the_faint_parts_of_a_clear_change():
    """A shadow that fades from 8 grey levels to none, and another of 2."""
    image = np.full((H, W, 3), 120.0)
    next_image = image.copy()
    next_image[30:50, 40:120] -= np.linspace(8, 0, 80)[:, None]
    next_image[80:100, 40:120] -= 2
    mask = changed(*(np.rint(v).astype(np.uint8) for v in (image, next_image)))
    assert mask[32:48, 42:98].all()
    assert not mask[70:].any()


def test_moving_region__includes_what_changes_enclose():
    """An outline with a gap of 3 px, and an arc that encloses nothing."""
    change = np.zeros((H, W), np.uint8)
    cv2.rectangle(change, (20, 20), (60, 50), 1, 2)
    change[30:33, 15:25] = 0
    cv2.line(change, (100, 20), (100, 90), 1, 2)
    region = moving_region(change.astype(bool))
    assert region[22:49, 22:59].all()
    assert not region[:, 105:].any()
    assert not region[60:, :95].any()


def test_change_mask__detects_slow_changes_once_they_add_up():
    """A quarter of a grey level per frame is never detected between two frames, but against the
    reference.
    """
    rng = np.random.default_rng(3)
    reference = noisy_image(rng)
    last = noisy_image(rng)
    waited = []
    for frame in range(1, 60):
        image = noisy_image(rng, level=0.25 * frame)
        assert not changed(last, image).mean() > 0.01
        change = changed(reference, image)
        waited.append(change.mean())
        reference = np.where(change[..., None], image, reference)
        last = image
    assert max(waited[:4]) < 0.01
    # 15 grey levels in all. Five standard deviations are 2.5, and the noise lets some pixels pass
    # earlier.
    assert 5 < sum(waited) < 20  # of 59 frames
    # The reference is never far behind.
    assert abs(float(np.mean(reference.astype(float) - last))) < 8


def test_box_around__adds_margins():
    change = np.zeros((H, W), bool)
    assert box_around(change) is None
    change[50:60, 80:180] = True
    assert box_around(change) == (slice(26, 84), slice(40, 160))


def draw_moving_patch(image, next_image, shift, rng):
    patch = cv2.resize(
        rng.integers(0, 255, (8, 8, 3), np.uint8), (32, 32), interpolation=cv2.INTER_CUBIC
    )
    image[34:66, 54:86] = patch
    next_image[34:66, 54 + shift : 86 + shift] = patch


def test_observe_key_views__what_has_not_changed_has_not_moved():
    """Flow bleeds over the edges of a patch that moves by 6 px before a plain wall."""
    rng = np.random.default_rng(9)
    image, next_image = np.full((2, H, W, 3), 120, np.uint8)
    draw_moving_patch(image, next_image, 6, rng)
    region = moving_region(changed(image, next_image))
    observed = {
        name: observe_key_views({0: FramePair(next_image, image, region=r)})[0]
        for name, r in (("plain", None), ("with region", region))
    }
    assert np.linalg.norm(observed["plain"].motion[~region], axis=-1).max() > 1
    observation = observed["with region"]
    assert not observation.motion[~region].any()
    assert not observation.forward_flow[~region].any()
    assert observation.reliable[~region].all()
    assert np.median(observation.motion[40:60, 66:86], axis=(0, 1)) == pytest.approx(
        (6, 0), abs=0.2
    )
