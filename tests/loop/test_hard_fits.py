"""Recordings that are hard to reconstruct: every fit stays finite, shows what it can, and says what
is wrong.
"""

import numpy as np
import pytest

from morgs_mi.stream_loop import StreamLoop
from tests.quick import quick
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.hard_fits import HARD_FITS, fitted


@pytest.mark.parametrize(
    "fit",
    [
        pytest.param(f, id=f.name, marks=pytest.mark.slow if f.num_frames > 9 else ())
        for f in HARD_FITS
    ],
)
def test_push__stays_finite_on_hard_recordings(fit):
    statuses = []
    for quality, values, status in fitted(fit):
        assert quality > fit.psnr
        assert all(np.isfinite(value).all() for value in values.values())
        statuses.append(status)
    assert any(fit.status in status for status in statuses)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("width", "height"), [(2, 2), (8, 6), (16, 12)])
def test_push__fits_tiny_images_without_warnings_of_numpy(width, height):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (50, 3)), rng.uniform(0, 1, (50, 3))
    loop = StreamLoop(look_at_cameras(QUAD, 50, width, height), *points, quick(exposure="auto"))
    for _ in range(2):
        loop.push(list(rng.integers(0, 256, (4, height, width, 3), np.uint8)))
