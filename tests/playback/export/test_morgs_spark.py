"""The module for pages with three.js and Spark, in the example of the documentation, in headless
Chromium.
"""

import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.evaluate.metrics import psnr
from morgs_mi.platform.bounded import read_json
from morgs_mi.playback.export.web import write_web_folder
from morgs_mi.playback.player import render
from morgs_mi.playback.stream_header import render_config
from morgs_mi.playback.streams import open_stream
from tests.playback.export.pages import Page, served
from tests.scenes.cameras import shift_principal_point
from tests.scenes.changing_splats import write_stream

ROOT = Path(__file__).parents[3]
MODULE = "morgs-spark.js"
FRAMES = 4

# Spark displays the values of the mesh's present version, in their order.
DISPLAYED = (
    "spark.current === spark.display && spark.current.mapping[0]?.version === splats.mesh.version"
)
DRAWN = f"!spark.sorting && !spark.sortDirty && {DISPLAYED}"
FAILURE = (
    "import('./morgs-spark.js').then((m) => m.MorgsSplats.load('{}')).then(() => null, (error) => "
    "error.message)"
)


def test_write_web_folder__contains_the_module_which_imports_only_three_and_spark(tmp_path):
    write_stream(tmp_path / "stream.morgs")
    size = write_web_folder(open_stream(tmp_path), tmp_path / "web")
    assert size == sum(path.stat().st_size for path in (tmp_path / "web").iterdir())
    packaged = files("morgs_mi.playback.export") / "web_player" / MODULE
    code = (tmp_path / "web" / MODULE).read_text(encoding="utf-8")
    assert code == packaged.read_text(encoding="utf-8")
    assert set(re.findall(r'import[^;"]*from"([^"]*)"', code)) == {"three", "@sparkjsdev/spark"}
    assert len(code) < 30_000


def example():
    """Return the page of the documentation with the installed packages, at a given time."""
    page = re.search(
        r"```html\n(.*?)```", (ROOT / "docs/web-player.md").read_text(encoding="utf-8"), re.DOTALL
    )
    lock = read_json(ROOT / "web/package-lock.json")["packages"]

    def local(address):
        folder = f"node_modules/{address[1]}"
        assert lock[folder]["version"] == address[2]
        return f"./{folder}"

    text = re.sub(r"https://cdn\.jsdelivr\.net/npm/(@?[\w/-]+)@([\d.]+)", local, page[1])
    variables = "Object.assign(window, { THREE, splats, spark, scene, camera, controls, time: 0 });"
    loop = "renderer.setAnimationLoop"
    assert text.count(loop) == text.count("milliseconds / 1000") == 1
    text = f'<link rel="icon" href="data:,">{text}'  # a missing one is an error in the log
    return text.replace("milliseconds / 1000", "window.time").replace(
        loop, f"{variables}\n  {loop}"
    )


@pytest.fixture(scope="module")
def site(clip, tmp_path_factory):
    """Return the folder of an exported clip, with the example, the packages and broken streams, and
    its address.
    """
    packages = ROOT / "web/node_modules"
    if not (packages / "three").exists():
        pytest.skip("three.js and Spark are not installed; run npm ci in web/")
    folder = tmp_path_factory.mktemp("spark") / "web"
    write_web_folder(open_stream(clip[0]), folder)
    (folder / "node_modules").symlink_to(packages)
    (folder / "scene.html").write_text(example(), encoding="utf-8")
    data = (folder / "stream.morgs").read_bytes()
    index = open_stream(folder).index()
    version = bytearray(data)
    late_bytes = bytearray(data)
    version[8] += 1
    late_bytes[index[2][2] + 100] ^= 1
    broken = {
        "page": b"something else",
        "version": version,
        "later": late_bytes,
        "cut": data[:-10],
    }
    for name, content in broken.items():
        (folder / f"{name}.morgs").write_bytes(content)
    with served(folder) as address:
        yield folder, address


class Scene(Page):
    """The example, paused."""

    def show(self, frame, camera=0):
        """Return the image of a frame from a camera."""
        self.evaluate(
            f"time = {frame} / splats.fps; controls.target.copy(splats.place(camera, {camera}))"
        )
        for _ in range(1000):
            self.image()  # makes a browser draw that has paused its animation
            if self.evaluate(f"splats.position === {frame} && {DRAWN}"):
                self.image()
                return self.image()
        raise AssertionError(f"frame {frame} is not drawn; {self.errors}")


@pytest.fixture(scope="module")
def opened(browser, site):
    with Scene(browser, f"{site[1]}/scene.html") as scene:
        scene.wait("!!window.splats")
        yield scene


@pytest.fixture
def scene(opened):
    """Return the page of the example, and check afterwards what it reported and requested."""
    yield opened
    assert not opened.errors
    origin = opened.url.removesuffix("scene.html")
    assert all(url.startswith((origin, "blob:", "data:")) for url in opened.requests)


def test_module__shows_the_images_of_the_renderer(scene, site, clip):
    """Also of a camera with a principal point off the centre."""
    cameras = [replace(camera, background=None) for camera in open_stream(site[0]).cameras]
    cameras[1] = shift_principal_point(cameras[1], 30, -20)
    scene.evaluate(f"splats.cameras[1].K = {cameras[1].K.tolist()}")
    config = render_config(open_stream(site[0]))
    for camera, frame in ((0, 0), (0, 3), (2, 1), (1, 1)):
        gaussians = clip[1][frame].gaussians
        expected = render(gaussians, cameras[camera], ("color",), config)["color"]
        assert psnr(scene.show(frame, camera) / 255, np.clip(expected, 0, 1)) > 40


def test_module__follows_the_mesh(scene):
    image = scene.show(1)
    scene.evaluate(
        "splats.mesh.position.set(3, 1, -2); splats.mesh.rotateY(1); "
        "splats.mesh.scale.setScalar(0.5)"
    )
    moved_image = scene.show(1)
    scene.evaluate(
        "splats.mesh.position.set(0, 0, 0); splats.mesh.rotateY(-1); splats.mesh.scale.setScalar(1)"
    )
    assert psnr(moved_image / 255, image / 255) > 40


@pytest.mark.parametrize(("seconds", "frame"), [(0.15, 1), (-0.1, 3), (1.25, 0)])
def test_module__repeats(scene, seconds, frame):
    scene.evaluate(f"time = {seconds}; splats.update(time)")
    scene.wait(f"splats.position === {frame}")


def test_module__refuses_what_it_cannot_play(browser, site):
    with Scene(browser, f"{site[1]}/scene.html") as scene:
        for name, reason in (
            ("page", "this is not a .morgs stream"),
            ("version", "expected format version 2, found 3"),
            ("missing", "cannot be read: 404"),
        ):
            message = scene.evaluate(FAILURE.format(f"{name}.morgs"))
            assert message.startswith(f"{name}.morgs")
            assert reason in message


@pytest.mark.parametrize(
    ("name", "last", "reason"),
    [("later", 1, "frame 2: the packet at byte"), ("cut", 2, "truncated or damaged")],
)
def test_module__plays_the_frames_before_the_damage(scene, name, last, reason):
    load = f"import('./morgs-spark.js').then((module) => module.MorgsSplats.load('{name}.morgs'))"
    scene.evaluate(f"{load}.then((splats) => void (window.damaged = splats))")
    scene.evaluate(f"damaged.update({last} / damaged.fps)")
    scene.wait(f"damaged.position === {last}")
    scene.evaluate(f"damaged.update({last + 1} / damaged.fps)")
    scene.wait("damaged.damage !== null")
    assert reason in scene.evaluate("damaged.damage")
    scene.evaluate("damaged.update(0)")
    scene.wait("damaged.position === 0")
    scene.evaluate("damaged.dispose()")
