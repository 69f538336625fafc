"""The page of the viewer in headless Chromium: a stream that grows, the recorded image, exact
images.
"""

import json

import numpy as np
import pytest

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.playback.player import picture
from morgs_mi.playback.streams import open_stream
from tests.playback.export.pages import HEIGHT, WIDTH, Page
from tests.playback.viewer.serving import decoded, viewing
from tests.scenes.cameras import look_at_cameras
from tests.scenes.changing_splats import NAMES, rig, splats, write_stream

# Colours of the recorded images by frame.
RECORDED = ((200, 60, 40), (40, 200, 60), (60, 40, 200), (200, 200, 40))
READY = "!!window.player && player.settled"
RECORDING = "!document.getElementById('recording').hidden"
RENDERING = "!document.getElementById('rendering').hidden"


class Viewed(Page):
    """A page of the viewer."""

    def __init__(self, browser, url, wishes="pause", expected=None):
        super().__init__(browser, f"{url}#{wishes}")
        if expected is None:
            self.wait(READY)
        else:
            self.get_by_text(expected).wait_for()

    def press(self, key, condition="true"):
        self.keyboard.press(key)
        self.wait_for_timeout(500)  # the view rests
        self.wait(f"player.settled && ({condition})")

    def shows(self, count):
        """Wait until the page shows a frame, such as `1 / 3`."""
        self.wait(f"player.settled && document.getElementById('count').textContent === '{count}'")

    def exact_image(self):
        """Return the exact image that the page shows, as it was sent."""
        self.locator("#rendering").wait_for()
        code = (
            "fetch(document.getElementById('rendering').src).then((answer) => answer.arrayBuffer())"
        )
        data = self.evaluate(f"{code}.then((data) => [...new Uint8Array(data)])")
        return decoded(bytes(data))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return the folder of a stream with its capture, and its states."""
    folder = tmp_path_factory.mktemp("viewed")
    cameras = rig(WIDTH, HEIGHT)
    metadata = {"num_frames": 4, "test_view": None}
    states = write_stream(
        folder / "stream.morgs", start=splats(degree=3), cameras=cameras, metadata=metadata
    )
    write_colmap(folder / "capture" / "sparse" / "0", cameras)
    for name in NAMES:
        clip = [np.full((HEIGHT, WIDTH, 3), color, np.uint8) for color in RECORDED]
        write_video(folder / "capture" / f"{name}.mkv", clip, 10)
    (folder / "capture.json").write_text(json.dumps({"capture": str(folder / "capture")}))
    return folder, states


@pytest.fixture(scope="module")
def url(clip):
    with viewing(clip[0]) as url:
        yield url


def test_page__follows_a_stream_that_grows(browser, clip, tmp_path):
    complete = (clip[0] / "stream.morgs").read_bytes()
    ends = [offset for _, _, offset in open_stream(clip[0]).index()]
    file = tmp_path / "stream.morgs"
    file.write_bytes(complete[: ends[0]])
    with (
        viewing(tmp_path) as url,
        Viewed(browser, url, "follow", "the stream has no frame yet") as page,
    ):
        bar = page.locator("#bar").bounding_box()  # of a clip
        assert page.locator("#slider").is_visible()
        write_stream(
            tmp_path / PROVISIONAL,
            1,
            splats(1200, seed=3),
            rig(WIDTH, HEIGHT),
            {**open_stream(tmp_path).metadata, "provisional": {"seconds": 540, "left": 361}},
        )
        page.get_by_text("first frame: 1,200 Gaussians, 9 min, 6 min left").wait_for()
        assert not page.locator("#curve").is_visible(), "there are no recorded images"
        page.wait(READY)
        assert not page.locator("#message").is_visible()
        provisional = page.image()
        file.write_bytes(complete[: ends[1]])
        (tmp_path / PROVISIONAL).unlink()
        page.get_by_text("Provisional first frame").wait_for(state="hidden")
        page.wait(READY)
        assert not np.array_equal(page.image(), provisional)
        assert page.locator("#bar").bounding_box() == bar
        file.write_bytes(complete[: ends[2] + 10])  # and a part of a packet
        page.shows("1 / 1")
        page.get_by_text("truncated or damaged at byte").wait_for()  # nothing follows
        file.write_bytes(complete[: ends[3]])
        page.shows("2 / 2")
        assert not page.locator("#message").is_visible()
        page.press("Home")
        file.write_bytes(complete)
        page.shows("0 / 3")  # it stays where it is
        page.press("End")
        followed = page.image()
    with viewing(clip[0]) as url, Viewed(browser, url, "pause&frame=3") as page:
        assert np.array_equal(page.image(), followed)
        assert not page.errors


def test_page__starts_again_with_another_stream(browser, tmp_path):
    write_stream(tmp_path / "stream.morgs")
    with viewing(tmp_path) as url, Viewed(browser, url, "pause&frame=3") as page:
        write_stream(tmp_path / "stream.morgs", 2, splats(30, seed=3))
        page.shows("1 / 1")
        cameras = tuple(
            look_at_cameras([(0, -4, 1), (4, 0, 1)], 45, 64, 48, ("front", "side"), up=(0, 0, 1))
        )
        with page.expect_navigation():
            write_stream(tmp_path / "stream.morgs", 3, cameras=cameras)
        page.wait(f"{READY} && player.cameras.length === 2")
        (tmp_path / "stream.morgs").write_bytes(b"something else")
        page.get_by_text("expected a stream, got another file").wait_for()
        write_stream(tmp_path / "stream.morgs", 4, cameras=cameras)
        page.wait(f"{READY} && player.frames.length === 4")
        assert not page.locator("#message").is_visible()
        # The browser's own word on the refusals.
        assert all("status of 400" in error for error in page.errors)


def test_page__wipes_between_the_rendered_and_the_recorded_image(browser, url):
    with Viewed(browser, url, "pause&frame=1&camera=right") as page:
        rendered = page.image()
        page.press("v", RECORDING)
        page.get_by_label("Share of the recorded image").fill("75")
        image = page.image().astype(int)
        column = WIDTH * 3 // 4
        assert np.abs(image[:90, : column - 3] - RECORDED[1]).max() < 12, (
            "compressed video and JPEG"
        )
        assert np.array_equal(image[:90, column + 3 :], rendered[:90, column + 3 :])
        page.locator("#canvas").focus()
        page.press("ArrowRight", RECORDING)
        assert np.abs(page.image().astype(int)[:90, : column - 3] - RECORDED[2]).max() < 12
        page.mouse.move(60, 60)  # above the controls
        page.mouse.wheel(0, 500)
        page.locator("#recording").wait_for(state="hidden")
        page.press("r", RECORDING)
        assert not page.errors


def test_page__shows_the_image_of_rasterize_when_the_view_rests(browser, clip, url):
    camera = rig(WIDTH, HEIGHT)[2]
    gaussians = clip[1][1].gaussians
    with Viewed(browser, url, "pause&frame=1&camera=right") as page:
        page.press("x", RENDERING)
        for key, mode in ((1, "color"), (2, "motion"), (3, "confidence")):
            page.press(str(key), RENDERING)
            expected = picture(open_stream(clip[0]), gaussians, camera, mode, 0.03 * WIDTH)
            assert np.abs(page.exact_image() - expected.astype(int)).max() <= 3, (
                "the page rounds the camera"
            )
        assert np.array_equal(page.image(), page.exact_image()), "the page shows it pixel by pixel"
        page.mouse.move(WIDTH / 2, 60)
        page.mouse.down()
        page.mouse.move(WIDTH / 2 + 20, 60, steps=2)
        page.locator("#rendering").wait_for(state="hidden")
        page.mouse.up()
        page.wait(f"player.settled && {RENDERING}")
        assert not page.errors


def test_page__names_a_damaged_packet(browser, tmp_path):
    write_stream(tmp_path / "stream.morgs")
    data = bytearray((tmp_path / "stream.morgs").read_bytes())
    data[open_stream(tmp_path).index()[2][2] + 100] ^= 1
    (tmp_path / "stream.morgs").write_bytes(data)
    with viewing(tmp_path) as url, Viewed(browser, url) as page:
        page.keyboard.press("End")
        page.get_by_text("This stream is damaged: frame 2: the packet at byte").wait_for()
        page.evaluate("player.playback.seek(1)")
        page.shows("1 / 3")
        assert not page.errors
        page.evaluate("player.frames[1] = 3")
        page.keyboard.press("x")
        page.get_by_text("No exact image: ").wait_for()
        assert "packet 3 at byte" in page.text("#notes")


def test_page__says_that_the_server_has_ended(browser, clip):
    with viewing(clip[0]) as url:
        page = Viewed(browser, url)
    with page:
        page.get_by_text("The server of this page does not answer").wait_for()
        page.press("End")
        assert page.text("#count") == "3 / 3"
