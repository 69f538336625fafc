"""Overlap of motion masks and of confidence with the true masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.masks import means, measure, overlap
from morgs_mi.capture.capture import load_capture
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
from morgs_mi.runs.cluster.tasks import Source


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
    source = Source.of(load_capture(tmp_path / "capture"))
    with pytest.raises(ValueError, match="expected a capture with a held-out view and ground truth"):
        measure(source, (), StreamConfig())


@pytest.mark.slow
def test_measure__compares_masks_and_confidence_with_the_truth(clip: Path):
    config = StreamConfig(FitConfig(first_frame_steps=20, num_gaussians=300))
    result = measure(Source.of(load_capture(clip)), ("none",), config)
    assert result["masks"].keys() == {*MASK_REFINERS.names, "lifted"}
    assert set(result["processor_ms"]) == set(MASK_REFINERS.names)
    for start in ("lifted", "as before"):
        found = result["loops"][start]["none"]
        assert 0 <= found["key_views"]["iou"] <= 1
        assert 5 < found["held_out"]["psnr_moving"] < 60
