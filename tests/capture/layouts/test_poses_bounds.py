"""The axes of poses_bounds.npy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.layouts.poses_bounds import read_poses_bounds
from morgs_mi.core.camera import Camera
from morgs_mi.testing import assert_close
from tests.scenes.captures import write_poses_bounds


def cameras():
    return [
        Camera.look_at((3, 1, 2), (0, 0, 0), (0, 0, 1), 50, 64, 48, "cam00"),
        Camera.look_at((-2, 1, 1), (0, 0.5, 0), (0, 0, 1), 70, 60, 50, "cam01"),
    ]


def test_read_poses_bounds__columns_are_down_right_back(tmp_path):
    # A camera at (5, 6, 7) that looks along world +y with world +x to its right: down is -z, back
    # is -y.
    pose = [[0, 1, 0, 5, 48], [0, 0, -1, 6, 64], [-1, 0, 0, 7, 100]]
    np.save(tmp_path / "p.npy", [[*np.ravel(pose).astype(float), 1.0, 2.0]])
    (camera,) = read_poses_bounds(tmp_path / "p.npy", ["cam"])
    assert_allclose(camera.position, (5, 6, 7))
    local = camera.viewmat @ [5 + 1, 6 + 10, 7 + 2, 1]
    assert_close(local[:3], (1, -2, 10), atol=1e-12)
    assert (camera.width, camera.height, camera.K[0, 0]) == (64, 48, 100)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda rows: np.where(np.arange(17) == 3, np.nan, rows),
            r"row 0 \(cam00\): .*: the pose must be finite",
        ),
        (
            lambda rows: np.where(np.arange(17) == 3, 1e308, rows),
            r"row 0 \(cam00\): .*: the pose must be finite",
        ),
        (
            lambda rows: np.where(np.arange(17) % 5, rows, -rows),
            r"row 0 \(cam00\): columns in the order down, right, back: the axes must be a "
            r"right-handed",
        ),
        (
            lambda rows: np.where(np.arange(17) == 14, 0, rows),
            r"row 0 \(cam00\): .* positive focal lengths",
        ),
        (lambda rows: rows[:1], r"got 1 rows for 2 videos \(cam00, cam01\)"),
        (lambda rows: rows[:, :16], r"expected a float array \[C, 17\], got float64 \(2, 16\)"),
        (lambda rows: rows.astype(object), "got a broken file"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_read_poses_bounds__refuses_bad_files(tmp_path, change, message):
    path = tmp_path / "poses_bounds.npy"
    write_poses_bounds(path, cameras())
    np.save(path, change(np.load(path)))
    with pytest.raises(ValueError, match=message):
        read_poses_bounds(path, ["cam00", "cam01"])
