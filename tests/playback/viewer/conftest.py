"""A stream that a viewer serves."""

import pytest

from tests.playback.viewer.serving import viewing
from tests.scenes.changing_splats import write_stream


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return the folder of a stream and its states."""
    folder = tmp_path_factory.mktemp("clip")
    return folder, write_stream(folder / "stream.morgs")


@pytest.fixture(scope="module")
def url(clip):
    with viewing(clip[0]) as url:
        yield url
