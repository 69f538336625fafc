"""Recordings: their number is bounded, evicted ones are recorded again, and other threads do not
interfere.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.render import kernel_recording
from tests.scenes.programs import run_script


def scaled(factor, *arrays):
    return [factor * array for array in arrays]


def test_recorded__bounds_the_number_of_recordings(monkeypatch, capfd):
    made = []
    freeze = dr.freeze
    monkeypatch.setattr(kernel_recording, "MOST_RECORDINGS", 10)
    monkeypatch.setattr(
        dr, "freeze", lambda *args, **settings: made.append(freeze(*args, **settings)) or made[-1]
    )
    function = kernel_recording.recorded(scaled, 3)
    for _ in range(2):
        for pattern in range(32):
            sizes = [2 + (pattern >> bit & 1) for bit in range(5)]
            arrays = [mi.Float(np.arange(size, dtype=np.float32)) for size in sizes]
            for array, result in zip(arrays, function(*arrays), strict=True):
                assert_array_equal(np.asarray(result), 3 * np.asarray(array))
    assert made[0].n_cached_recordings <= 10 < made[0].n_recordings
    assert not capfd.readouterr().err


BUSY = """
import gc, sys, threading
from dataclasses import dataclass
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from morgs_mi.render.kernel_recording import recorded

@dataclass
class Pair:
    a: mi.Float
    b: mi.Float

class Cycle:
    pass

def churn():
    while True:
        [[] for _ in range(1000)]  # makes Python collect

sys.setswitchinterval(1e-6)
add = recorded(lambda pair: pair.a + pair.b)
threading.Thread(target=churn, daemon=True).start()
for i in range(500):
    pair = Pair(dr.arange(mi.Float, 100) + i, dr.ones(mi.Float, 100))
    dr.eval(pair)
    garbage = Cycle()
    garbage.array, garbage.itself = add(pair), garbage
assert gc.isenabled()
"""


@pytest.mark.slow
def test_recorded__does_not_deadlock_with_garbage_collection_in_another_thread():
    run_script(BUSY, check=True, timeout=120)
