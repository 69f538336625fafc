"""Overlap of motion masks and of confidence with the true masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.masks import Options, means, measure, overlap
from morgs_mi.method.mask_refiners.registry import MASK_REFINERS
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize


def test_overlap__of_known_masks():
    mask, truth = np.zeros((2, 4, 4), bool)
    mask[:2], truth[1:] = True, True
    assert overlap(mask, truth) == {"iou": 4 / 16, "found": 4 / 12, "true": 4 / 8}


def test_means__averages_each_figure():
    assert means([{"a": 1.0, "b": 2.0}, {"a": 2.0, "b": 2.0}]) == {"a": 1.5, "b": 2.0}


def test_measure__refuses_a_capture_without_truth(fitted_clip: Path, tmp_path: Path):
    (tmp_path / "capture").mkdir()
    for path in (fitted_clip / "capture").iterdir():
        if path.name != "truth":
            (tmp_path / "capture" / path.name).symlink_to(path)
    with pytest.raises(ValueError, match="expected a capture with a held-out view and ground truth"):
        measure(tmp_path / "capture", Options(captures=()))


@pytest.mark.slow
def test_measure__compares_masks_and_confidence_with_the_truth(tmp_path: Path):
    clip = synthesize("spheres", tmp_path / "clip", SynthConfig(cameras=6, frames=3, width=64, height=48, spp=4))
    options = Options(captures=(clip,), frames=2, first_frame_steps=20, num_gaussians=300, loops=("none",))
    result = measure(clip, options)
    assert result["masks"].keys() == {*MASK_REFINERS.names, "lifted"}
    assert set(result["processor_ms"]) == set(MASK_REFINERS.names)
    for start in ("lifted", "as before"):
        found = result["loops"][start]["none"]
        assert 0 <= found["key_views"]["iou"] <= 1
        assert 5 < found["held_out"]["psnr_moving"] < 60
