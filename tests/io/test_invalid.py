"""Invalid Gaussians of files: which and how many are named, and none reaches a renderer."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.invalid import without_invalid
from morgs_mi.io.ply import write_ply
from morgs_mi.io.splats import read_splats
from tests.scenes.changing_splats import splats

N = 40
KINDS = {
    "means": "centre",
    "log_scales": "size",
    "quats": "rotation",
    "logit_opacities": "opacity",
    "sh_coeffs": "colour",
}


def broken(name: str, value: float, rows: list[int]) -> Gaussians:
    """Return splats with a number in one attribute of some rows."""
    values = splats(N).numpy()[name]
    values.reshape(N, -1)[rows, -1] = value
    return replace(splats(N), **{name: values})


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("name", KINDS)
def test_without_invalid__names_the_attribute_the_count_and_the_first(name, value):
    gaussians = broken(name, value, [3, 5, 8, 9, 30])
    message = (
        rf"f.ply: expected .* in 5 of 40 Gaussians \({KINDS[name]} of 3, 5, 8 and 2 more\); leave "
        r"them out"
    )
    with pytest.raises(ValueError, match=message):
        without_invalid("f.ply", gaussians, 0.1)


@pytest.mark.parametrize("name", KINDS)
def test_without_invalid__leaves_them_out_with_a_warning(name, caplog):
    with caplog.at_level(logging.WARNING):
        rest = without_invalid("f.ply", broken(name, np.nan, [3, 5]), 0.5)
    expected = splats(N).select(np.setdiff1d(np.arange(N), [3, 5]))
    for key, values in expected.numpy().items():
        np.testing.assert_array_equal(rest.numpy()[key], values)
    (record,) = caplog.records
    assert f"{KINDS[name]} of 3, 5" in record.getMessage()


def test_without_invalid__returns_sound_gaussians_as_they_are(caplog):
    gaussians = splats(N)
    assert without_invalid("f.ply", gaussians, 0) is gaussians
    assert without_invalid("f.ply", splats(0), 0) is not None
    assert not caplog.records


def test_without_invalid__names_rotations_of_zero(caplog):
    quats = splats(N).numpy()["quats"]
    quats[7] = 0
    assert len(without_invalid("f.ply", replace(splats(N), quats=quats), 0)) == N
    assert "f.ply: 1 of 40 Gaussians have a rotation of 0 and are not rotated: 7." in caplog.text


def test_without_invalid__names_centres_that_are_rounded(caplog):
    means = splats(N).numpy()["means"] + np.float32(5.3e6)
    without_invalid("f.ply", replace(splats(N), means=means), 0)
    assert (
        "f.ply: the centres, around (5.3e+06, 5.3e+06, 5.3e+06), are so far from 0" in caplog.text
    )


def test_read_splats__accepts_sizes_of_zero_and_opacities_of_one(tmp_path, caplog):
    raw = splats(N).numpy()
    raw["log_scales"][0] = -np.inf
    raw["log_scales"][1] = -1e30
    raw["logit_opacities"][:2] = np.inf, -np.inf
    write_ply(tmp_path / "f.ply", Gaussians(**raw))
    assert len(read_splats(tmp_path / "f.ply")) == N
    assert not caplog.records
