"""Threads that render the same Gaussians at once, in processes of their own: Dr.Jit ends the
process otherwise.
"""

import subprocess
import sys

import pytest

# Threads that render, threads that compute gradients, and renderings of each, without a warm start.
PROGRAM = """
import sys, threading
import drjit as dr, mitsuba as mi, numpy as np
from morgs_mi import rasterize, render_lock
from morgs_mi.fit.optimise import Steps, adam, optimise
mi.set_variant("llvm_ad_rgb")
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import make_scene, to_gaussians

renderers, fits, count = map(int, sys.argv[1:])
gaussians, camera = to_gaussians(make_scene(1, n=200)), make_camera()
images, finished = set(), []
start = threading.Barrier(renderers + fits)

def render():
    start.wait()
    for _ in range(count):
        images.add(np.asarray(rasterize(gaussians, camera).color).tobytes())
    finished.append("render")

def losses_at(parameters, view):
    image = rasterize(gaussians.with_parameters(parameters), camera).color
    return {"recon": dr.mean(dr.square(image - 0.5), axis=None)}

def fit():
    start.wait()
    parameters = gaussians.parameters()
    optimise(adam(parameters), dict.fromkeys(parameters, 1e-3), losses_at, Steps(range(count)))
    finished.append("fit")

def derive():
    start.wait()
    for _ in range(count):
        means = mi.TensorXf(gaussians.means)
        dr.enable_grad(means)
        loss = losses_at({"means": means}, 0)["recon"]
        with render_lock:
            dr.backward(loss)
        assert np.isfinite(np.asarray(dr.grad(means))).all()
    finished.append("derive")

work = [render] * renderers + [fit, derive][:fits]
threads = [threading.Thread(target=target, daemon=True) for target in work]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join(100)
assert len(finished) == len(work), finished
assert len(images) == min(renderers, 1)
"""


def run(renderers, fits, count):
    command = [
        sys.executable,
        "-X",
        "faulthandler",
        "-c",
        PROGRAM,
        *map(str, (renderers, fits, count)),
    ]
    subprocess.run(command, check=True, timeout=110)


def test_rasterize__renders_the_same_gaussians_in_threads_beside_a_fit():
    run(renderers=2, fits=1, count=15)


@pytest.mark.slow
def test_rasterize__renders_the_same_gaussians_in_threads_at_length():
    run(4, fits=2, count=60)


@pytest.mark.slow
def test_rasterize__starts_cold_in_threads_of_several_processes():
    command = [sys.executable, "-c", PROGRAM, "2", "1", "2"]
    processes = [subprocess.Popen(command) for _ in range(8)]
    try:
        assert [process.wait(timeout=240) for process in processes] == [0] * 8
    finally:
        for process in processes:
            process.kill()
