"""Cross-validation of the first frame: the quality of views between the cameras, and the dropping that improves it.

Some training views are withheld, and a short fit to the others, a trial, is evaluated by their PSNR. By default there
is a single trial of half the size, which takes about a tenth of the time of the first frame.

With `FitConfig.validate`, longer trials of six views and more choose the probability of dropping (see `dropping`).
Candidates are tried in rising order until one is no better than the last. With fewer views, and by default, it follows
from the views alone: a rig without one of few views is too different.

A withheld view has more error than the others. This excess grows with its angle to them, until the view shows nothing
that they show. Views halfway between neighbouring cameras are nearer, and have less of it (see `excess_share`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import expm1

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.progress import Progress
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.rig import angles_to, scene_depths
from morgs_mi.fit.dropping import MANY_VIEWS, default_dropping
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import forecast, verdict
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.view import decibels

__all__ = [
    "CrossValidation",
    "Trial",
    "cross_validate",
    "excess_share",
    "has_trials",
    "trial_steps",
    "withheld_views",
]

# Probabilities of dropping that are tried, in rising order.
_CANDIDATES = (0.0, 0.2, 0.4)
# Number of views from which one can be withheld.
_VALIDATED = 3
# Number of views per withheld view; at least one view is withheld.
_WITHHELD = 6
# Steps of a trial as a fraction of the steps of the first frame, and width in px to which its images are reduced: by
# default, and with `validate`, where reduced images would hide the noise that the dropping depends on.
_SHARES, _WIDTHS = (0.15, 0.4), (320, 640)
# Angle in degrees at which the excess of error ends, and power of the angle, times the number of views, with which it
# grows in trials with few views.
_FAR, _POWER = 20.0, 6.0
# Number of cameras from which the estimate is usually right by 1.5 dB, and its error with fewer, dB.
_CERTAIN, _UNCERTAINTY = 8, 4


@dataclass(frozen=True)
class Trial:
    """One fit.

    Attributes:
        dropping: probability of dropping.
        withheld_psnr: mean PSNR of the withheld views, dB.
        training_psnr: mean PSNR of the others, dB.
    """

    dropping: float
    withheld_psnr: float
    training_psnr: float


@dataclass(frozen=True)
class CrossValidation:
    """Result of cross-validation.

    Attributes:
        withheld: names of the withheld views.
        cameras: number of cameras, with the withheld ones.
        spacing: mean angle from a camera to its nearest one, seen from the scene, in degrees.
        withheld_angle: mean angle from a withheld view to the nearest of the others, in degrees.
        trials: the fits, by rising probability of dropping.
        training_psnr: mean PSNR of the first frame itself in the training views, dB; None: not fitted yet.
    """

    withheld: tuple[str, ...]
    cameras: int
    spacing: float
    withheld_angle: float
    trials: tuple[Trial, ...]
    training_psnr: float | None = None

    @property
    def best(self) -> Trial:
        """The fit with the best withheld views."""
        return max(self.trials, key=lambda trial: trial.withheld_psnr)

    @property
    def expected_psnr(self) -> float:
        """Estimate of the mean PSNR of views halfway between neighbouring cameras, dB.

        The error of the first frame in its training views, which has more steps than the trial, and the share of the
        withheld views' excess that views halfway between cameras have.
        """
        best = self.best
        training_psnr = best.training_psnr if self.training_psnr is None else self.training_psnr
        withheld, trained, own = (
            10 ** (-psnr / 10) for psnr in (best.withheld_psnr, best.training_psnr, training_psnr)
        )
        share = excess_share(0.5 * self.spacing, self.withheld_angle, self.cameras - len(self.withheld))
        return float(decibels(np.array(share * max(withheld - trained, 0.0) + own)))

    @property
    def sentence(self) -> str:
        """Sentence on the expected quality of views between the cameras."""
        training_psnr = self.training_psnr or self.best.training_psnr
        them = "them" if len(self.withheld) > 1 else "it"
        source = f"estimated from {', '.join(self.withheld)} in a trial without {them}"
        if self.cameras < _CERTAIN:
            source = f"give or take {_UNCERTAINTY} dB, {source}"
        return verdict(self.expected_psnr, training_psnr, self.spacing, source)


def excess_share(angle: float, withheld_angle: float, trained: int) -> float:
    """Return the excess of error at an angle to the nearest view, relative to the excess of withheld views.

    The excess grows in proportion to the angle and ends at about 20 degrees, where neighbours show something else. Few
    views lose more with the withheld one: its excess is larger then, by a power of the angle (measured, see
    `docs/experiments/first-frame.md`).

    Args:
        angle: in degrees, at most `withheld_angle` counts.
        withheld_angle: of the withheld views, in degrees.
        trained: number of views that were not withheld.
    """
    power = max(1.0, _POWER / trained)
    near, far = (-expm1(-((max(x, 1e-6) / _FAR) ** power)) for x in (min(angle, withheld_angle), withheld_angle))
    return near / far


def cross_validate(
    problem: FirstFrameProblem, config: FitConfig, seed: int, progress: Progress | None = None
) -> CrossValidation:
    """Return the result of cross-validation of the first frame.

    Args:
        problem: at least three views.
        config: settings of the fit.
        seed: of every fit.
        progress: of the trials, a stage each.
    """
    progress = progress or Progress()
    cameras = problem.cameras
    withheld = withheld_views(cameras, _WITHHELD)
    kept = [view for view in range(len(cameras)) if view not in withheld]
    small = problem.reduced(_trial_width(cameras, config))
    trained, unseen = small.only(kept), small.only(withheld)
    candidates, trials = _candidates_of(problem, config), []
    for number, dropping in enumerate(candidates, 1):
        steps = max(1, round(_SHARES[config.validate] * config.planned_steps))
        trial = replace(config, dropping=dropping, first_frame_steps=steps)
        stage = progress.of(f"Trial {number} of {len(candidates)}" if len(candidates) > 1 else "Trial")
        fitted = fit_first_frame(trained, trial, rng_of(seed, Stream.TRIALS), stage).gaussians
        trials.append(Trial(dropping, unseen.psnr(fitted), trained.psnr(fitted)))
        if len(trials) > 1 and trials[-1].withheld_psnr <= trials[-2].withheld_psnr:
            break
    points = np.asarray(problem.start.means)
    depths, others = scene_depths(cameras, points), [cameras[view] for view in kept]
    angle = float(np.mean([angles_to(cameras[view], depths[view], others).min() for view in withheld]))
    names = tuple(cameras[view].name for view in withheld)
    return CrossValidation(names, len(cameras), forecast(cameras, points).spacing, angle, tuple(trials))


def _candidates_of(problem: FirstFrameProblem, config: FitConfig) -> tuple[float, ...]:
    """Return the probabilities of dropping that are tried."""
    is_chosen = config.validate and len(problem.views) >= MANY_VIEWS
    return _CANDIDATES if is_chosen else (default_dropping(problem),)


def has_trials(problem: FirstFrameProblem, config: FitConfig) -> bool:
    """Return whether views are withheld: from three views and more, where no probability of dropping is given."""
    return config.dropping is None and len(problem.views) >= _VALIDATED


def trial_steps(problem: FirstFrameProblem, config: FitConfig) -> float:
    """Return the steps of all trials, at most, relative to the steps of the first frame."""
    return len(_candidates_of(problem, config)) * _SHARES[config.validate] if has_trials(problem, config) else 0.0


def _trial_width(cameras: Sequence[Camera], config: FitConfig) -> int:
    """Return the width to which the images of a trial are reduced, px."""
    half = max(camera.width for camera in cameras) // 2
    return _WIDTHS[1] if config.validate else min(half, _WIDTHS[0])


def withheld_views(cameras: Sequence[Camera], share: int) -> tuple[int, ...]:
    """Return the indices of the withheld views: one of `share`, at least one, spread over the inner half of the rig.

    Views at its ends are not between others.
    """
    count, positions = max(1, len(cameras) // share), np.array([camera.position for camera in cameras])
    away = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    inner = np.argsort(away, kind="stable")[: max(count, len(cameras) // 2)]
    chosen = [int(inner[0])]
    while len(chosen) < count:
        distance = np.linalg.norm(positions[inner][:, None] - positions[chosen], axis=-1).min(axis=1)
        chosen.append(int(inner[np.argmax(distance)]))
    return tuple(sorted(chosen))
