"""White noise, and texture that is none."""

import cv2
import numpy as np
import pytest

from morgs_mi.fit.detail import is_noisy, noise_of, white_noise_of


def bytes_of(values):
    return np.clip(255 * values + 0.5, 0, 255).astype(np.uint8)


def foliage(seed=0, size=128):
    """Return a texture [S, S, 3] in [0, 1] with equal contrast in every octave, as in nature, seen
    by a lens.
    """
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(size, size))) / np.maximum(
        frequency, 1 / size
    )
    values = cv2.GaussianBlur(np.fft.irfft2(spectrum, s=(size, size)), None, 0.7)
    return (0.5 + 0.12 * values / values.std()).repeat(3).reshape(size, size, 3)


@pytest.mark.parametrize("noise", [0.01, 0.02, 0.05])
def test_white_noise_of__finds_white_noise(noise):
    rng = np.random.default_rng(1)
    ramp = np.linspace(0.3, 0.7, 128)[:, None, None] * np.ones((128, 96, 3))
    assert white_noise_of(bytes_of(ramp + rng.normal(0, noise, ramp.shape))) == pytest.approx(
        noise, rel=0.06
    )


def test_white_noise_of__takes_texture_for_none():
    image = foliage()
    assert noise_of(bytes_of(image)) > 0.005
    assert white_noise_of(bytes_of(image)) < 0.001
    noisy = image + np.random.default_rng(2).normal(0, 0.03, image.shape)
    assert 0.012 < white_noise_of(bytes_of(noisy)) < 0.031


def test_is_noisy__judges_by_the_mean_of_the_views():
    rng = np.random.default_rng(3)
    flat = np.full((64, 64, 3), 0.5)
    clean = bytes_of(flat)
    noisy = bytes_of(flat + rng.normal(0, 0.025, flat.shape))
    assert not is_noisy([clean, clean, noisy])
    assert is_noisy([clean, noisy, noisy])
