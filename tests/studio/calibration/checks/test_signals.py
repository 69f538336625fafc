"""Measurements of each camera's images over time."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.studio.calibration.checks.signals import (
    brightness,
    known_median,
    lamp_flicker,
    read_signals,
    repeated_frames,
)
from tests.assertions import assert_close
from tests.scenes.filmed import Clips, filmed


def brighter(image: np.ndarray, gain: float) -> np.ndarray:
    """Return an image at `gain` times the linear light."""
    return np.rint(255 * np.clip(encode_light(gain * decode_light(image / 255)), 0, 1)).astype(
        np.uint8
    )


def flickering(mains: float, fps: float, amplitude: float = 0.03, count: int = 60) -> np.ndarray:
    """Return the log brightness of six bands of rows under lamps, with noise and a drift."""
    times = np.arange(count)[:, None] / fps
    phases = np.linspace(0, 2, 6)
    noise = 0.002 * np.random.default_rng(0).standard_normal((count, 6))
    return amplitude * np.sin(4 * np.pi * mains * times + phases) + 0.02 * times + noise


def test_brightness__is_the_log_of_the_gain(clips: Clips) -> None:
    gains = np.exp(np.linspace(-0.2, 0.2, 9))
    signals = read_signals(
        filmed([[brighter(clip[0], gain) for gain in gains] for clip in clips]), 9
    )
    log_gains = known_median(brightness(signals), axis=2)
    assert_close(log_gains, np.repeat(np.log(gains)[:, None], len(clips), 1), atol=0.01)


@pytest.mark.parametrize(
    ("mains", "fps", "alias"), [(50, 30, 10), (60, 25, 5), (50, 60, 20), (50, 24, 4), (60, 50, 20)]
)
def test_lamp_flicker__names_the_mains(mains: int, fps: float, alias: float) -> None:
    lamp = lamp_flicker(flickering(mains, fps), fps)
    assert lamp is not None
    assert lamp.mains == (mains,)
    assert lamp.alias == alias
    assert_close(lamp.amplitude, 0.03, rtol=0.1)


@pytest.mark.parametrize(
    ("mains", "fps", "amplitude"),
    [(50, 25, 0.03), (37, 30, 0.03), (50, 30, 0), (50, 30, 0.001)],
    ids=["same phase in every frame", "no lamp has this frequency", "noise", "too weak"],
)
def test_lamp_flicker__is_none_without_lamps(mains: float, fps: float, amplitude: float) -> None:
    assert lamp_flicker(flickering(mains, fps, amplitude), fps) is None


def test_repeated_frames__are_those_in_which_only_one_camera_stops(clips: Clips) -> None:
    assert repeated_frames(read_signals(filmed(clips), 32)) == ((), (), (), ())
    stuck = [*clips[1][:12], clips[1][11], *clips[1][13:]]
    paused = [[*clip[:20], clip[19], *clip[21:]] for clip in [clips[0], stuck, *clips[2:]]]
    assert repeated_frames(read_signals(filmed(paused), 32)) == ((), (12,), (), ())
    halved = [clips[0][t // 2 * 2] for t in range(32)]
    repeated = repeated_frames(read_signals(filmed([halved, *clips[1:]]), 32))[0]
    assert set(repeated) <= set(range(1, 32, 2))
    assert len(repeated) > 12


def test_read_signals__leaves_out_missing_images_and_masked_pixels(clips: Clips) -> None:
    capture = filmed([[None, *clips[0][1:]], *clips[1:]])
    mask = np.ones((150, 200), bool)
    mask[:75] = False
    object.__setattr__(capture, "masks", (mask, None, None, None))
    signals = read_signals(capture, 3)
    assert [len(thumbs) for thumbs in signals.thumbs] == [3] * 4
    assert np.isnan(signals.thumbs[0][0]).all()
    assert_close(np.isnan(signals.thumbs[0][1]).mean(), 0.5, atol=0.02)
    assert np.isnan(signals.sharpness).sum() == 1
