"""The header: types and ranges of every entry are checked, by readers and by writers."""

import base64
import json
import re
import resource
import struct
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.codec.container import header_fields, header_json, load_json
from morgs_mi.core.color_space import byte_values
from morgs_mi.platform.png import PngImage, jpeg_bytes, png_bytes
from morgs_mi.render.rasterize import rasterize
from tests.scenes.coded_clip import CAMERAS, cloud

SOUND = json.loads(header_json(CAMERAS, 25, {"seed": 1}))


SMALL = np.zeros((1, 2, 3), np.uint8)
FITTING = np.zeros((CAMERAS[0].height, CAMERAS[0].width, 3), np.uint8)


def encoded(image, write=png_bytes):
    return base64.b64encode(write(image)).decode()


def claiming(width, height):
    """Return the beginning of a PNG file in base64, which claims a size."""
    file = png_bytes(SMALL)[:33]
    return base64.b64encode(file[:16] + struct.pack(">II", width, height) + file[24:]).decode()


def with_entry(path, text):
    """Return the JSON of a header with one entry replaced, or removed if `text` is empty."""
    header = json.loads(json.dumps(SOUND))
    *parents, last = (int(part) if part.isdecimal() else part for part in path.split("."))
    node = header
    for part in parents:
        node = node[part]
    node[last] = "REPLACED"
    if not text:
        del node[last]
    return json.dumps(header).replace('"REPLACED"', text).encode()


@pytest.mark.parametrize(
    ("path", "text", "message"),
    [
        ("fps", "1e999", "numbers must be finite, got 1e999"),
        ("fps", "0", "`fps` must be a number from 1e-6 to 1e6, got 0"),
        ("fps", "1" + 400 * "0", "integers must have at most 64 bits, got 1000"),
        ("cameras", "[]", "`cameras` must be a list of at least one camera"),
        ("cameras.1", "7", r"`cameras\[1\].name` must be a string, got None"),
        ("cameras.0.K.0.0", "-1", "must be finite with positive focal lengths"),
        ("metadata.seed", f"[{'0,' * 2**20}0]", "at most 1048576 commas and opening brackets"),
        ("metadata.seed", "[" * 31 + "]" * 31, "nested at most 32 levels deep"),
        (
            "metadata.seed",
            f'"{"x" * 2**26}"',
            "the JSON is broken .it must have at most 67108864 bytes",
        ),
    ],
    ids=lambda value: value[:20],
)
def test_header_fields__refuse_other_types_and_ranges(path, text, message):
    with pytest.raises(ValueError, match=message):
        header_fields(with_entry(path, text))


@pytest.mark.parametrize(
    ("path", "text", "message"),
    [
        ("name", '"\\u001b[2J"', "` must have a printable `name`"),
        ("width", "32.5", ".width` must be an integer from 1 to 2^26, got 32.5"),
        ("height", "1000000", "` must have a printable `name`, at most 2^26 pixels"),
        ("near", "0", ".near` must be a number from 1e-12 to 1e12, got 0"),
        ("K.0.0", "1e300", "` must have a printable `name`, at most 2^26 pixels, and `K` [3][3]"),
        (
            "viewmat",
            "[1,2,3,4]",
            "` must have a printable `name`, at most 2^26 pixels, and `K` [3][3]",
        ),
        ("viewmat.2.1", "[1]", ": `matrix` must be an array of real numbers"),
        ("background", '"aGFs"', ".background` must be a PNG image of"),
        ("background", f'"{encoded(FITTING, jpeg_bytes)}"', ".background` must be a PNG image of"),
    ],
)
def test_header_fields__refuse_other_types_and_ranges_of_a_camera(path, text, message):
    with pytest.raises(ValueError, match=re.escape(f"cameras[0]{message}")):
        header_fields(with_entry(f"cameras.0.{path}", text))


def test_header__has_the_images_behind_the_gaussians():
    camera = CAMERAS[0]
    shape = (camera.height, camera.width, 3)
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    cameras = [replace(camera, background=image), camera]
    views, _, _ = header_fields(header_json(cameras, 25, {}).encode())
    assert_array_equal(byte_values(views[0].backdrop), image)
    assert views[1].backdrop is None
    text = header_json(views, 25, {})
    assert text == header_json(cameras, 25, {})
    again, _, _ = header_fields(text.encode())
    assert_array_equal(again[0].resized(80, 60).backdrop, cameras[0].resized(80, 60).backdrop)


def test_header__images_are_decoded_where_they_are_drawn():
    camera = CAMERAS[0]
    broken = claiming(camera.width, camera.height)
    (view, _), _, _ = header_fields(with_entry("cameras.0.background", f'"{broken}"'))
    with pytest.raises(ValueError, match=r"`background`: expected a PNG image, got a broken file"):
        rasterize(cloud(), view)


@pytest.mark.parametrize("length", [0x0FFFFFFF, 0xFFFFFFFF])
@pytest.mark.parametrize("name", [b"IDAT", b"tEXt"])
def test_png_image__takes_no_memory_for_chunks_that_are_not_there(length, name):
    file = png_bytes(FITTING)
    image = PngImage(file[:33] + struct.pack(">I", length) + name + file[33:])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="expected a PNG image, got a broken file"):
        image.pixels  # noqa: B018 (it decodes)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 100_000, "kB"
    assert_array_equal(PngImage(file + b"more").pixels, FITTING)


def test_header_fields__refuse_images_that_take_too_much_together():
    header = json.loads(json.dumps(SOUND))
    image = {"width": 8192, "height": 8192, "background": claiming(8192, 8192)}
    for count, size in ((1, 201), (2, 402)):
        header["cameras"] = count * [SOUND["cameras"][0] | image]
        with pytest.raises(
            ValueError, match=f"of {count} cameras must .* got claims of {size} MB;"
        ):
            header_fields(json.dumps(header).encode())


def test_load_json__accepts_what_is_within_its_limits():
    deep = b"[" * 32 + b"]" * 32
    assert load_json(deep, len(deep)) == json.loads(deep)
    assert load_json(b"[18446744073709551615, -9223372036854775808, 1e308]", 99) == [
        2**64 - 1,
        -(2**63),
        1e308,
    ]
