"""The speed benchmark as a command: a workload beside a yardstick, and what the ladder's files hold."""

from __future__ import annotations

import csv
import json
import platform
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed import machine_code, plain
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video

ROOT = Path(__file__).parents[3]
TOOL = "benchmarks.speed.render_speed"
# What a yardstick prints, from a program that checks what it is given: 60 Gaussians on 40x24 pixels.
YARDSTICK = """#!/bin/sh
[ "$(wc -c < "$1")" = $((3 * 4 + 60 * 14 * 4 + 25 * 4 + 6 * 4)) ] || exit 1
[ "$2" = 2 ] && [ "$3" -ge 1 ] || exit 1
echo "forward ms: median 1.0"
echo "fwd+bwd ms: median 0.5 min 0.4"
"""


@pytest.fixture
def workload(tmp_path: Path) -> Path:
    """Sixty Gaussians in front of a small camera."""
    rng, path = np.random.default_rng(0), tmp_path / "tiny.npz"
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3
    np.savez(
        path,
        means=np.float32(rng.uniform(-1, 1, (60, 3))),
        quats=np.float32(rng.normal(size=(60, 4))),
        scales=np.full((60, 3), 0.1, np.float32),
        opacities=np.full(60, 0.6, np.float32),
        colors=np.float32(rng.uniform(size=(60, 3))),
        K=np.float32([[40, 0, 20], [0, 40, 12], [0, 0, 1]]),
        viewmat=viewmat,
        width=40,
        height=24,
    )
    return path


def run(*args: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", TOOL, *map(str, args)], capture_output=True, text=True, cwd=ROOT)


def test_a_workload_beside_a_yardstick(workload: Path, tmp_path: Path):
    yardstick, out = tmp_path / "yardstick", tmp_path / "out.json"
    yardstick.write_text(YARDSTICK)
    yardstick.chmod(yardstick.stat().st_mode | stat.S_IXUSR)
    done = run("--workload", workload, "--json", out, "--yardstick", yardstick, "--repeats", 2, "--rounds", 1)
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert json.loads(done.stdout) == result
    for stage in ("lists_ms", "forward_ms", "step_ms", "peak_megabytes", "pairs"):
        assert result[stage] > 0, stage
    assert result["yardstick_step_ms"] == 0.5
    assert result["ratio_to_yardstick"] == pytest.approx(result["step_ms"] / 0.5, rel=1e-2)
    assert len(result["ratio_per_round"]) == 1
    assert result["error_rms"] <= result["error_max"] < 2e-4
    assert (result["gaussians"], result["size"], result["workload"]) == (60, [40, 24], "tiny.npz")
    assert {"machine", "versions", "variant", "threads"} <= result.keys()


def test_baselines_and_the_table(workload: Path, tmp_path: Path):
    out, table = tmp_path / "out.json", tmp_path / "out.csv"
    done = run("--workload", workload, "--json", out, "--csv", table, "--baselines", "--repeats", 1, "--rounds", 1)
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    for name in ("plain_forward_ms", "plain_step_ms", "volprim_forward_ms", "volprim_step_ms", "ratio_to_plain"):
        assert result[name] > 0, name
    with table.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["step_ms"]) == result["step_ms"]
    assert row["size"] == "40 24"


def test_the_plain_baseline_draws_the_same():
    """It would be no baseline if it did other work."""
    import drjit as dr
    import mitsuba as mi

    from benchmarks.workloads import ball
    from morgs_mi import RenderConfig, rasterize

    gaussians, camera = ball(2, 300, 50, 38, 0.1)
    config, target = RenderConfig(stop_transmittance=0), (3.0, 4.0, 5.0)  # beyond any colour: no sign is in doubt
    dr.enable_grad(*gaussians.items().values())
    image = rasterize(gaussians, camera, ("color",), config=config).color
    assert np.abs(np.asarray(plain.render(gaussians, camera, config)) - np.asarray(dr.detach(image))).max() < 2e-5
    found = [np.asarray(grad) for grad in plain.step(gaussians, camera, target, config)]
    dr.backward(dr.mean(dr.abs(image - mi.TensorXf(np.tile(np.float32(target), (38, 50, 1)))), axis=None))
    for (name, value), grad in zip(gaussians.items().items(), found, strict=True):
        expected = np.asarray(dr.grad(value))
        assert np.abs(expected).max() > 0
        assert np.abs(grad - expected).max() < 1e-3 * np.abs(expected).max(), name


# A kernel: loop over packets (0x10 to 0x3a) around the blend (0x14 to 0x36) around the next word (0x2a to 0x2e).
LISTING = """    ; Symbolic loop: blend
jit_llvm_disasm(): ========== 0 ==========
jit_llvm_disasm(): 0x00000000   sub\trsp, 128
jit_llvm_disasm(): 0x00000010   vmovaps\tzmm0, zmmword ptr [rdi]
jit_llvm_disasm(): 0x00000014   vfmadd213ps\tzmm0, zmm1, zmm2
jit_llvm_disasm(): 0x0000001a   vmulps\tzmm0, zmm0, zmmword ptr [rsp + 64]
jit_llvm_disasm(): 0x00000020   vmovups\tzmmword ptr [rsp + 64], zmm0
jit_llvm_disasm(): 0x00000024   je\t14
jit_llvm_disasm(): 0x00000026   jmp\t2
jit_llvm_disasm(): ...
jit_llvm_disasm(): 0x0000002a   vpgatherdd\tzmm1 {k3}, zmmword ptr [r9 + 4*zmm2]
jit_llvm_disasm(): 0x0000002e   jne\t-6
jit_llvm_disasm(): 0x00000034   kortestw\tk1, k1
jit_llvm_disasm(): 0x00000036   jne\t-36
jit_llvm_disasm(): 0x00000038   nop
jit_llvm_disasm(): 0x0000003a   jne\t-44
jit_llvm_disasm(): 0x0000003c   ret
  -> launching
"""


def test_a_listing_is_split_into_its_loops():
    body, within = machine_code.main_loop(machine_code.kernel_code(LISTING, "blend"))
    assert [i.place for i in body] == [0x14, 0x1A, 0x20, 0x24, 0x26, 0x34, 0x36]
    assert [i.place for i in within] == [0x2A, 0x2E]
    found = machine_code.counts(body)
    assert found["total"] == 7
    assert found["kinds"] == {"branch": 3, "multiply-add": 1, "multiply": 1, "store": 1, "mask": 1}
    assert found["memory"] == {"stack loads": 1, "stack stores": 1}
    with pytest.raises(SystemExit, match=r"printed no machine code for 'blend \(adjoint\)'"):
        machine_code.kernel_code(LISTING, "blend (adjoint)")


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the listing is read as x86-64")
def test_instructions_are_counted(workload: Path, tmp_path: Path):
    out, tool = tmp_path / "out.json", "benchmarks.speed.count_instructions"
    command = [sys.executable, "-m", tool, "--workload", workload, "--json", out, "--repeats", "2"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (result,) = json.loads(out.read_text())["workloads"]
    assert 0 < result["pairs_walked"] <= result["pairs_listed"]
    assert result["pairs_walked"] <= result["lanes"] * result["turns"]
    assert 0 < result["pixels_reached"] <= 1
    assert 0.5 < result["clock_ghz"] < 8
    pixels = result["pixels_per_block"]
    # Per pixel and Gaussian: 3 sums, p and the polynomial of 2^p; the adjoint's sums, suffix and moments besides.
    for name, least in (("blend", 8), ("adjoint", 13)):
        found = result[name]
        assert found["total"] == sum(found["kinds"].values())
        assert found["kinds"]["multiply-add"] >= least * pixels, name
        assert found["memory"]["stack stores"] > pixels, name
        assert result["milliseconds"][name] > 0


def test_the_codec_is_timed(tmp_path: Path):
    out, tool = tmp_path / "out.json", "benchmarks.speed.codec_speed"
    command = [sys.executable, "-m", tool, "--json", out, "--sizes", "300", "100", "--repeats", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["gaussians"], row["moving"]) == (300, 100)
    assert min(row["encode_ms"], row["decode_ms"]) > 0
    # At least a flag and some bits for each of the numbers that change.
    assert 100 * 20 / 8 < row["bytes"] < 300 * 100
    # A step of 0.08 px in each of three directions.
    assert 0 < row["error_px_rms"] < row["error_px_max"] < 0.08 * 3**0.5


def test_reading_a_capture_takes_the_same_memory_however_long_it_is(tmp_path: Path):
    """Of 60 frames of 2.6 MiB a few are held at a time; if all were kept, the last 54 would show."""
    script, out = "benchmarks.speed.capture_memory", tmp_path / "memory.json"
    sizes = ["--cameras", "3", "--frames", "60", "--width", "640", "--height", "480", "--downscale", "1"]
    command = [sys.executable, "-m", script, "--json", str(out), *sizes]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
    result = json.loads(out.read_text())
    assert len(result["rows"]) == 30
    assert result["growth_mib"] < 6 * result["frame_mib"]


def test_a_recording_is_fitted_and_measured(tmp_path: Path):
    names, rng = ("cam0", "cam1"), np.random.default_rng(0)
    views = [Camera.look_at((i - 0.5, 0, -3), (0, 0, 0), (0, -1, 0), 60, 48, 32, name) for i, name in enumerate(names)]
    write_colmap(tmp_path / "clip" / "sparse" / "0", views, rng.uniform(-1, 1, (150, 3)), rng.uniform(size=(150, 3)))
    for name in names:
        write_video(tmp_path / "clip" / name, rng.integers(0, 255, (2, 32, 48, 3), np.uint8), 25)
    script, out = "benchmarks.reports.real_capture", tmp_path / "figures.json"
    quick = ["--num-gaussians", "120", "--first-frame-steps", "4", "--epochs", "1", "--sh-degree", "0"]
    args = [tmp_path / "clip", tmp_path / "out", "--json", out, *quick]
    subprocess.run([sys.executable, "-m", script, *map(str, args)], check=True, cwd=ROOT, capture_output=True)
    result = json.loads(out.read_text())
    assert (result["capture"], result["complete"], result["num_frames"]) == ("clip", True, 2)
    assert set(result["views"]) == set(names)
    assert all(row["resident_mib"] > 50 and row["seconds"] > 0 for row in result["frames"])
    assert str(tmp_path) not in out.read_text()
