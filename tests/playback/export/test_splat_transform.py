"""Exported files in another program, splat-transform, which npm fetches; skipped without npm or a
network.
"""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.cli.main import main
from morgs_mi.io.compressed_ply import read_compressed_ply, write_compressed_ply
from morgs_mi.io.ply import read_ply
from morgs_mi.testing import assert_close
from tests.scenes.changing_splats import splats, write_stream

PAGE = (Path(__file__).parents[3] / "docs/exports.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    (for .*npx .*; done)$", PAGE, re.MULTILINE)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program():
    """Return the program with its version, as the page names it."""
    (name,) = set(re.findall(r"npx --yes (\S+)", PAGE))
    if shutil.which("npx") is None:
        pytest.skip("npx is missing")
    if subprocess.run(
        ["npx", "--yes", name, "--version"], capture_output=True, timeout=300, check=False
    ).returncode:
        pytest.skip(f"npm cannot fetch {name}")
    return name


def convert(program, *files):
    subprocess.run(
        ["npx", "--yes", program, "-g", "cpu", *map(str, files)], check=True, timeout=300
    )


def assert_same(original, converted, atol):
    """Compare Gaussians in any order; quaternions up to their sign and length."""
    columns = []
    for gaussians in (original, converted):
        raw = gaussians.numpy()
        quats = raw["quats"] / np.linalg.norm(raw["quats"], axis=1, keepdims=True)
        rotations = np.einsum("ni,nj->nij", quats, quats)
        parts = [
            raw["means"],
            raw["log_scales"],
            np.asarray(gaussians.opacities),
            rotations,
            raw["sh_coeffs"],
        ]
        table = np.concatenate([part.reshape(len(gaussians), -1) for part in parts], axis=1)
        columns.append(table[np.argsort(raw["means"][:, 0], kind="stable")])
    assert_close(columns[1], columns[0], atol=atol)


def test_write_compressed_ply__is_read_by_splat_transform(program, tmp_path):
    write_compressed_ply(tmp_path / "a.compressed.ply", splats(700, 3))
    convert(program, tmp_path / "a.compressed.ply", tmp_path / "b.ply")
    assert_same(
        read_compressed_ply(tmp_path / "a.compressed.ply"), read_ply(tmp_path / "b.ply"), atol=2e-6
    )


@pytest.mark.parametrize(("command", "suffix"), [*zip(COMMANDS, (".sog", ".spz"), strict=True)])
def test_exports_page__commands_convert_every_frame(program, tmp_path, command, suffix):
    write_stream(tmp_path / "stream.morgs", 2)
    assert main(["export", "ply", str(tmp_path)]) == 0
    subprocess.run(["bash", "-c", command.replace("OUT", str(tmp_path))], check=True, timeout=300)
    assert len(list((tmp_path / "ply").glob(f"*{suffix}"))) == 2
    convert(program, tmp_path / "ply" / f"0001{suffix}", tmp_path / "back.ply")
    frame = read_ply(tmp_path / "ply" / "0001.ply")
    back = read_ply(tmp_path / "back.ply")
    # Both formats quantise colours and harmonics coarsely, positions finely.
    order, places = (np.sort(gaussians.numpy()["means"], axis=0) for gaussians in (frame, back))
    assert_close(places, order, atol=2e-3)
