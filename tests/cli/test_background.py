"""Backgrounds of what the commands draw."""

import cv2
import numpy as np
import pytest

from morgs_mi.cli.main import main
from tests.scenes.changing_splats import write_stream


def rendered(tmp_path, background):
    folder = tmp_path / "png"
    assert main(["render", str(tmp_path), str(folder), "--camera", "0", *background]) == 0
    image = cv2.imread(str(folder / "0000.png"), cv2.IMREAD_UNCHANGED)
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    return image.astype(float)


def test_render__draws_backgrounds_and_straight_alpha(tmp_path):
    write_stream(tmp_path / "stream.morgs", 1)
    pink = rendered(tmp_path, ["--background", "#ff0080"])
    rgba = rendered(tmp_path, ["--background", "transparent"])
    alpha = rgba[..., 3:] / 255
    assert 0.1 < alpha.mean() < 0.9
    assert np.abs(rgba[..., :3] * alpha + (1 - alpha) * [128, 0, 255] - pink).max() < 2
    black = rendered(tmp_path, ["--background", "black"])
    assert np.array_equal(black, rendered(tmp_path, []))


@pytest.mark.parametrize(
    ("output", "background", "words"),
    [
        ("x-png", "pink", "--background must be black, grey, white or #rrggbb, got pink"),
        ("x.mp4", "transparent", "--background transparent is for the colour in PNG files"),
    ],
)
def test_render__refuses_backgrounds(tmp_path, capsys, output, background, words):
    write_stream(tmp_path / "stream.morgs", 1)
    command = ["render", str(tmp_path), str(tmp_path / output), "--background", background]
    assert main(command) == 1
    assert words in capsys.readouterr().err
