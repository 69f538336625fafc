"""The page in headless Chromium: loading, scrubbing, modes, cameras, recorded images, keys, a growing file."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.codec.packets import CodedFrame
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.export.axes import up_direction
from morgs_mi.playback.player import channel_image, render, render_config
from morgs_mi.playback.streams import open_stream
from tests.scenes.captures import n3dv
from tests.scenes.changing_splats import NAMES, write_stream

pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")
playwright = pytest.importorskip("playwright.sync_api", reason="install it with pip install 'morgs-mi[viewer-test]'")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = next(filter(None, map(shutil.which, BROWSERS)), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None,
        reason="no Chromium found; install it with tools/setup_browser.sh (apt-get install chromium)",
    ),
]

WIDTH, HEIGHT = 480, 360
# An error message of viser: three.js cannot compute a bounding sphere of its flat quads.
KNOWN_ERROR = "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN"
# A software rasteriser on a busy machine starts slowly.
TIMEOUT_MS = 60_000
# Colours of the recorded images by frame.
RECORDED = ((200, 60, 40), (40, 200, 60), (60, 40, 200), (200, 200, 40))


def write_clips(path: Path, names: tuple[str, ...]) -> None:
    for name in names:
        write_video(path / f"{name}.mkv", [np.full((48, 64, 3), color, np.uint8) for color in RECORDED], 10)


@pytest.fixture
def page(tmp_path):
    """Serve a stream without its last frame, and yield (page, states, grow); `grow` completes the file."""
    states = write_stream(tmp_path / "stream.morgs")
    complete = (tmp_path / "stream.morgs").read_bytes()
    last = open_stream(tmp_path).index()[-1][2]
    (tmp_path / "stream.morgs").write_bytes(complete[:last])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    code = "import sys; from morgs_mi.cli import main; sys.exit(main())"
    capture = n3dv(tmp_path / "capture", NAMES, write_clips)
    arguments = ["view", str(tmp_path), "--port", str(port), "--no-open-browser", "--capture", str(capture)]
    server = subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    console_errors = []
    try:
        with playwright.sync_playwright() as driver:
            options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=options)
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.set_default_timeout(TIMEOUT_MS)
            page.on("console", lambda m: console_errors.append(m.text) if m.type == "error" else None)
            page.on("pageerror", lambda error: console_errors.append(str(error)))
            for _ in range(100):
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                page.wait_for_timeout(200)
            # Without this parameter, the page lowers its resolution on a busy machine.
            page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1")
            yield page, states, lambda: (tmp_path / "stream.morgs").write_bytes(complete)
            browser.close()
    finally:
        server.send_signal(signal.SIGINT)
        try:
            _, errors = server.communicate(timeout=20)
        finally:
            server.kill()
    assert server.returncode == 130, errors
    assert not [text for text in console_errors if not text.startswith(KNOWN_ERROR)]


def screenshot(page) -> np.ndarray:
    """Return the image that the page shows behind its controls."""
    style = page.add_style_tag(content="body *:not(canvas):not(:has(canvas)) {visibility: hidden !important}")
    image = cv2.cvtColor(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), 1), cv2.COLOR_BGR2RGB)
    style.evaluate("node => node.remove()")
    return image


def wait_for(page, expected: np.ndarray, least: float) -> None:
    """Wait until the page shows an image with at least that PSNR (dB); it appears some time after the controls."""
    found = 0.0
    for _ in range(300):
        found = psnr(screenshot(page) / 255, expected / 255)
        if found >= least:
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{found:.1f} dB, expected {least}")


def rendered(stream: StreamReader, state: CodedFrame, mode: str) -> np.ndarray:
    """Return the renderer's image from the page's initial view: the first camera, upright to the mean up."""
    first = stream.cameras[0]
    ahead = first.position + first.viewmat[2, :3]
    camera = Camera.look_at(first.position, ahead, up_direction(stream.cameras), 45, WIDTH, HEIGHT)
    return channel_image(mode, render(state.gaussians, camera, (mode,), render_config(stream))[mode])


def select_mode(page, mode: str) -> None:
    page.get_by_label("Mode", exact=True).click()
    page.get_by_role("option", name=mode).click()


def set_number(page, name: str, value: float) -> None:
    row = page.get_by_text(name, exact=True).locator("xpath=ancestor::*[.//input][1]")
    number = row.locator("input[inputmode=decimal]").first
    number.fill(str(value))
    number.press("Enter")


def go_to(page, camera: str) -> None:
    page.get_by_label("Go to camera").click()
    page.get_by_role("option", name=camera).click()


def press(page, key: str) -> None:
    """Press a key while no control has the focus."""
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press(key)


def test_viewer__goes_to_cameras_and_compares_with_the_recording(page, tmp_path):
    page, states, _ = page
    stream = open_stream(tmp_path)
    camera = page.get_by_label("Go to camera")
    page.get_by_text("Frame 0 of 2, 40 Gaussians").wait_for()
    playwright.expect(camera).to_have_value("left")  # where the page starts

    go_to(page, "right")
    view = stream.cameras[2].resized(WIDTH, HEIGHT)
    image = channel_image("color", render(states[0].gaussians, view, ("color",), render_config(stream))["color"])
    wait_for(page, image, 38)
    playwright.expect(camera).to_have_value("right")

    set_number(page, "Recorded %", 75)
    image[:, : WIDTH * 3 // 4] = RECORDED[0]
    wait_for(page, image, 22)  # the labels and the line between the images
    press(page, "l")
    page.get_by_text("Frame 1 of 2").wait_for()
    image[:, : WIDTH * 3 // 4] = RECORDED[1]
    wait_for(page, image, 18)  # the Gaussians of the right quarter have moved
    page.mouse.move(60, 300)
    page.mouse.wheel(0, 2000)
    page.get_by_text("Go to a camera to see its recorded image").wait_for()
    playwright.expect(camera).to_have_value("free")

    set_number(page, "Recorded %", 0)
    page.get_by_text("Go to a camera to see its recorded image").wait_for(state="detached")
    page.wait_for_timeout(1000)
    without = screenshot(page)
    page.get_by_label("Show cameras").check()
    for _ in range(100):
        changed = (np.abs(screenshot(page).astype(int) - without).max(-1) > 40).mean()
        if changed > 0:
            break
        page.wait_for_timeout(100)
    assert 0 < changed < 0.1, "lines and names"
    press(page, "r")
    playwright.expect(camera).to_have_value("left")
    wait_for(page, rendered(stream, states[1], "color"), 35)


def test_viewer__shows_motion_by_key_with_its_scale(page):
    page, _, _ = page
    page.get_by_text("Frame 0 of 2, 40 Gaussians").wait_for()
    press(page, "m")
    page.get_by_text("Frame 1 of 2, 40 Gaussians", exact=True).wait_for()  # the first frame has no motion
    page.get_by_text(f"saturated: {0.03 * WIDTH:.3g} px per frame or more").wait_for()
    press(page, "m")
    page.get_by_text("1, moving").wait_for()
    press(page, "Home")
    page.get_by_text("Frame 0 of 2").wait_for()
    press(page, "Space")
    playwright.expect(page.get_by_label("Play")).to_be_checked()
    press(page, "Space")
    playwright.expect(page.get_by_label("Play")).not_to_be_checked()
    press(page, "End")
    page.get_by_text("Frame 2 of 2").wait_for()
    press(page, "j")
    page.get_by_text("Frame 1 of 2").wait_for()
    press(page, "j")
    page.get_by_text("Frame 0 of 2").wait_for()
    press(page, "l")
    page.get_by_text("Frame 1 of 2").wait_for()
    select_mode(page, "color")
    page.get_by_text("1, moving").wait_for(state="hidden")


def test_viewer__shows_the_first_frame_and_follows_the_fit(page, tmp_path):
    page, states, grow = page
    page.get_by_text("Frame 0 of 2, 40 Gaussians").wait_for()
    wait_for(page, rendered(open_stream(tmp_path), states[0], "color"), 40)  # see below
    grow()
    page.get_by_label("Follow the fit").check()
    page.get_by_text("Frame 3 of 3, 41 Gaussians").wait_for()


def test_viewer__shows_the_images_of_the_renderer(page, tmp_path):
    page, states, grow = page
    stream = open_stream(tmp_path)

    page.get_by_text("Frame 0 of 2, 40 Gaussians").wait_for()
    # Half-precision covariances, 8-bit colours and opacities: 47 dB. A camera that is off by a degree: 22 dB.
    wait_for(page, rendered(stream, states[0], "color"), 40)

    select_mode(page, "offset")
    page.get_by_text("Frame 1 of 2, 40 Gaussians", exact=True).wait_for()
    set_number(page, "Frame", 0)
    page.get_by_text("This frame stores no offset: set codec.offset").wait_for()
    set_number(page, "Frame", 1)
    page.get_by_text("Frame 1 of 2, 40 Gaussians", exact=True).wait_for()
    # The renderer colours the blended values, the page blends colours; a white page has 13 dB.
    wait_for(page, rendered(stream, states[1], "offset"), 16)
    select_mode(page, "color")
    wait_for(page, rendered(stream, states[1], "color"), 40)

    page.get_by_label("Exact image").check()
    for mode in ("motion", "confidence", "offset", "depth", "color"):
        select_mode(page, mode)
        wait_for(page, rendered(stream, states[1], mode), 50)  # the page rounds the camera: some pixels differ by 1
    page.get_by_label("Exact image").uncheck()
    select_mode(page, "confidence")
    wait_for(page, rendered(stream, states[1], "confidence"), 17)  # as above

    select_mode(page, "color")
    wait_for(page, rendered(stream, states[1], "color"), 40)
    before = screenshot(page)
    page.get_by_label("Trajectories").check()
    page.wait_for_timeout(1000)
    lines = np.abs(screenshot(page).astype(int) - before).max(-1) > 40
    assert 0 < lines.mean() < 0.2

    grow()
    page.get_by_label("Follow the fit").check()
    page.get_by_text("Frame 3 of 3, 41 Gaussians").wait_for()
    page.get_by_label("Play").check()
    page.get_by_text("Frame 2 of 3, 41 Gaussians").wait_for()

    (tmp_path / "stream.morgs").write_bytes(b"")
    page.get_by_text("the header is missing").wait_for()
    grow()
    page.get_by_text("of 3, 4").wait_for()


def test_viewer__downloads_the_exact_image(page, tmp_path):
    page, states, _ = page
    page.get_by_text("Frame 0 of 2, 40 Gaussians").wait_for()
    select_mode(page, "confidence")
    page.get_by_text("Frame 1 of 2, 40 Gaussians").wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    assert download.value.suggested_filename == f"{tmp_path.name}-frame0001-confidence.png"
    image = cv2.imread(str(download.value.path()))
    assert image is not None
    expected = rendered(open_stream(tmp_path), states[1], "confidence")
    assert psnr(image[..., ::-1] / 255, expected / 255) > 50
