"""Copies of NumPy memory for Dr.Jit: types and alignment. Memory that is free."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import Camera, FitConfig, StreamConfig, StreamLoop, rasterize
from morgs_mi.core.arrays import from_numpy, owned_copy
from morgs_mi.platform.memory import check_memory, release_memory
from tests.quick import quick
from tests.scenes.changing_splats import rig, splats


@pytest.mark.parametrize("kind", ["Float", "UInt32", "TensorXf"])
def test_from_numpy__converts_to_the_type_in_aligned_memory(kind):
    kind = getattr(mi, kind)
    values = np.arange(12.0).reshape(3, 4)
    array = np.asarray(from_numpy(kind, values))
    expected = values if dr.is_tensor_v(kind) else values.ravel()
    assert_array_equal(array, expected.astype(array.dtype))
    assert array.__array_interface__["data"][0] % 64 == 0


def test_owned_copy__is_aligned():
    borrowed = mi.Float(np.arange(1001, dtype=np.float32)[1:])
    copy = np.asarray(owned_copy(borrowed))
    assert np.array_equal(copy, np.arange(1, 1001))
    assert copy.__array_interface__["data"][0] % 64 == 0


def test_from_numpy__is_refused_under_freeze():
    frozen = dr.freeze(lambda x: x + from_numpy(mi.Float, np.ones(4)))
    with pytest.raises(RuntimeError) as error:
        frozen(dr.arange(mi.Float, 4))
    assert "expected a call outside dr.freeze" in str(error.value.__cause__)


def test_push__returns_the_buffers_of_frames_that_changed_more():
    """After two still ones; a single one keeps them, because videos repeat frames."""
    loop = StreamLoop(rig()[:2], (), (), quick())
    rng = np.random.default_rng(0)
    shape = rig()[0].height, rig()[0].width, 3
    first, *others = rng.integers(0, 256, (4, *shape), np.uint8)

    def watermark():
        dr.detail.malloc_clear_statistics()
        return dr.detail.malloc_watermark(dr.JitBackend.LLVM)

    release_memory()
    others_use = watermark()  # in other tests of this process
    allocated = []
    for image in (first, *others, others[-1], others[0], *[others[-1]] * 3):
        loop.push([image, image])
        allocated.append(watermark() - others_use)
    changed, single, again, two = (allocated[k] for k in (3, 4, 6, 8))
    assert (single, two < 0.5 * again) == (changed, True), allocated


def test_check_memory__names_what_is_needed_and_free(monkeypatch):
    monkeypatch.setattr("morgs_mi.platform.memory.free_memory", lambda: 2e9)
    check_memory("f()", 1.9e9, "an image", "make it smaller")
    with pytest.raises(
        ValueError,
        match=r"^f\(\): expected what fits in the 2\.0 GB of free .*, got an image, which",
    ):
        check_memory("f()", 2.1e9, "an image", "make it smaller")


def wide(width):
    return Camera.look_at((0, 0, -5), (0, 0, 0), (0, -1, 0), 40, width, width)


DOORS = {
    "image": (lambda: rasterize(splats(), wide(16000)), "1 x 16000x16000 pixels"),
    "gaussians": (
        lambda: StreamLoop([wide(8)], (), (), StreamConfig(fit=FitConfig(num_gaussians=10**9))),
        "`num_gaussians=1000000000`",
    ),
    "steps": (
        lambda: StreamLoop([wide(8)], (), (), StreamConfig(fit=FitConfig(first_frame_steps=10**9))),
        "`first_frame_steps=1000000000`",
    ),
    "views": (lambda: StreamLoop([wide(40_000)], (), ()), "1 views with 1600000000 pixels"),
}


@pytest.mark.parametrize("door", DOORS)
def test_check_memory__is_called_before_work_begins(door, monkeypatch):
    call, content = DOORS[door]
    monkeypatch.setattr("morgs_mi.platform.memory.free_memory", lambda: 8e9)
    with pytest.raises(
        ValueError, match=rf"\(\): expected what fits in the 8\.0 GB of free .*, got {content}, "
    ):
        call()


def test_StreamLoop__refuses_more_gaussians_than_pixels_determine():
    config = StreamConfig(fit=FitConfig(num_gaussians=2000))
    with pytest.raises(ValueError, match="`num_gaussians` must be at most 1024, 16 for each"):
        StreamLoop([wide(8)], (), (), config)
