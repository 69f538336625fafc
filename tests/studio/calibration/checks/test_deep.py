"""Check of a whole recording: each fault is found, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.colors import same_color
from matplotlib.figure import Figure

from morgs_mi.capture.points import match_capture
from morgs_mi.core.files import json_finite
from morgs_mi.studio.calibration.checks.deep import DeepCheck, Finding, check_deep
from morgs_mi.studio.calibration.checks.plots import draw_deep
from morgs_mi.studio.calibration.checks.rig_check import check_rig
from morgs_mi.studio.calibration.checks.signals import read_signals
from tests.scenes.filmed import FPS, Clips, film, filmed
from tests.studio.calibration.checks.test_signals import brighter


def checked(clips: Clips) -> DeepCheck:
    capture = filmed(clips)
    shared = match_capture(capture)
    return check_deep(capture, shared, check_rig(capture, shared), read_signals(capture, 120))


def changed(clips: Clips, camera: int, change: Callable[[int, np.ndarray], np.ndarray]) -> Clips:
    """Return the clips with another one of a camera, by a function of the frame and its image."""
    clip = [change(t, image) for t, image in enumerate(clips[camera]) if image is not None]
    return [*clips[:camera], clip, *clips[camera + 1 :]]


def flickering(clips: Clips) -> Clips:
    for camera in range(len(clips)):
        clips = changed(
            clips, camera, lambda t, x: brighter(x, 1 + 0.02 * np.sin(2 * np.pi * 100 * t / FPS))
        )
    return clips


def darkening(clips: Clips) -> Clips:
    for camera in range(len(clips)):
        clips = changed(clips, camera, lambda t, x: brighter(x, np.exp(-0.01 * t)))
    return clips


def lost_frames(clips: Clips) -> Clips:
    del clips
    whole = film(frames=58)
    return [*(clip[:56] for clip in whole[:3]), [*whole[3][:28], *whole[3][30:]]]


FAULTS = {
    "cam1 is 1.4 frames (47 ms) ahead of the other cameras: use --offset cam1 -1": lambda _: film(
        (0, 1.4, 0, 0)
    ),
    "cam3 is 2.0 frames (67 ms) behind the other cameras: use --offset cam3 2": lambda _: film(
        (0, 0, 0, -2)
    ),
    (
        "cam3 moves 2.0 frames ahead of the other cameras during the first 56 frames: frames were "
        "lost"
    ): lost_frames,
    "cam2 is 25 % brighter than the other cameras": lambda c: changed(
        c, 2, lambda _, x: brighter(x, 1.25)
    ),
    "cam0 has another white balance than the other cameras (R +": lambda c: changed(
        c, 0, lambda _, x: np.concatenate([brighter(x[..., :1], 1.15), x[..., 1:]], axis=2)
    ),
    "cam1 changes its brightness by 15 % over time, up to 15 % from frame to frame": lambda c: (
        changed(c, 1, lambda t, x: brighter(x, 1.15 if t > 15 else 1))
    ),
    "cam0, cam1, cam2, cam3 flicker by 1.9 % at 10.0 Hz, as lamps on 50 Hz mains do": flickering,
    "cam0, cam1, cam2, cam3 change their brightness alike, by 36 % over time: the light": darkening,
    "cam3 is less sharp than the other cameras": lambda c: changed(
        c, 3, lambda _, x: cv2.GaussianBlur(x, (0, 0), 2.0)
    ),
    "cam2 is blurred in frames 8, 9:": lambda c: changed(
        c, 2, lambda t, x: cv2.GaussianBlur(x, (0, 0), 1.5) if t in (8, 9) else x
    ),
    "cam0 repeats its last image in frames 5, 20 while": lambda c: changed(
        c, 0, lambda t, x: c[0][t - 1] if t in (5, 20) else x
    ),
}


def test_check_deep__finds_nothing_in_a_clip_without_faults(clips: Clips) -> None:
    check = checked(clips)
    assert [finding.sentence for finding in check.findings] == []
    assert check.unmeasured == ""


@pytest.mark.slow
@pytest.mark.parametrize("sentence", FAULTS)
def test_check_deep__finds_a_fault_and_no_other(sentence: str, clips: Clips) -> None:
    sentences = [finding.sentence for finding in checked(FAULTS[sentence](clips)).findings]
    assert len(sentences) == 1, sentences
    assert sentences[0].startswith(sentence)


def test_check_deep__states_what_it_cannot_measure(clips: Clips) -> None:
    grey: Clips = [[np.full((150, 200, 3), 90, np.uint8)] * 3 for _ in clips]
    check = checked(grey)
    assert check.findings == ()
    assert check.unmeasured == (
        "Not measured, without enough common motion or matches: time offsets of all cameras; "
        "exposure against the other cameras of all cameras."
    )
    json.dumps(json_finite(check.as_dict()), allow_nan=False)


@pytest.mark.parametrize(("cameras", "frames"), [(1, 32), (2, 32), (4, 1), (4, 2)])
@pytest.mark.filterwarnings("error")
def test_check_deep__finds_nothing_in_few_cameras_or_frames(
    cameras: int, frames: int, clips: Clips
) -> None:
    check = checked([clip[:frames] for clip in clips[:cameras]])
    assert check.findings == ()
    drawn(check).canvas.draw()


@pytest.mark.slow
def test_draw_deep__marks_the_cameras_with_findings(clips: Clips) -> None:
    sound = checked(clips)
    assert red_names(drawn(sound)) == {}
    finding = Finding("time", (sound.names[1],), "cam1 is 1.4 frames ahead.")
    check = replace(sound, offsets=np.array([0, 1.4, 0, np.nan]), findings=(finding,))
    figure = drawn(check)
    assert red_names(figure) == {"Time offset, frames": ["cam1"]}
    time = panel_of(figure, "Time offset, frames")
    heights = [bar.get_height() for bar in time.patches]
    assert heights == [0, 1.4, 0, 0]
    assert [same_color(bar.get_facecolor(), "tab:red") for bar in time.patches] == [
        False,
        True,
        False,
        False,
    ]
    assert [(text.get_text(), text.xy[0]) for text in time.texts] == [("?", 3)]  # was not measured


def drawn(check: DeepCheck) -> Figure:
    figure = Figure()
    draw_deep(figure, check)
    return figure


def panel_of(figure: Figure, title: str) -> Any:
    return next(panel for panel in figure.axes if panel.get_title(loc="left") == title)


def red_names(figure: Figure) -> dict[str, list[str]]:
    """Return the names of cameras that are red, by the title of the panel."""
    names_by_plot = {}
    for panel in figure.axes:
        labels = [*panel.get_xticklabels(), *panel.get_yticklabels()]
        if names := [
            label.get_text() for label in labels if same_color(label.get_color(), "tab:red")
        ]:
            names_by_plot[panel.get_title(loc="left")] = names
    return names_by_plot
