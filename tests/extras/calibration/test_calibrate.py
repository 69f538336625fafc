"""Calibration from clips alone, up to the scale of the world, and errors for unsuitable clips."""

import dataclasses
import re
import shutil
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import read_colmap, write_colmap
from morgs_mi.capture.points import match_capture
from morgs_mi.cli.main import main
from morgs_mi.extras.calibration.calibrate import (
    _DATABASE,
    CalibrateConfig,
    Candidate,
    _check,
    _frames,
    calibrate,
    map_views,
    match_views,
)
from morgs_mi.extras.calibration.checks.rig_check import CameraCheck, check_rig
from morgs_mi.io.video_writer import write_video
from morgs_mi.testing import assert_close
from tests.scenes import textured
from tests.scenes.captures import write_timed_video
from tests.scenes.full_disk import files_end_at


def film(path, cameras, suffix=".mkv"):
    planes = textured.textures()
    for camera in cameras:
        write_video(path / f"{camera.name}{suffix}", [textured.render(camera, planes)] * 2, 30)
    return path


def noise(seed, width, height):
    """Return an image of smooth noise."""
    grains = np.random.default_rng(seed).integers(0, 255, (height // 2, width // 2, 3), np.uint8)
    return cv2.resize(grains, (width, height), interpolation=cv2.INTER_CUBIC)


def aligned(estimate, true):
    """Return `estimate` [n, 3] aligned to `true` by translation, rotation and scale, and the
    rotation.
    """
    a = estimate - estimate.mean(0)
    b = true - true.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ Vt).T
    return np.sqrt((b**2).sum() / (a**2).sum()) * a @ R.T + true.mean(0), R


@pytest.mark.slow
def test_calibrate__recovers_a_rig(tmp_path, capsys):
    cameras = textured.rig(6, 240, 180)
    film(tmp_path, cameras)
    assert main(["calibrate", str(tmp_path), "--shared-intrinsics"]) == 0
    assert "sparse/0: 6 cameras, " in capsys.readouterr().out
    capture = load_capture(tmp_path)
    assert capture.names == tuple(camera.name for camera in cameras)
    assert len(capture.points) > 500
    true = np.array([camera.position for camera in cameras])
    positions, R = aligned(np.array([camera.position for camera in capture.cameras]), true)
    # Features are accurate to 0.1 px of 208 px focal length; the rig is 2.8 wide and 4 from the
    # scene.
    assert_close(positions, true, atol=5e-3)
    for camera, expected in zip(capture.cameras, cameras, strict=True):
        assert_close(camera.viewmat[:3, :3] @ R.T, expected.viewmat[:3, :3], atol=3e-3)
        assert_allclose(camera.K[0, 0], expected.K[0, 0], rtol=5e-3)
    assert check_rig(capture, match_capture(capture)).fits
    status = main(["calibrate", str(tmp_path)])
    assert status == 1
    assert "sparse: expected no model, got one" in capsys.readouterr().err


@pytest.mark.slow
def test_calibrate__finds_the_same_poses_on_every_run(tmp_path):
    film(tmp_path, textured.rig(6, 240, 180))
    config = CalibrateConfig(shared_intrinsics=True)
    images, _ = _frames(tmp_path, config, ())
    (scratch := tmp_path / "scratch").mkdir()
    match_views(tmp_path, images, {}, scratch, config, lambda *_: None)
    with closing(pycolmap.Database.open(scratch / _DATABASE)) as db:
        numbered = sorted((image.image_id, Path(image.name).stem) for image in db.read_all_images())
    assert [name for _, name in numbered] == list(images), (
        "other numbers change the world's axes by 0.1"
    )
    poses = []
    for _ in range(3):
        model = map_views(tmp_path, tuple(images), scratch, config.seed).model
        poses.append(np.array([model.image(i).cam_from_world().matrix() for i, _ in numbered]))
    assert not np.ptp(poses, axis=0).any(), "threads may find a pose from other samples"


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [("a.JPG", "b.JPG", "c.JPG", "d.JPG"), (" a.tif", "b .webp", " c d .BMP", "e.TIFF")],
    ids=["JPEG", "spaces and other formats"],
)
def test_calibrate__names_images_after_photos(tmp_path, names):
    planes = textured.textures()
    for name, camera in zip(names, textured.rig(4, 240, 180), strict=True):
        image = textured.render(camera, planes)[..., ::-1]
        options = [cv2.IMWRITE_JPEG_QUALITY, 98] if name.endswith("JPG") else []
        (tmp_path / name).write_bytes(
            cv2.imencode(Path(name).suffix.lower(), image, options)[1].tobytes()
        )
        (tmp_path / f"._{name}").write_bytes(b"\0\5\x16\7")
    result = calibrate(tmp_path, CalibrateConfig(shared_intrinsics=True))
    assert {image.name for image in read_colmap(result.model).images} == set(names)
    assert load_capture(tmp_path).names == result.cameras


@pytest.mark.slow
def test_calibrate__shares_intrinsics_among_clips_of_a_size(tmp_path):
    sizes = [(240, 180), (320, 240)] * 3
    cameras = [camera.resized(*size) for camera, size in zip(textured.rig(), sizes, strict=True)]
    result = calibrate(film(tmp_path, cameras), CalibrateConfig(shared_intrinsics=True))
    assert len(pycolmap.Reconstruction(str(result.model)).cameras) == 2
    capture = load_capture(tmp_path)
    assert [view.recorded_size for view in capture.views] == list(sizes)
    for camera, expected in zip(capture.cameras, cameras, strict=True):
        assert_allclose(camera.K[0, 0], expected.K[0, 0], rtol=5e-3)


@pytest.mark.slow
def test_calibrate__moves_principal_points_that_differ(tmp_path, capsys):
    cameras = textured.rig(6, 240, 180)
    for camera, shift in zip(cameras, np.random.default_rng(0).uniform(-6, 6, (6, 2)), strict=True):
        camera.K[:2, 2] += shift
    film(tmp_path, cameras)
    assert main(["calibrate", str(tmp_path), "--shared-intrinsics"]) == 0
    assert "with a principal point for each" in " ".join(capsys.readouterr().out.split())
    positions, true = (
        np.array([c.position for c in views]) for views in (load_capture(tmp_path).cameras, cameras)
    )
    # With principal points in the middle of the images, positions are off by 0.022.
    assert_close(aligned(positions, true)[0], true, atol=0.012)


@pytest.mark.slow
def test_calibrate__takes_global_mapping_where_incremental_mapping_fails(
    tmp_path, monkeypatch, capsys
):
    film(tmp_path, textured.rig(6, 240, 180))
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_: {})
    assert main(["calibrate", str(tmp_path), "--shared-intrinsics"]) == 0
    assert re.search(r"6 cameras, .* by\s+global\s+mapping", capsys.readouterr().out)
    monkeypatch.setattr(pycolmap, "global_mapping", lambda *_: {})
    with pytest.raises(
        ValueError, match="neither incremental nor global mapping by COLMAP found poses"
    ):
        calibrate(tmp_path, overwrite=True)


def test_candidate__ranks_fitting_cameras_then_poses_then_the_error():
    def rank(error, *fits):
        model = SimpleNamespace(compute_mean_reprojection_error=lambda: error)
        return Candidate(
            "global", model, tuple(CameraCheck("", 0, 0.0, each) for each in fits)
        ).rank

    ordered = [
        rank(0.1, True, None, None),
        rank(0.9, True, False, None),
        rank(0.3, True, True, None),
        rank(0.2, True, True, None),
        rank(0.9, True, True, True),
    ]
    assert ordered == sorted(ordered)


@pytest.mark.filterwarnings("error")
def test_check__of_a_camera_without_points_does_not_fit():
    check = _check("a", pycolmap.Image(), pycolmap.Reconstruction())
    assert (check.matches, check.fits) == (0, False)
    assert np.isnan(check.error)


@pytest.mark.slow
def test_calibrate__names_a_camera_with_another_scene(tmp_path):
    film(tmp_path, textured.rig(6, 240, 180)[1:5])
    write_video(tmp_path / "other.mkv", [noise(1, 240, 180)] * 2, 30)
    with pytest.raises(
        ValueError,
        match=r"to register all 5 cameras, got 4, without other; .* or accept the partial model",
    ):
        calibrate(tmp_path)
    assert not (tmp_path / "sparse").exists()
    with pytest.raises(
        ValueError, match="`without` must name cameras of cam1, cam2, cam3, cam4, other, got cam7"
    ):
        calibrate(tmp_path, without=["cam7"])
    assert calibrate(tmp_path, without=["other"]).cameras == ("cam1", "cam2", "cam3", "cam4")
    result = calibrate(tmp_path, CalibrateConfig(partial=True), overwrite=True)
    assert (result.cameras, result.left_out) == (("cam1", "cam2", "cam3", "cam4"), ("other",))
    assert result.error < 0.5
    assert load_capture(tmp_path).names == result.cameras


@pytest.mark.slow
def test_calibrate__prints_a_verdict_per_camera(tmp_path, capsys):
    cameras = textured.rig(4, 240, 180)
    film(tmp_path, cameras)
    write_video(tmp_path / "other.mkv", [noise(1, 240, 180)] * 2, 30)
    assert main(["calibrate", str(tmp_path), "--shared-intrinsics", "--partial"]) == 0
    printed = capsys.readouterr()
    rows = {name: rest for name, rest in re.findall(r"^ (\w+)  +(.*)$", printed.out, re.MULTILINE)}
    assert re.match(r"\d{3} +0\.\d\d +fits", rows["cam0"])
    assert re.match(r"0 +- +not checked", rows["other"])
    assert "other not checked: it could not be registered and has no pose" in printed.err


def test_calibrate__of_a_full_disk_leaves_no_model(tmp_path, monkeypatch):
    write_colmap(tmp_path / "found", textured.rig(4), np.random.default_rng(0).normal(size=(60, 3)))
    model = pycolmap.Reconstruction(str(tmp_path / "found"))
    clips = film(tmp_path / "clips", textured.rig(4))
    checks = tuple(CameraCheck(camera.name, 60, 0.1, True) for camera in textured.rig(4))
    monkeypatch.setattr("morgs_mi.extras.calibration.calibrate.match_views", lambda *_: None)
    monkeypatch.setattr(
        "morgs_mi.extras.calibration.calibrate.map_views",
        lambda *_: Candidate("incremental", model, checks),
    )
    size = (tmp_path / "found" / "points3D.txt").stat().st_size
    with (
        pytest.raises(OSError, match=r"cannot write .*sparse: "),
        files_end_at(size - 1),
    ):
        calibrate(clips)
    assert not (clips / "sparse").exists()


def test_calibrate__finds_no_features_in_transparent_pixels(tmp_path):
    planes = textured.textures()
    for camera in textured.rig(2, 240, 180):
        image = cv2.cvtColor(textured.render(camera, planes), cv2.COLOR_RGB2BGRA)
        image[:, 10:, 3] = 0
        (tmp_path / camera.name).mkdir()
        cv2.imwrite(str(tmp_path / camera.name / "0000.png"), image)
    with pytest.raises(
        ValueError, match=r"expected at least 100 features in every view, got \d\d? in cam"
    ):
        calibrate(tmp_path)


def test_frames__take_white_from_the_settings(tmp_path):
    """Images of 16 bits by cameras of 12."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        image = np.full((32, 48, 3), 4095, np.uint16)
        cv2.imwrite(str(tmp_path / name / "0000.png"), image)
    (tmp_path / "capture.json").write_text('{"white": 4095}')
    images, _ = _frames(tmp_path, CalibrateConfig(), ())
    assert {name: image.max() for name, image in images.items()} == {"a": 255, "b": 255}


def test_frames__are_the_nearest_in_time_at_a_variable_frame_rate(tmp_path):
    for name, times in (("a", [0, 50, 100, 150, 200, 250, 300]), ("b", [0, 50, 100, 250, 300])):
        write_timed_video(
            tmp_path / f"{name}.mp4", [np.full((48, 64, 3), t // 2, np.uint8) for t in times], times
        )
    images, _ = _frames(tmp_path, CalibrateConfig(frame=5), ())
    assert_close(images["b"].astype(float), images["a"], atol=2)
    with pytest.raises(ValueError, match="frame 7 is not in the clips of a, b"):
        calibrate(tmp_path, CalibrateConfig(frame=7))


@pytest.mark.parametrize(
    ("change", "config", "error", "message"),
    [
        (shutil.rmtree, {}, FileNotFoundError, "expected a folder of clips, found none"),
        (
            lambda path: [clip.unlink() for clip in path.iterdir()],
            {},
            ValueError,
            "the clips of at least two cameras, found none",
        ),
        (
            lambda path: (path / "a.mkv").rename(path / "a\n.mkv"),
            {},
            ValueError,
            r"names without line feeds, .* got 'a\\n'; rename it",
        ),
        (
            lambda path: (path / "c.mkv").write_bytes(b""),
            {},
            ValueError,
            "c.mkv: expected a video, got 0 bytes",
        ),
        (
            lambda path: (path / "sparse").mkdir(),
            {},
            FileExistsError,
            "sparse: expected no model, got one",
        ),
        (
            lambda path: write_video(path / "b.mkv", [np.full((120, 160, 3), 90, np.uint8)], 30),
            {},
            ValueError,
            "at least 100 features in every view, got 0 in b: too dark",
        ),
        (lambda path: None, {}, ValueError, "no two of the 3 views match"),
        (
            lambda path: None,
            {"camera_model": "PIN"},
            ValueError,
            r"calibrate\(\): `camera_model` must be one of SIMPLE_PINHOLE, PINHOLE, .*'PIN'",
        ),
        (
            lambda path: None,
            {"seed": 10**23},
            ValueError,
            f"`seed` must be .*, at least 0 and below 2147483648, got {10**23}",
        ),
    ],
)
def test_calibrate__refuses_clips_that_cannot_be_calibrated(
    tmp_path, change, config, error, message
):
    path = tmp_path / "clips"
    for name in ("a", "b", "c"):
        write_video(path / f"{name}.mkv", [noise(ord(name), 160, 120)], 30)
    change(path)
    old_files = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=message):
        calibrate(path, dataclasses.replace(CalibrateConfig(), **config))
    assert sorted(tmp_path.rglob("*")) == old_files


def test_calibrate__describes_the_folders_that_a_photo_lacks(tmp_path):
    cv2.imwrite(str(tmp_path / "IMG_1.png"), noise(0, 64, 48))
    with pytest.raises(
        ValueError, match=r"at least two cameras, found IMG_1; .* one folder per camera: cam01/"
    ):
        calibrate(tmp_path)
