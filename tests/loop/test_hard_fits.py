"""Recordings that are hard to reconstruct: every fit stays finite and shows what it can."""

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
    for quality, values, _ in fitted(fit):
        assert quality > fit.psnr
        assert all(np.isfinite(value).all() for value in values.values())
