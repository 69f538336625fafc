"""Pictures of the stages of a frame."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.ewa import rendered, write_picture
from benchmarks.pictures import draw
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.gaussians import make_unit_scene, to_gaussians
from tests.scenes.recording import CONFIG, recording

PAGE = Path(__file__).parents[2] / "docs/how-it-works.md"


@pytest.mark.slow
def test_draw__returns_every_picture_of_the_page():
    capture = recording()
    loop = StreamLoop.of(capture, CONFIG)
    *others, last = [
        frame.images for frame in capture.partial_frames(0, CONFIG.motion.mask_interval + 1)
    ]
    for images in others:
        loop.push(images)
    pictures = draw(loop, last)
    assert set(pictures) == set(
        re.findall(r"\(how-it-works/(\w+)\.jpg\)", PAGE.read_text(encoding="utf-8"))
    )
    assert {(picture.shape, picture.dtype.name) for picture in pictures.values()} == {
        ((24, 32, 3), "uint8")
    }
    assert pictures["flow"].std() > 0


def test_ewa__draws_similar_images_of_both_integrators(tmp_path):
    images = rendered(to_gaussians(make_unit_scene()), make_sensor_camera(), 16)
    assert {image.shape for image in images.values()} == {(18, 21, 3)}
    assert write_picture(tmp_path / "ewa.jpg", images) > 25
    assert (tmp_path / "ewa.jpg").stat().st_size > 0
