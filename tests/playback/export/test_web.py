"""The web page in headless Chromium: what it decodes, what it draws, its controls, and damaged
streams.
"""

import itertools
import os
import re
import shutil
from dataclasses import replace
from importlib.resources import files

import cv2
import numpy as np
import pytest

from morgs_mi.cli.main import main
from morgs_mi.codec.container import StreamWriter, camera_of_fields
from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import (
    coded_frames,
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.color_space import TRANSFER, exposed
from morgs_mi.core.rig import seen_points
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.io.ply import write_ply
from morgs_mi.platform.files import write_json
from morgs_mi.playback.default_rig import box_corners
from morgs_mi.playback.export.web import (
    stream_html,
    text_of_bytes,
    write_web_folder,
    write_web_page,
)
from morgs_mi.playback.player import channel_image, picture, render
from morgs_mi.playback.stream_header import render_config
from morgs_mi.playback.streams import open_stream
from tests.playback.export.pages import HEIGHT, HOLD_FIRST_SORTING, WIDTH, Page, served
from tests.scenes.changing_splats import rig, splats, write_stream
from tests.scenes.gaussians import isotropic
from tests.scenes.moving_splats import CAMERAS, DISTANCE, EXACT, PIXELS, STEP

FRAMES = 4


# --------------------------------------------------------------------------------------------------
#  Without a browser
# --------------------------------------------------------------------------------------------------


def bytes_of_text(text, count):
    """Return the bytes as a reader of the page does."""
    bits = "".join(f"{ord(character) & 127:07b}" for character in text)
    return bytes(int(bits[8 * i : 8 * i + 8], 2) for i in range(count))


@pytest.mark.parametrize("count", [0, 1, 7, 100_000])
def test_text_of_bytes__keeps_every_byte_avoids_what_html_changes_and_is_short(count):
    data = np.random.default_rng(count).integers(0, 256, count, np.uint8).tobytes()
    text = text_of_bytes(data)
    assert bytes_of_text(text, count) == data
    assert not set(text) & {"\0", "\r", "<"}
    assert len(text.encode()) <= 1.2 * count + 2


def test_write_web_page__does_not_publish_the_metadata_of_the_fit(tmp_path):
    states = write_stream(tmp_path / "stream.morgs", metadata={"capture": "/home/user/secret"})
    write_web_page(open_stream(tmp_path), tmp_path / "page.html")
    write_web_folder(open_stream(tmp_path), tmp_path / "folder")
    published = open_stream(tmp_path / "folder")
    assert "capture" not in published.metadata
    assert [state.digest.tobytes() for state in coded_frames(published)] == [
        state.digest.tobytes() for state in states
    ]


@pytest.mark.parametrize(
    ("title", "written"),
    [
        ("{data}", "{data}"),
        ("</title><script>alert()</script>", "&lt;/title&gt;&lt;script&gt;alert()&lt;/script&gt;"),
        (None, "clip\N{REPLACEMENT CHARACTER}"),
    ],
)
def test_write_web_page__has_any_title_as_text(tmp_path, title, written):
    folder = tmp_path / os.fsdecode(b"clip\xff")
    folder.mkdir()
    write_stream(folder / "stream.morgs")
    stream = open_stream(folder)
    size = write_web_page(stream, tmp_path / "a.html", title="A clip")
    assert abs(write_web_page(stream, tmp_path / "b.html", title) - size) < 100
    assert f"<title>{written}</title>".encode() in (tmp_path / "b.html").read_bytes()
    assert "clip\N{REPLACEMENT CHARACTER}" in stream_html(stream).encode().decode()


@pytest.mark.parametrize(
    ("area", "speed", "expected"),
    [
        (0.004, 1, PIXELS / CAMERAS[0].width),
        (0.0076, 1, 10 * PIXELS / CAMERAS[0].width),
        (0.0076, 1e-4, 0.001),
    ],
    ids=["slow", "fast", "still"],
)
def test_write_web_page__scales_motion_by_its_99th_percentile(tmp_path, area, speed, expected):
    """Of two Gaussians, the small one is half as far away and ten times as fast in the image; with
    its opacity, it has 0.9 or 1.7 % of the weight. A still scene is not scaled up.
    """
    small = np.array([0, 1])
    gaussians = isotropic([(-0.3, 0, 0), (0.3, 0, -0.5 * DISTANCE)], 0.2, 0.9)
    log_scales = gaussians.numpy()["log_scales"] + 0.5 * np.log(area) * small[:, None]
    opacities = np.log([9.0, 1.0])  # of 0.9 and 0.5
    gaussians = replace(gaussians, log_scales=log_scales, logit_opacities=opacities)
    state = decode(None, keyframe_packet(gaussians, 0, CAMERAS, EXACT))
    steps = speed * STEP * (1 + 4 * small[:, None]) * [1, 0, 0]
    target = replace(state.gaussians, means=state.gaussians.numpy()["means"] + steps)
    with StreamWriter(tmp_path / "stream.morgs", CAMERAS, 30) as writer:
        writer.write(reemitted_keyframe(state))
        writer.write(residual_packet(state, target, None, CAMERAS, EXACT))
    write_web_folder(open_stream(tmp_path), tmp_path / "folder")
    scale = open_stream(tmp_path / "folder").metadata["motion_scale"]
    assert scale == pytest.approx(expected, rel=0.02)


def test_notice__names_the_runtime_of_assemblyscript():
    notice = (files("morgs_mi.playback.export") / "web_player" / "NOTICE").read_text(
        encoding="utf-8"
    )
    assert re.search(r"^assemblyscript [\d.]+ \(Apache-2.0\)$", notice, re.MULTILINE)
    assert "Apache License" in notice


def test_export_web__writes_a_page_or_a_folder(tmp_path, capsys):
    write_stream(tmp_path / "stream.morgs")
    assert main(["export", "web", str(tmp_path)]) == 0
    assert main(["export", "web", str(tmp_path), str(tmp_path / "site"), "--title", "A clip"]) == 0
    assert (tmp_path / "player.html").stat().st_size > 1e6
    assert main(["export", "web", str(tmp_path), str(tmp_path / "right"), "--camera", "right"]) == 0
    assert open_stream(tmp_path / "right").cameras[0].name == "right"
    assert b"<title>A clip</title>" in (tmp_path / "site" / "index.html").read_bytes()
    assert "player.html: 4 frames" in " ".join(capsys.readouterr().out.split())


# --------------------------------------------------------------------------------------------------
#  In the browser
# --------------------------------------------------------------------------------------------------


class Player(Page):
    """The page of a folder."""

    def __init__(self, browser, folder, wishes="pause", **context):
        super().__init__(browser, f"{(folder / 'page.html').as_uri()}#{wishes}", **context)
        self.wait("!!window.player && player.settled")

    def show(self, frame):
        self.evaluate(f"player.playback.seek({frame})")
        self.wait(f"player.playback.position === {frame} && player.settled")


@pytest.fixture(scope="module")
def opened(browser, clip):
    with Player(browser, clip[0]) as page:
        yield page


@pytest.fixture
def page(opened):
    """Return the page of the clip, paused at the first frame, and check afterwards what it reported
    and requested.
    """
    opened.evaluate("player.playback.play(false); player.playback.loop = true")
    opened.evaluate("if (!player.view.bounded) player.bound()")
    opened.evaluate("player.selectMode('color'); player.selectCamera(0); player.selectSpeed(3)")
    opened.show(0)
    yield opened
    assert not opened.errors
    # The workers are objects of the page itself.
    elsewhere = [url for url in opened.requests if not url.startswith("blob:")]
    assert elsewhere == [opened.url.split("#")[0]]


def decodes(page, position, coded):
    """Return whether the page decodes a position to the integers of a state."""
    values = page.evaluate(
        """async (position) => {
          const { ids, largest, exponents, values } = await player.playback.state(position);
          return [ids, largest, ...exponents, ...values].map((column) => [...column]);
        }""",
        position,
    )
    expected = [
        coded.ids,
        coded.grid.largest_components,
        *coded.grid.exponents.T,
        *coded.grid.values.T,
    ]
    return all(itertools.starmap(np.array_equal, zip(values, expected, strict=True)))


def test_page__decodes_the_same_integers(page, clip):
    assert all(decodes(page, position, clip[1][position]) for position in (0, 3, 1, 2))


def test_page__plays_a_stream_with_a_missing_frame(browser, clip, tmp_path):
    states = clip[1]
    packets = list(open_stream(clip[0]))
    # Frame 1 is lost; keyframes were re-emitted at frames 2 and 3.
    rest = [packets[0], reemitted_keyframe(states[2]), packets[3], reemitted_keyframe(states[3])]
    with StreamWriter(tmp_path / "stream.morgs", rig(WIDTH, HEIGHT), 10) as writer:
        for packet in rest:
            writer.write(packet)
    write_web_page(open_stream(tmp_path), tmp_path / "page.html")
    with Player(browser, tmp_path, "pause&frame=3") as page:
        assert page.text("#count") == "3 / 3"
        assert all(
            decodes(page, position, states[frame]) for position, frame in enumerate((0, 2, 3))
        )


# Motion is divided by alpha, so it depends on rounding where little is drawn. A camera that is off
# by a degree: 20 dB.
@pytest.mark.parametrize(("mode", "least"), [("color", 40), ("motion", 30), ("confidence", 40)])
def test_page__shows_the_images_of_the_renderer(page, clip, mode, least):
    folder, states = clip
    stream = open_stream(folder)
    page.evaluate(f"player.selectMode('{mode}')")
    for camera, frame in ((0, 0), (0, 3), (2, 2), (2, 1)):
        page.locator("#camera").select_option(str(camera))
        page.show(frame)
        scale = WIDTH * page.evaluate("player.motionScale")
        image = picture(stream, states[frame].gaussians, stream.cameras[camera], mode, scale)
        assert psnr(page.image() / 255, image / 255) > least


def test_page__plays_to_the_end_and_scrubs_back(page, clip):
    page.keyboard.press("l")
    page.keyboard.press(" ")
    page.wait(
        f"!player.playback.playing && player.playback.position === {FRAMES - 1} && player.settled"
    )
    played = page.image()
    page.locator("#slider").fill("1")
    page.wait("player.playback.position === 1 && player.settled")
    assert page.text("#count") == f"1 / {FRAMES - 1}"
    page.keyboard.press("End")
    page.wait(f"player.playback.position === {FRAMES - 1} && player.settled")
    # By residuals, one after the other, and by a jump: the same image.
    assert np.array_equal(page.image(), played)


def test_page__opens_on_the_first_frame_with_motion(browser, clip):
    with Player(browser, clip[0]) as page:
        assert page.text("#count") == f"1 / {FRAMES - 1}"
    with Player(browser, clip[0], "pause&frame=0&mode=motion") as page:
        assert page.text("#count") == f"0 / {FRAMES - 1}"
        assert "The first frame has no motion." in page.text("#legend")


# Sorting waits for `sortAll`.
HOLD_SORTING = """() => {
  const { sortWorker: worker } = player.splats.spark;
  const held = new Promise((resolve) => (window.sortAll = resolve));
  const call = worker.call.bind(worker);
  worker.call = (...request) => held.then(() => { worker.call = call; return call(...request); });
}"""


def test_page__draws_a_new_mode_when_its_values_arrive(browser, clip):
    with Player(browser, clip[0]) as page:
        page.show(3)
        colors = page.image()
        page.evaluate(HOLD_SORTING)
        page.evaluate("player.playback.seek(1)")
        page.wait("player.playback.position === 1")
        page.evaluate("player.selectMode('confidence')")
        page.wait_for_timeout(300)
        # The colours of frame 3 are displayed until the colours of frame 1 are sorted.
        assert psnr(page.image() / 255, colors / 255) > 40
        assert not page.locator("#legend").is_visible()
        page.evaluate("sortAll()")
        page.wait("player.settled")
        assert page.locator("#legend").is_visible()
        assert psnr(page.image() / 255, colors / 255) < 20


VIEW = ("camera.position", "controls.target")
# Whether ten frames leave the view where it is; the controls may round it to and fro forever.
AT_REST = """new Promise((resolve) => {
  const before = [...player.view.camera.matrixWorldInverse.elements];
  const look = (frames) => {
    if (frames > 0) return requestAnimationFrame(() => look(frames - 1));
    const now = player.view.camera.matrixWorldInverse.elements;
    resolve(player.settled && before.every((value, i) => Math.abs(value - now[i]) < 1e-6));
  };
  look(10);
})"""


def drag(page, pixels):
    """Return the angle in degrees from the view at rest after a drag to the nearest camera."""
    page.mouse.move(WIDTH / 2, HEIGHT / 2)
    page.mouse.down()
    page.mouse.move(WIDTH / 2 + pixels, HEIGHT / 2, steps=4)
    page.mouse.up()
    page.wait(AT_REST)
    position, target = (np.array(page.evaluate(f"player.view.{name}.toArray()")) for name in VIEW)
    unit = page.evaluate("player.view.unit")
    offset = position - target
    directions = unit * np.stack([camera.position for camera in rig()]) - target
    cosines = directions @ offset / np.linalg.norm(directions, axis=1) / np.linalg.norm(offset)
    return float(np.degrees(np.arccos(cosines.max())))


def test_page__draws_orbits_back_to_the_cameras_unless_it_is_switched_off(page):
    assert drag(page, -8) > 1  # 8 degrees are free
    page.keyboard.press("r")
    assert drag(page, -90) == pytest.approx(8, abs=0.2)
    page.keyboard.press("b")
    assert (
        page.get_by_label("Keep the view near the cameras").get_attribute("aria-pressed") == "false"
    )
    assert drag(page, -30) > 20
    page.get_by_label("Keep the view near the cameras").click()
    assert drag(page, 0) == pytest.approx(8, abs=0.2)


def test_page__says_once_what_to_expect_between_the_cameras(browser, clip, tmp_path):
    shutil.copy(clip[0] / "stream.morgs", tmp_path)
    validation = {"quality": "poor", "spacing": 58.2}
    write_json(tmp_path / "report.json", {"frames": [{"validation": validation}]})
    write_web_page(open_stream(tmp_path), tmp_path / "page.html")
    with Player(browser, tmp_path) as page:
        notes = page.locator("#notes")
        page.keyboard.press("c")  # another camera is no orbit
        page.wait("player.settled")
        assert not notes.is_visible()
        page.keyboard.press("Shift+ArrowRight")
        notes.get_by_text("Between the cameras: poor (58 degrees apart).").wait_for()
        notes.wait_for(state="hidden")
        page.keyboard.press("Shift+ArrowRight")
        page.wait_for_timeout(300)
        assert not notes.is_visible()


def test_page__fills_the_window_with_a_file_which_has_no_controls_of_a_clip(browser, tmp_path):
    write_ply(tmp_path / "scene.ply", splats(degree=3))
    stream = open_stream(tmp_path / "scene.ply")
    write_web_page(stream, tmp_path / "page.html")
    (state,) = coded_frames(stream)
    with Player(browser, tmp_path) as opened:
        fields = opened.evaluate(f"player.view.fields({WIDTH}, {HEIGHT})")
        camera = camera_of_fields(fields, "page")
        image = picture(stream, state.gaussians, camera)
        assert psnr(opened.image() / 255, image / 255) > 40
        bar = opened.locator("#bar").bounding_box()
        corners, _ = camera.project(box_corners(np.array(stream.metadata["box"])))
        left, top = corners.min(axis=0)
        right, bottom = corners.max(axis=0)
        assert min(left, top, WIDTH - right, bar["y"] - bottom) == pytest.approx(12, abs=0.1)
        assert (left + right, top + bottom) == pytest.approx((WIDTH, bar["y"]), abs=0.1)
        names = ("slider", "speed", "loop", "bound", "camera", "full")
        visible = [opened.locator(f"#{name}").is_visible() for name in names]
        assert visible == [False, False, False, False, True, True], "no controls of a clip"
        for key in (" ", "2", "3", "b", "l"):
            opened.keyboard.press(key)
        assert opened.evaluate(
            "[player.playback.playing, player.splats.mode, player.view.bounded]"
        ) == [False, "color", False]
        opened.keyboard.press("?")
        assert "colour, depth" in opened.text("#help")
        assert not re.search("play and pause|previous|repeat|near", opened.text("#help"))
        assert opened.errors == []


@pytest.mark.parametrize(
    ("kind", "width", "height"), [("clip", 640, 400), ("clip", 390, 844), ("file", 390, 844)]
)
def test_page__shows_the_poster_where_the_first_sorted_picture_will_be(
    browser, clip, tmp_path, kind, width, height
):
    size = {"width": width, "height": height}
    page_file = clip[0] / "page.html"
    if kind == "file":
        page_file = tmp_path / "page.html"
        write_ply(tmp_path / "scene.ply", splats(degree=3))
        write_web_page(open_stream(tmp_path / "scene.ply"), page_file)
    with Page(browser, f"{page_file.as_uri()}#pause", HOLD_FIRST_SORTING, viewport=size) as page:
        bar = page.locator("#bar").bounding_box()
        at = page.locator("#poster").bounding_box()
        page.wait("!!window.player && player.splats?.spark.sorting")
        page.wait_for_timeout(300)
        assert not page.locator("#canvas").is_visible()
        poster = page.image()
        page.evaluate("sortAll()")
        page.wait("player.settled")
        assert not page.locator("#poster").is_visible()
        place = page.evaluate("player.view.rectangle")
        assert [place[name] for name in at] == pytest.approx(list(at.values()), abs=3)
        assert page.locator("#bar").bounding_box() == bar
        left = max(0, round(at["x"]))
        top = max(0, round(at["y"]))
        rows = slice(top, round(at["y"] + at["height"]))
        columns = slice(left, max(left, round(at["x"] + at["width"])))
        shown = page.image()[rows, columns]
        assert psnr(poster[rows, columns] / 255, shown / 255) > 22  # it is JPEG, and resized
        assert not page.errors


def test_page__draws_orbits_back_as_fast_at_any_frame_rate(page):
    turned = """(parts) => {
      player.selectCamera(0);
      player.view.turn(0.5, 0);
      for (let i = 0; i < parts; i++) player.view.update(1 / 60 / parts);
      return player.view.camera.position.toArray();
    }"""
    once, often = (page.evaluate(turned, parts) for parts in (1, 4))
    assert once == pytest.approx(often, abs=1e-6)


def test_page__shows_an_hdr_stream_at_its_exposure(browser, clip, tmp_path):
    gaussians = clip[1][0].gaussians
    bright = replace(gaussians, sh_coeffs=gaussians.sh_coeffs + 1.2)
    metadata = {"transfer": {"name": TRANSFER, "display_exposure": -2}}
    with StreamWriter(tmp_path / "stream.morgs", rig(WIDTH, HEIGHT), 10, metadata) as writer:
        writer.write(keyframe_packet(bright, 0))
    stream = open_stream(tmp_path)
    write_web_page(stream, tmp_path / "page.html")
    color = render(next(play(stream))[1], stream.cameras[0], ("color",), render_config(stream))[
        "color"
    ]
    assert color.max() > 1.2
    with Player(browser, tmp_path) as page:
        for stops, key in ((-2, "]"), (-1.5, "[")):
            page.wait("player.settled")
            assert (
                psnr(page.image() / 255, channel_image("color", exposed(color, stops)) / 255) > 35
            )
            page.keyboard.press(key)
        assert page.errors == []


def test_page__is_operated_by_keyboard(page):
    press = page.keyboard.press
    press("ArrowRight")
    page.wait("player.playback.position === 1 && player.settled")
    press("2")
    page.wait("player.settled")
    percent = 100 * page.evaluate("player.motionScale")
    assert f"rim: {percent:.2g} % of the width" in page.text("#legend")
    press("3")
    page.wait("player.settled")
    assert "moving" in page.text("#legend")
    press("c")
    assert page.locator("#camera").input_value() == "1"
    press(">")
    assert page.locator("#speed").input_value() == "2"
    press("?")
    assert page.locator("#help").is_visible()
    press("Escape")
    assert not page.locator("#help").is_visible()


def test_page__fits_a_phone_and_is_operated_by_touch(browser, clip):
    phone = {"viewport": {"width": 390, "height": 780}, "has_touch": True, "is_mobile": True}
    with Player(browser, clip[0], "pause&frame=1&mode=motion", **phone) as page:
        assert page.text("#count") == f"1 / {FRAMES - 1}"
        page.get_by_text("Confidence", exact=True).first.tap()
        page.wait("player.settled")
        assert "moving" in page.text("#legend")
        for control in page.locator("#bar button, #bar select, #bar input").all():
            box = control.bounding_box()
            assert box is None or (
                box["x"] >= 0
                and box["x"] + box["width"] <= 390
                and min(box["width"], box["height"]) >= 44
            )
        assert not page.errors


def test_page__covers_an_upright_phone_around_what_moves(browser, clip):
    upright = {"viewport": {"width": 240, "height": 480}}
    with Player(browser, clip[0], **upright) as page:
        place = page.evaluate("player.view.rectangle")
        assert place["y"] == 0
        assert place["height"] == 480
        gaussians = clip[1][0].gaussians
        _, pixels, _ = seen_points(open_stream(clip[0]).cameras[0], np.asarray(gaussians.means))
        moving = pixels[np.asarray(gaussians.logit_confidence) > 0, 0]
        scale = 480 / HEIGHT
        assert abs(place["x"] + scale * np.median(moving) - 240 / 2) < 12 * scale
        assert not page.errors


def test_page__follows_the_address_and_shares_it(page):
    goto = "location.hash = '{}'"
    page.evaluate(goto.format("t=0.2&camera=right&mode=depth"))
    page.wait("player.playback.position === 2 && player.settled")
    assert page.locator("#camera").input_value() == "2"
    assert "Depth" in page.text("#legend")
    page.evaluate(goto.format("view=0,-3,1,0,0,0.2&mode=color"))
    page.wait(AT_REST)
    image = page.image()
    page.keyboard.press("u")
    page.get_by_text("The address of this view is copied.").wait_for()
    shared = page.url
    assert "t=0.20&camera=right&view=0,-3,1,0,0,0.2&pause" in shared
    page.keyboard.press("r")
    page.evaluate(goto.format(shared.partition("#")[2] + "&again"))
    page.wait(AT_REST)
    assert psnr(page.image() / 255, image / 255) > 50
    page.evaluate("history.replaceState(null, '', location.href.split('#')[0]); player.bound()")


def test_page__moves_by_keys_whatever_was_clicked(page):
    page.keyboard.press("b")
    page.get_by_text("Depth", exact=True).click()
    page.wait("player.settled")
    at = "player.view.place.position"
    start = np.array(page.evaluate(at))
    for key, is_moved in (("w", True), ("s", False), ("d", True), ("a", False)):
        page.keyboard.press(key)
        change = np.array(page.evaluate(at)) - start
        assert (np.linalg.norm(change) > 0.1) == is_moved
    page.keyboard.press(" ")  # not the button that was clicked
    page.wait("player.playback.playing")
    page.keyboard.press("b")


def test_page__orbits_around_what_is_double_clicked(page, clip):
    page.keyboard.press("b")
    camera = open_stream(clip[0]).cameras[0]
    gaussians = clip[1][0].gaussians
    opaque = np.asarray(gaussians.means)[np.asarray(gaussians.opacities) > 0.5]
    _, pixels, depths = seen_points(camera, opaque)
    nearest = int(np.argmin(np.where(pixels[:, 1] < 140, depths, np.inf)))  # above the controls
    page.mouse.dblclick(*pixels[nearest].tolist())
    target = page.evaluate("player.view.place.target")
    expected = opaque[nearest]
    assert np.linalg.norm(target - expected) < 0.1
    page.keyboard.press("b")


def test_page__shows_other_backgrounds(page):
    corners = []
    for _ in range(5):
        corners.append(page.image()[:2, :2].mean(axis=(0, 1)))
        page.get_by_label("Background").click()
        page.wait("player.settled")
    expected = ([51, 128, 204], [0, 0, 0], [128, 128, 128], [255, 255, 255])
    assert np.allclose(corners[:4], expected, atol=2)
    assert 100 < corners[4].mean() < 155


def test_page__saves_a_screenshot(page):
    with page.expect_download() as download:
        page.get_by_label("Screenshot").click()
    image = cv2.imread(str(download.value.path()), cv2.IMREAD_COLOR_RGB)
    assert psnr(image / 255, page.image() / 255) > 50


def test_page__shows_its_first_frame_without_webgl(browser, clip):
    script = "HTMLCanvasElement.prototype.getContext = () => null"
    page = Page(browser, (clip[0] / "page.html").as_uri(), script)
    page.get_by_text("This page needs WebGL 2, which this browser does not offer").wait_for()
    assert page.locator("#poster").is_visible()
    assert not page.locator("#bar").is_visible()
    page.context.close()


def test_page__names_what_is_no_stream(browser, clip, tmp_path):
    """The module names it in `test_module__refuses_what_it_cannot_play`."""
    write_web_folder(open_stream(clip[0]), tmp_path / "web")
    (tmp_path / "web/stream.morgs").write_bytes(b"something else")
    with served(tmp_path / "web") as address, Page(browser, f"{address}/index.html") as page:
        page.get_by_text("This page could not start: this is not a .morgs stream").wait_for()
