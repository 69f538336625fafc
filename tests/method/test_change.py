"""Change is told from noise, slow change adds up, and flow is asked for around it alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from morgs_mi.method.change import around, changed, renewed
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.registry import FramePair

H, W, NOISE_TOLERANCE = 120, 160, 3.0


def picture(rng, level=0.0, disc=None):
    """Return a textured picture with camera noise of 3 grey levels, and perhaps a disc that is 40 levels brighter."""
    y, x = np.mgrid[:H, :W]
    image = 120 + 60 * np.sin(x / 7)[..., None] * np.cos(y / 9)[..., None] * np.ones(3) + level
    if disc is not None:
        image[(x - disc[0]) ** 2 + (y - disc[1]) ** 2 < 15**2] += 40
    return np.clip(image + rng.normal(0, NOISE_TOLERANCE, image.shape), 0, 255).astype(np.uint8)


def test_noise_is_no_change():
    rng = np.random.default_rng(0)
    assert not any(changed(picture(rng), picture(rng)).any() for _ in range(20))


def test_a_disc_is_found_where_it_is():
    rng = np.random.default_rng(1)
    found = changed(picture(rng), picture(rng, disc=(70, 50)))
    y, x = np.mgrid[:H, :W]
    inside = (x - 70) ** 2 + (y - 50) ** 2 < 15**2
    assert found[inside].all()
    assert not found[(x - 70) ** 2 + (y - 50) ** 2 > 19**2].any()
    valid = x < 70
    assert not changed(picture(rng), picture(rng, disc=(70, 50)), valid)[~valid].any()


def test_light_that_changes_everywhere_has_changed_everywhere():
    rng = np.random.default_rng(2)
    assert changed(picture(rng), picture(rng, level=12)).mean() > 0.99


def test_a_picture_of_which_nothing_stands_still_has_changed():
    rng = np.random.default_rng(5)
    noise = cv2.resize(rng.integers(0, 255, (15, 20, 3), np.uint8), (W, H), interpolation=cv2.INTER_NEAREST)
    assert changed(noise, np.roll(noise, 8, axis=1)).mean() > 0.8


def test_slow_change_is_found_once_it_is_large_enough():
    """A quarter of a grey level a frame is never seen from one frame to the next, but from the last that was taken."""
    rng = np.random.default_rng(3)
    reference, last, waited = picture(rng), picture(rng), []
    for frame in range(1, 60):
        now = picture(rng, level=0.25 * frame)
        assert not changed(last, now).mean() > 0.01
        waited.append(changed(reference, now).mean())
        reference, last = renewed(reference, now), now
    assert max(waited[:4]) < 0.01
    # 15 grey levels in all. Five standard deviations are 2.5, and the noise lets some pixels pass earlier.
    assert 5 < sum(waited) < 20  # of 59 frames
    # What it is compared with is never far behind.
    assert abs(float(np.mean(reference.astype(float) - last))) < 8


def test_a_view_without_a_picture_keeps_its_reference():
    image = np.zeros((4, 4, 3), np.uint8)
    assert renewed(None, image) is image
    assert renewed(image, None) is image
    assert renewed(None, None) is None


def test_the_box_around_a_change():
    change = np.zeros((H, W), bool)
    assert around(change) is None
    change[50:60, 80:180] = True
    assert around(change) == (slice(26, 84), slice(40, 160))


@pytest.mark.parametrize("with_masks", [False, True])
def test_flow_around_a_change_is_that_of_the_whole_picture(with_masks):
    """Inside a patch that moves by 4 px."""
    rng = np.random.default_rng(4)
    before, after = picture(rng), picture(rng)
    patch = cv2.resize(rng.integers(0, 255, (8, 8, 3), np.uint8), (32, 32), interpolation=cv2.INTER_CUBIC)
    before[34:66, 54:86], after[34:66, 58:90] = patch, patch
    box = around(changed(before, after))
    cues = [observe_key_views({0: FramePair(after, before, box=b)}, MotionConfig(), with_masks)[0] for b in (None, box)]
    whole, part = (cue.motion[40:60, 64:84] for cue in cues)
    assert np.median(whole, axis=(0, 1)) == pytest.approx((4, 0), abs=0.2)
    assert np.median(np.linalg.norm(whole - part, axis=-1)) < 0.2
    outside = np.ones((H, W), bool)
    outside[box] = False
    assert outside.any()
    assert not cues[1].reliable[outside].any()
    assert not cues[1].motion[outside].any()
