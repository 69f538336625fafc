"""The rule of a trial of branches: from paired fits to verdicts, and to the fit that is made next.

A row is a fit of a set with a seed and without some branches (``off``), and has its scores. Rows of
equal set, code and seed are pairs: their difference is what the branches do there, and the last
code that tried them decides. A *loss* counts in tolerances of its measure:

- PSNR of held-out views, in the first frame and in later ones: 0.1 dB;
- their PSNR where things move, and the error of the motion: their noise, which is the standard
  error of the difference over the seeds, and with one seed the standard deviation of the default's
  fits with three seeds;
- bytes of a later frame: 3 %;
- seconds: 3 % in wall and processor time, where both differences exceed twice their standard
  errors. A machine's clock is noisy, so they never decide alone.

Without a branch that a set needs, a loss exceeds its tolerance and twice its noise with three
seeds. With one seed it must be *clear*: twice its noise, and twice 0.1 dB or 3 %; others that
exceed their tolerance get further seeds, and may stay undecided. A gain is no reason to have a
branch. Seeds vary little in some sets: a loss above its noise, but of at most 0.1 dB where things
move or 3 % of the motion's error, is *little*, and such branches are tried on further sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

Row = Mapping[str, Any]
SEEDS = (0, 1, 2)
# A loss is clear above so many standard deviations of its noise, and so many times what is little.
_CLEAR = 2.0
# Least number of branches, needed together, whose halves are tried.
_LEAST_SPLIT = 10
_COST = 0.03  # of bytes and seconds, relative
_PSNR = 0.1  # dB

State = Literal["needed", "needed by little", "close", "slower", "not needed", "no effect"]


STATES: tuple[State, ...] = get_args(State)
"""States of branches on a set, the one that decides first."""


@dataclass(frozen=True)
class Measure:
    """A score of a row."""

    name: str  #: In a row.
    title: str  #: In tables, with its unit.
    gain: int  #: 1 if more is better, -1 if less is.
    little: float  #: Largest loss that counts as little.
    is_relative: bool = False  #: Whether differences are shares of the default's score.
    has_noise: bool = False  #: Whether its tolerance is the noise; otherwise it is `little`.


MEASURES = (
    Measure("psnr_first", "dB in the first frame", 1, _PSNR),
    Measure("psnr_later", "dB in later frames", 1, _PSNR),
    Measure("psnr_moving", "dB where things move", 1, _PSNR, has_noise=True),
    Measure("motion_error", "of the motion error", -1, _COST, True, True),
    Measure("bytes", "of the bytes", -1, _COST, True),
)
_CLOCKS = ("seconds", "cpu_s")


@dataclass(frozen=True)
class Loss:
    """Loss of a measure without some branches."""

    measure: Measure  #: The measure.
    change: float  #: Mean difference, in the measure's unit or relative.
    tolerances: float  #: The same as a loss, in tolerances.
    is_certain: bool = False  #: Whether it exceeds twice its noise.
    is_clear: bool = False  #: Whether it is so large that further seeds are no help.
    is_little: bool = True  #: Whether it is at most the measure's `little`.


@dataclass(frozen=True)
class Trial:
    """Comparison of the fits of a set with and without some branches."""

    state: State  #: Of these branches on this set.
    loss: Loss  #: The largest loss.
    seeds: int  #: Number of pairs.
    count: int  #: Number of branches that are off.


def numbers(rows: Sequence[Row], name: str) -> np.ndarray:
    """Return a score of some rows, NaN where unknown."""
    return np.array([row[name] for row in rows], float)


def losses(default: Sequence[Row], without: Sequence[Row], every: Sequence[Row]) -> list[Loss]:
    """Return the known losses of all `MEASURES` without some branches.

    Args:
        default: S fits with all branches.
        without: S fits with the same seeds without some.
        every: fits with all branches and any seeds, at least two, for the noise of a single pair.
    """
    result = []
    count = len(without)
    for measure in MEASURES:
        base = numbers(default, measure.name)
        scale = np.abs(base) if measure.is_relative else 1.0
        changes = (numbers(without, measure.name) - base) / scale
        change = float(np.mean(changes))
        noise = float(np.std(numbers(every, measure.name), ddof=1) / np.mean(scale))
        if count > 1:
            noise = float(np.std(changes, ddof=1) / count**0.5)
        tolerance = noise if measure.has_noise else measure.little
        loss = -measure.gain * change
        if np.isfinite(loss) and np.isfinite(noise):
            is_certain = loss > _CLEAR * noise
            is_clear = is_certain and loss > _CLEAR * measure.little
            is_little = loss <= measure.little
            ratio = loss / max(tolerance, 1e-9)
            result.append(Loss(measure, change, ratio, is_certain, is_clear, is_little))
    return result


def is_slower(default: Sequence[Row], without: Sequence[Row]) -> bool:
    """Return whether fits are slower without some branches, by both clocks."""
    for name in _CLOCKS:
        base = numbers(default, name)
        changes = (numbers(without, name) - base) / base
        if len(changes) < 2:
            return False
        error = np.std(changes, ddof=1) / len(changes) ** 0.5
        if not np.mean(changes) > max(_COST, 2 * error):
            return False
    return True


def compared(default: Sequence[Row], without: Sequence[Row], every: Sequence[Row]) -> Trial:
    """Return the comparison of paired fits; arguments of `losses`."""
    seeds = len(without)
    count = len(without[0]["off"])
    if all(a["stream"] == b["stream"] for a, b in zip(default, without, strict=True)):
        return Trial("no effect", Loss(MEASURES[1], 0.0, 0.0), seeds, count)
    largest = max(
        losses(default, without, every),
        key=lambda loss: (
            loss.tolerances > 1 and not loss.is_little and loss.is_certain,
            loss.tolerances > 1 and not loss.is_little,
            loss.is_certain,
            loss.tolerances,
        ),
    )
    if largest.tolerances > 1:
        is_decided = largest.is_clear or (seeds >= len(SEEDS) and largest.is_certain)
        state = "needed by little" if largest.is_little else "needed"
        return Trial(state if is_decided else "close", largest, seeds, count)
    state = "slower" if is_slower(default, without) else "not needed"
    return Trial(state, largest, seeds, count)


Trials = Mapping[tuple[str, tuple[str, ...]], Trial]


def trials_of(rows: Sequence[Row]) -> dict[tuple[str, tuple[str, ...]], Trial]:
    """Return the comparisons that rows allow, by set and names of the branches that are off."""
    fits: dict[tuple[str, str, tuple[str, ...]], dict[int, Row]] = {}
    for row in rows:
        fits.setdefault((row["set"], row["code"], tuple(row["off"])), {})[row["seed"]] = row
    result = {}
    for (place, code, off), without in fits.items():
        every = fits.get((place, code, ()), {})
        seeds = sorted(without.keys() & every.keys())
        if off and seeds and len(every) > 1:
            pairs = [every[seed] for seed in seeds], [without[seed] for seed in seeds]
            result[place, off] = compared(*pairs, [*every.values()])
    return result


def trial_on(trials: Trials, name: str, place: str) -> Trial | None:
    """Return the comparison that decides on a branch on a set: of it alone, or of several that are
    not needed there together; None: there is none.
    """
    alone = trials.get((place, (name,)))
    if alone is not None:
        return alone
    fine = [
        trial
        for (where, names), trial in trials.items()
        if where == place and name in names and trial.state in ("not needed", "no effect")
    ]
    return min(fine, key=lambda trial: trial.state != "no effect", default=None)


def is_needed(trials: Trials, name: str) -> bool:
    """Return whether any set needs a branch by more than a little: it is not tried on others."""
    return any(trial.state == "needed" and names == (name,) for (_, names), trial in trials.items())


def next_fit(
    rows: Sequence[Row], groups: Mapping[str, Sequence[Sequence[str]]]
) -> tuple[str, tuple[str, ...], int] | None:
    """Return the set, the branches that are off, and the seed of the fit to make next; None: all
    are made.

    On one set after the other: the default with three seeds; each group of branches that no set
    needs so far; each branch of a group that this set needs; further seeds where it is close; and
    all branches together that are not needed, or halves of them.

    Args:
        rows: fits so far.
        groups: the names of the branches that act on a set, group by group, by set.
    """
    trials = trials_of(rows)
    made = {(row["set"], tuple(row["off"]), row["seed"]) for row in rows}
    for place, groups_of_place in groups.items():
        for seed in SEEDS:
            if (place, (), seed) not in made:
                return place, (), seed
        candidates = [
            [name for name in names if not is_needed(trials, name)] for names in groups_of_place
        ]
        companies = [names for where, names in trials if where == place and len(names) > 1]
        untried = [
            [name for name in names if trial_on(trials, name, place) is None]
            for names in candidates
        ]
        for names in untried:
            if len(names) > 1 and not any({*company} >= {*names} for company in companies):
                return place, tuple(names), SEEDS[0]
        for names in untried:
            if names:
                return place, (names[0],), SEEDS[0]
        survivors = tuple(name for names in candidates for name in names)
        for name in survivors:
            trial = trials.get((place, (name,)))
            has_more = trial is not None and (trial.state == "close" or trial.seeds > 1)
            if trial is not None and has_more and trial.seeds < len(SEEDS):
                return place, (name,), SEEDS[trial.seeds]
        joint = [names for names in companies if {*names} >= {*survivors}] or [survivors]
        pending = untried_part(trials, place, joint[0])
        if pending is not None:
            return pending
    return None


def untried_part(
    trials: Trials, place: str, names: tuple[str, ...]
) -> tuple[str, tuple[str, ...], int] | None:
    """Return the set, the branches and the seed of the next fit without several branches together:
    of all, with further seeds where these are close, or of a half of those that are needed
    together; None: all are made.
    """
    if len(names) < 2:
        return None
    trial = trials.get((place, names))
    if trial is None:
        return place, names, SEEDS[0]
    if trial.state == "close" and trial.seeds < len(SEEDS):
        return place, names, SEEDS[trial.seeds]
    if trial.state in ("no effect", "not needed", "slower") or len(names) < _LEAST_SPLIT:
        return None
    middle = len(names) // 2
    halves = (untried_part(trials, place, part) for part in (names[:middle], names[middle:]))
    return next(filter(None, halves), None)


def verdict(trials: Trials, name: str, places: Sequence[str]) -> tuple[str, str, Trial | None]:
    """Return the verdict on a branch, the set that decides, and its comparison there.

    Args:
        trials: all comparisons.
        name: of the branch.
        places: sets on which it acts.
    """
    results = {}
    for place in places:
        trial = trial_on(trials, name, place)
        if trial is not None:
            results[place] = trial
    if not results:
        return "not yet tried", "", None
    worst = min((trial.state for trial in results.values()), key=STATES.index)
    place = max(
        (place for place, trial in results.items() if trial.state == worst),
        key=lambda place: results[place].loss.tolerances,
    )
    tried = f"{len(results)} of {len(places)} sets"
    words = {
        "needed": "kept",
        "needed by little": f"kept by little on {tried}",
        "close": "needs more seeds" if results[place].seeds < len(SEEDS) else "undecided",
        "slower": "needs a quiet machine",
        "not needed": "goes" if len(results) == len(places) else f"not needed on {tried}",
        "no effect": f"no effect on {tried}",
    }
    return words[worst], place, results[place]
