"""Invalid Gaussians of files: which and how many are named, and none reaches a renderer."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.io.splats import without_invalid
from tests.scenes.changing_splats import splats

N = 40
KINDS = {
    "means": "centre",
    "log_scales": "size",
    "quats": "rotation",
    "logit_opacities": "opacity",
    "sh_coeffs": "colour",
}


def broken(name, value, rows):
    """Return splats with a number in one attribute of some rows."""
    values = splats(N).numpy()[name]
    values.reshape(N, -1)[rows, -1] = value
    return replace(splats(N), **{name: values})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", np.nan),
        ("log_scales", 1e30),
        ("quats", np.inf),
        ("quats", np.uint32(0x7FA00000).view(np.float32)),  # a NaN that signals
        ("logit_opacities", np.nan),
        ("sh_coeffs", np.inf),
    ],
)
def test_without_invalid__names_what_is_invalid_and_leaves_it_out_with_a_warning(
    name, value, caplog
):
    rows = [3, 5, 8, 9, 30]
    gaussians = broken(name, value, rows)
    kind = rf"in 5 of 40 Gaussians \({KINDS[name]} of 3, 5, 8 and 2 more\)"
    with pytest.raises(ValueError, match=rf"f.ply: expected .* {kind}; leave them out"):
        without_invalid("f.ply", gaussians, 0.1)
    rest = without_invalid("f.ply", gaussians, 0.5)
    expected = splats(N).select(np.setdiff1d(np.arange(N), rows))
    for key, values in expected.numpy().items():
        assert_array_equal(rest.numpy()[key], values)
    (record,) = caplog.records
    assert f"{KINDS[name]} of 3, 5" in record.getMessage()


def test_without_invalid__returns_sound_gaussians_as_they_are(caplog):
    gaussians = splats(N)
    assert without_invalid("f.ply", gaussians, 0) is gaussians
    assert without_invalid("f.ply", splats(0), 0) is not None
    assert not caplog.records
