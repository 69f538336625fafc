"""Recordings that are hard to reconstruct: every fit stays finite, shows what it can, and says what
is wrong.
"""

import numpy as np
import pytest

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
