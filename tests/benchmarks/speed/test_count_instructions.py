"""Machine instructions of the blending loops: parsing of listings, iterations and times."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import workloads
from benchmarks.speed import count_instructions, machine_code

ROOT = Path(__file__).parents[3]
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


def test_main_loop__splits_a_listing_into_its_loops():
    body, inner = machine_code.main_loop(machine_code.kernel_code(LISTING, "blend"))
    assert [i.address for i in body] == [0x14, 0x1A, 0x20, 0x24, 0x26, 0x34, 0x36]
    assert [i.address for i in inner] == [0x2A, 0x2E]
    found = machine_code.counts(body)
    assert found["total"] == 7
    assert found["kinds"] == {"branch": 3, "multiply-add": 1, "multiply": 1, "store": 1, "mask": 1}
    assert found["memory"] == {"stack loads": 1, "stack stores": 1}
    with pytest.raises(SystemExit, match=r"printed no machine code for 'blend \(adjoint\)'"):
        machine_code.kernel_code(LISTING, "blend (adjoint)")


def test_work__counts_iterations_and_utilisation(workload: Path):
    result = count_instructions.work(*workloads.load(workload), lanes=16)
    assert 0 < result["pairs_walked"] <= result["pairs_listed"]
    assert result["pairs_walked"] <= 16 * result["turns"]
    assert result["lanes_busy"] == pytest.approx(result["pairs_walked"] / (16 * result["turns"]), abs=1e-3)
    assert 0 < result["pixels_reached"] <= 1


def test_stage_times__sum_to_at_most_the_step(workload: Path):
    result = count_instructions.stage_times(*workloads.load(workload), repeats=1)
    stages = {"projection and lists", "blend", "loss", "adjoint", "projection's adjoint", "outside kernels"}
    assert stages - {"loss"} <= result.keys() <= stages | {"step"}
    assert min(result["blend"], result["adjoint"]) > 0


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the listing is read as x86-64")
def test_count_instructions__counts_the_instructions_of_both_loops(workload: Path, tmp_path: Path):
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
    # Per pixel and Gaussian: 3 sums, p and the polynomial of 2^p; in the adjoint also its sums, suffix and moments.
    for name, least in (("blend", 8), ("adjoint", 13)):
        found = result[name]
        assert found["total"] == sum(found["kinds"].values())
        assert found["kinds"]["multiply-add"] >= least * pixels, name
        assert found["memory"]["stack stores"] > pixels, name
        assert result["milliseconds"][name] > 0
