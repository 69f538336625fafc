"""Fixtures of the tests in a browser."""

import pytest

from morgs_mi.playback.export.web import write_web_page
from morgs_mi.playback.streams import open_stream
from tests.playback.export.pages import HEIGHT, WIDTH
from tests.scenes.changing_splats import rig, splats, write_stream


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return the folder of a stream and its page, with SH of degree 3, births, a death and a blue
    background, and its states.
    """
    folder = tmp_path_factory.mktemp("web")
    states = write_stream(
        folder / "stream.morgs",
        start=splats(degree=3),
        cameras=rig(WIDTH, HEIGHT),
        metadata={"config": {"render": {"background": [0.2, 0.5, 0.8]}}},
    )
    write_web_page(open_stream(folder), folder / "page.html")
    return folder, states
