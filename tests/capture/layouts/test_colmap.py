"""COLMAP models: pycolmap reads what we write, and we read what pycolmap writes."""

import re
import tracemalloc

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import find_models, read_colmap, write_colmap
from morgs_mi.capture.lens import MODELS, Lens
from morgs_mi.testing import assert_close
from tests.platform.test_files import tree
from tests.scenes.captures import HEIGHT, WIDTH, rig, videos
from tests.scenes.full_disk import files_end_at

RNG = np.random.default_rng(1)
POINTS = RNG.normal(size=(7, 3))
COLORS = RNG.integers(0, 256, (7, 3)) / 255


def cameras():
    return rig(("cam00", "cam01", "cam02"), shift=3)


LENSES = [
    Lens(),
    Lens("OPENCV", (0.1, -0.02, 0.003, 0.004)),
    Lens("OPENCV_FISHEYE", (0.1, 0, 0, 0.01)),
]


def write(folder, kind="txt"):
    write_colmap(folder, list(map(CalibratedImage, cameras(), LENSES)), POINTS, COLORS)
    return as_binary(folder) if kind == "bin" else folder


def as_binary(folder):
    """Write a COLMAP model anew by pycolmap, as binary files."""
    model = pycolmap.Reconstruction(str(folder))
    for file in folder.iterdir():
        file.unlink()
    model.write_binary(str(folder))
    return folder


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_read_colmap__reads_what_write_colmap_writes(tmp_path, kind):
    model = read_colmap(write(tmp_path, kind))
    order = np.argsort([image.name for image in model.images])
    for i, expected, lens in zip(order, cameras(), LENSES, strict=True):
        camera = model.images[i].camera
        assert camera.name == f"{expected.name}.png"
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert_allclose(camera.K, expected.K, rtol=1e-12)
        assert_close(camera.viewmat, expected.viewmat, atol=1e-12)
        assert model.images[i].lens == lens
    assert model.points.dtype == np.float64
    rows = np.lexsort(model.points.T), np.lexsort(POINTS.T)
    assert_allclose(model.points[rows[0]], POINTS[rows[1]], rtol=1e-6)
    assert_close(model.point_colors[rows[0]], COLORS[rows[1]], atol=1e-6)


def test_read_colmap__projection_agrees_with_pycolmap(tmp_path):
    model = read_colmap(write(tmp_path))
    reference = pycolmap.Reconstruction(str(tmp_path))
    camera = model.images[0].camera
    image = next(i for i in reference.images.values() if i.name == camera.name)
    for point in POINTS * 0.2:
        assert_close(camera.project(point)[0], image.project_point(point), atol=1e-9)


def test_models__are_numbered_as_in_colmap():
    for i, name in enumerate(MODELS):
        # INVALID is -1 and not every later id is public; the first seven are fixed by the file
        # format.
        assert int(getattr(pycolmap.CameraModelId, name)) == i
        assert (
            len(pycolmap.Camera.create_from_model_name(1, name, 50.0, 64, 48).params)
            == sum(MODELS[name]) + 2
        )


def test_write_colmap__of_a_full_disk_leaves_the_model_before(tmp_path):
    points = RNG.normal(size=(100, 3))
    write_colmap(tmp_path / "new", cameras(), points)
    size = (tmp_path / "new" / "points3D.txt").stat().st_size
    old_files = tree(write(tmp_path / "sparse"))
    for limit in (0, 100, size // 2, size - 1):
        with (
            pytest.raises(OSError, match=r"write_colmap\(\): cannot write .*sparse/"),
            files_end_at(limit),
        ):
            write_colmap(tmp_path / "sparse", cameras(), points)
        assert tree(tmp_path / "sparse") == old_files
    with files_end_at(size):
        write_colmap(tmp_path / "sparse", cameras(), points)
    assert len(read_colmap(tmp_path / "sparse").points) == 100


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_read_colmap__refuses_every_truncation_of_a_binary_file(tmp_path, name):
    file = write(tmp_path, "bin") / name
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(
            ValueError, match=rf"{name}: expected \d+ more bytes at byte \d+, got \d+"
        ):
            read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "cameras.txt",
            " OPENCV ",
            " WHAT ",
            "cameras.txt: camera 2: the camera model must be one of",
        ),
        (
            "cameras.txt",
            " OPENCV ",
            " PINHOLE ",
            "camera 2: the camera model PINHOLE takes 4 parameters of at most .*, got 8",
        ),
        ("cameras.txt", f" {WIDTH} ", " wide ", "cameras.txt, line 2: expected `CAMERA_ID MODEL"),
        (
            "images.txt",
            " 2 cam01",
            " 9 cam01",
            r"'cam01.png': it refers to camera 9, of 1, 2, 3",
        ),
        ("cameras.txt", "-0.02", "nan", "camera 2: the camera model OPENCV takes 8 parameters of"),
        ("images.txt", "\n\n", "\n", "images.txt, line 3: expected `POINTS2D"),
        (
            "images.txt",
            r"\n1( \S+){4}",
            "\n1 1 0 0 1",
            "image 'cam00.png': its quaternion must have length 1",
        ),
        ("images.txt", r"\n1 \S+", "\n1 nan", "image 'cam00.png': its quaternion must have"),
        ("images.txt", r"\n1 \S+", "\n1 word", "images.txt, line 2: expected `IMAGE_ID"),
        ("points3D.txt", "\n1 ", "\n1 red ", "points3D.txt, line 2: expected `POINT3D_ID"),
    ],
)
def test_read_colmap__refuses_broken_text(tmp_path, file, old, new, message):
    path = write(tmp_path) / file
    text, count = re.subn(old, new, path.read_text())
    assert count
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_colmap(tmp_path)


def test_read_colmap__does_not_split_long_lines(tmp_path):
    (write(tmp_path) / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n" + "10 " * 2_000_002)
    tracemalloc.start()
    with pytest.raises(ValueError, match="expected `POINTS2D"):
        read_colmap(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 60e6, "10 times the 6 MB of the file"
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_read_colmap__refuses_a_binary_file_of_another_number_of_entries(tmp_path, name):
    file = write(tmp_path, "bin") / f"{name}.bin"
    whole = file.read_bytes()
    count = int.from_bytes(whole[:8], "little") - 1
    for number, message in (
        (count, rf"expected the {count} \w+ it announces, got \d+"),
        (2**63, r"expected \d+ more bytes"),
    ):
        file.write_bytes(number.to_bytes(8, "little") + whole[8:])
        with pytest.raises(ValueError, match=f"{name}.bin: {message}"):
            read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("names", "gap"), [((" cam1", "cam 2 ", "  cam3"), ""), (("a", "b"), "  ")]
)
def test_read_colmap__keeps_the_spaces_of_names_and_reads_aligned_columns(tmp_path, names, gap):
    write_colmap(tmp_path, rig(names))
    text = (tmp_path / "images.txt").read_text()
    for name in names if gap else ():
        text = text.replace(f" {name}.png", f" {gap}{name}.png")
    (tmp_path / "images.txt").write_text(text.replace("\n1 ", f"\n{gap}1 "))
    videos(tmp_path, names)
    assert set(load_capture(tmp_path).names) == set(names)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse"])
def test_find_models__takes_the_first_model_and_names_the_choice(tmp_path, caplog, place):
    names = ("cam1", "cam2", "cam3")
    for number, count in (("2", 2), ("10", 3), ("backup", 3)):
        write_colmap(tmp_path / place / number, rig(names)[:count])
    (tmp_path / place / "._1").touch()
    videos(tmp_path, names)
    assert load_capture(tmp_path).names == names[:2]
    assert f"{place}: the first of 2 models, 2, is used; if another has more" in caplog.text


def test_find_models__prefers_a_model_in_the_folder_to_others_beside_it(tmp_path):
    write_colmap(tmp_path / "sparse", rig(("cam1",)))
    write_colmap(tmp_path / "sparse/backup", rig(("cam1", "cam2")))
    assert find_models(tmp_path) == [tmp_path / "sparse"]
    assert find_models(tmp_path / "sparse") == [tmp_path / "sparse"]
