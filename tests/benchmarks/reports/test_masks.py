"""Overlap of motion masks."""

from __future__ import annotations

import numpy as np

from benchmarks.reports.masks import means, overlap


def test_overlap__of_known_masks():
    mask, truth = np.zeros((2, 4, 4), bool)
    mask[:2], truth[1:] = True, True
    assert overlap(mask, truth) == {"iou": 4 / 16, "found": 4 / 12, "true": 4 / 8}


def test_means__averages_each_figure():
    assert means([{"a": 1.0, "b": 2.0}, {"a": 2.0, "b": 2.0}]) == {"a": 1.5, "b": 2.0}
