"""Scores of the fits of a sweep, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from morgs_mi.extras.sweep.fits import Arm
from morgs_mi.extras.sweep.statistics import DECIDING, SCORES, Means, mean_of


@dataclass(frozen=True, eq=False, repr=False)
class SweepScores:
    """Scores of fits of a capture by several arms.

    Attributes:
        capture: name of the capture.
        held_out: whether held-out views are scored; otherwise all training views.
        arms: the A arms.
        scores: [A, S, N] of S seeds, in the order of `morgs_mi.extras.sweep.statistics.SCORES`; NaN
            where unknown, or not fitted yet.
        reference: index of the arm that each arm is compared with [A].
        measure: name of the score that a sweep compares.
        excess: of `leave_out`, by how many times losses exceed their bounds [A, D], see
            `morgs_mi.extras.sweep.statistics.excess`; empty of `sweep`.
    """

    capture: str
    held_out: bool
    arms: Sequence[Arm]
    scores: np.ndarray
    reference: np.ndarray
    measure: str = "psnr"
    excess: np.ndarray = field(default_factory=partial(np.zeros, (0, len(DECIDING))))

    @property
    def names(self) -> np.ndarray:
        """Names of the arms [A]."""
        return np.array([arm.name for arm in self.arms])

    @property
    def points(self) -> np.ndarray:
        """Numbers [A] that are varied along a curve: epochs, or steps of the first frame."""
        return np.array([arm.point for arm in self.arms])

    @property
    def changes(self) -> Means:
        """Means over the seeds of the paired differences from the arms of `reference`."""
        with np.errstate(invalid="ignore"):
            return mean_of(self.scores - self.scores[self.reference])

    @property
    def ablations(self) -> np.ndarray:
        """Indices of the arms of `leave_out` that lack something and have scores."""
        is_other = self.reference != np.arange(len(self.reference))
        return np.flatnonzero(is_other & np.isfinite(self.scores).any((1, 2)))

    @property
    def reasons(self) -> np.ndarray:
        """Title of the score [A] because of which what an arm of `leave_out` lacks is needed most;
        empty if it is not needed.
        """
        ratios = np.nan_to_num(self.excess)
        titles = np.array([SCORES[name].title for name in DECIDING])
        return np.where(ratios.max(1) > 1, titles[ratios.argmax(1)], "")

    def curves(self, first_alone: bool) -> dict[str, np.ndarray]:
        """Return the indices of the arms of each curve that have scores, by its name.

        Args:
            first_alone: whether of fits of the first frame alone.
        """
        is_first = np.array([arm.first_alone for arm in self.arms], bool)
        has_scores = np.isfinite(self.scores).any((1, 2)) & (is_first == first_alone)
        names = self.names
        return {
            name: np.flatnonzero(has_scores & (names == name))
            for name in dict.fromkeys(names[has_scores].tolist())
        }
