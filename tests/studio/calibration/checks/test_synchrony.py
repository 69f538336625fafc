"""Time offsets from epipolar profiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import load_capture
from morgs_mi.studio.calibration.checks.signals import read_signals
from morgs_mi.studio.calibration.checks.synchrony import consensus, time_offsets
from morgs_mi.studio.synth.disturbances import load_disturbances
from tests.assertions import assert_close
from tests.scenes.filmed import Clips, film, filmed, rig


def test_time_offsets__are_recovered_to_a_fraction_of_a_frame() -> None:
    true = np.array([0.0, 1.3, -2.0, 0.4])
    offsets = time_offsets(rig(), read_signals(filmed(film(true.tolist())), 32).thumbs)
    assert_close(offsets, true, atol=0.15)


@pytest.mark.long
def test_time_offsets__are_those_of_a_path_traced_clip(tmp_path: Path) -> None:
    options = (
        "--cameras 4 --frames 20 --width 160 --height 120 --spp 4 --no-lossless --time-offset 3 "
        "--seed 3"
    )
    assert cli.main(["synth", "arm", str(tmp_path / "clip"), *options.split()]) == 0
    capture = load_capture(tmp_path / "clip")
    true = np.array(
        [camera.time_offset for camera in load_disturbances(tmp_path / "clip" / "truth").values()]
    )
    offsets = time_offsets(capture.cameras, read_signals(capture, 20).thumbs)
    # Near enough to distinguish whole frames.
    assert_close(offsets - offsets[0], true, atol=0.5)


def test_time_offsets__do_not_depend_on_the_exposure(clips: Clips) -> None:
    gains = np.random.default_rng(0).uniform(0.9, 1.1, (4, 32))
    dimmed = [
        [
            (gain * image).clip(0, 255).astype(np.uint8)
            for gain, image in zip(factors, clip, strict=True)
        ]
        for factors, clip in zip(gains, clips, strict=True)
    ]
    offsets = time_offsets(rig(), read_signals(filmed(dimmed), 32).thumbs)
    assert_close(offsets, np.zeros(4), atol=0.2)


def test_time_offsets__are_not_determined_without_motion(clips: Clips) -> None:
    noise = np.random.default_rng(0).integers(-2, 3, (4, 32, 150, 200, 3))
    still = [
        [(clip[0] + n).clip(0, 255).astype(np.uint8) for n in shifts]
        for shifts, clip in zip(noise, clips, strict=True)
    ]
    assert np.isnan(time_offsets(rig(), read_signals(filmed(still), 32).thumbs)).all()


def test_time_offsets__are_not_determined_for_a_camera_with_another_recording(clips: Clips) -> None:
    other = film((0, 0, 0, 200))[3]
    offsets = time_offsets(rig(), read_signals(filmed([*clips[:3], other]), 32).thumbs)
    assert_close(offsets[:3], np.zeros(3), atol=0.15)
    assert np.isnan(offsets[3])


def test_consensus__ignores_an_outlier_and_what_is_in_no_pair() -> None:
    views = np.array([(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)])
    true = np.array([0.0, 1.0, -2.0, 0.5])
    differences = true[views[:, 1]] - true[views[:, 0]]
    differences[3] += 7
    values = consensus(5, views, differences, np.ones(len(views)))
    # The lower one of two middle values is zero.
    assert_close(values[:4], true, atol=0.02)
    assert np.isnan(values[4])
    assert np.isnan(consensus(2, views[:0], differences[:0], differences[:0])).all()
