"""A small workload file for the speed benchmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def workload(tmp_path: Path) -> Path:
    """Sixty Gaussians in front of a small camera."""
    rng = np.random.default_rng(0)
    path = tmp_path / "tiny.npz"
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
