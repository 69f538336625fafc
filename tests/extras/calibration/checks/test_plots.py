"""The plot of the rig."""

import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from morgs_mi.core.camera import Camera
from morgs_mi.extras.calibration.checks.plots import draw_rig, write_rig
from morgs_mi.platform.plots import check_plot
from morgs_mi.testing import assert_close
from tests.scenes.cameras import arc, look_at_cameras


def test_draw_rig__draws_cameras_at_their_positions():
    """Seen from above, ahead of the cameras is up; distant points are cut off."""
    cameras = [
        Camera.look_at((x, 0, 0), (x, 0, 5), (0, -1, 0), 60, 64, 48, f"{x:g}")
        for x in (-1.0, 0.0, 1.0)
    ]
    figure = Figure()
    draw_rig(figure, cameras, (np.array([[0.0, 0, 3], [1e6, 0, 0]]), np.ones((2, 3))))
    above = figure.axes[0]
    assert [name.get_text() for name in above.texts[:3]] == ["-1", "0", "1"]
    assert_close([name.xy for name in above.texts[:3]], [(-1, 0), (0, 0), (1, 0)], atol=1e-6)
    assert_close(np.asarray(above.collections[0].get_offsets()), [(0, 3)], atol=1e-6)


def test_draw_rig__names_cameras_behind_them_and_apart():
    cameras = look_at_cameras(arc(np.linspace(-0.2, 0.2, 16), 4))
    figure = Figure(figsize=(14.4, 7.6), layout="constrained")
    draw_rig(figure, cameras, (np.zeros((0, 3)), np.zeros((0, 3))), (5,))
    FigureCanvasAgg(figure).draw()
    above, _ = figure.axes
    names = above.texts[:16]
    assert all(name.get_position()[1] < name.xy[1] for name in names)
    boxes = [Text.get_window_extent(name) for name in names]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    legend = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert legend == ["camera", "held-out camera"]


def test_write_rig__has_the_first_image_of_each_camera(textured_capture, tmp_path):
    write_rig(tmp_path / "rig.svg", textured_capture)
    images = (tmp_path / "rig.svg").read_text().count("<image")
    assert images == len(textured_capture.cameras)


@pytest.mark.filterwarnings("error")
def test_write_rig__writes_vector_graphics_with_any_names(textured_capture, tmp_path):
    name = "$\\frac$ カメラ"
    cameras = tuple(replace(camera, name=name) for camera in textured_capture.cameras)
    write_rig(tmp_path / "new" / "rig.svg", textured_capture.with_cameras(cameras))
    assert "<svg" in (tmp_path / "new" / "rig.svg").read_text()


def test_check_plot__names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(
        ValueError, match=r"rig.png: a plot needs .* matplotlib; pip install 'morgs-mi\[plots\]'"
    ):
        check_plot(tmp_path / "rig.png")
