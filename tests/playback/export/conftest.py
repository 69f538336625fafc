"""Fixtures of the tests in a browser."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.playback.export.web import write_web_page
from morgs_mi.playback.streams import open_stream
from tests.playback.export.pages import HEIGHT, WIDTH
from tests.scenes.changing_splats import rig, splats, write_stream


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return the folder of a stream and its page, with SH of degree 3, births, a death, a blue
    background and an image behind the third view, and its states.
    """
    folder = tmp_path_factory.mktemp("web")
    cameras = list(rig(WIDTH, HEIGHT))
    ramps = np.mgrid[:HEIGHT, :WIDTH] / [[[HEIGHT]], [[WIDTH]]]
    image = np.stack([*ramps, 0.5 * ramps[0]], axis=2)
    cameras[2] = replace(cameras[2], background=image)
    states = write_stream(
        folder / "stream.morgs",
        start=splats(degree=3),
        cameras=cameras,
        metadata={"config": {"render": {"background": [0.2, 0.5, 0.8]}}},
    )
    write_web_page(open_stream(folder), folder / "page.html")
    return folder, states
