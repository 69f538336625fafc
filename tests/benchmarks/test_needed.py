"""Every branch on trial: the table of branches, the rule, and a run that continues."""

import ast
from dataclasses import asdict
from pathlib import Path
from pkgutil import resolve_name

import pytest

import morgs_mi
from benchmarks.reports.branches import BRANCHES, PerWidth, groups, switched
from benchmarks.reports.needed import (
    RECORDINGS,
    branches_table,
    code_hash,
    rows_of,
    run_trial,
    sets_table,
)
from benchmarks.reports.trial_rule import SEEDS, compared, next_fit, trials_of, verdict
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.files import write_json

PACKAGE = Path(morgs_mi.__file__).parent
CONFIG = StreamConfig()
WIDTH = 320  # px
NAMES = [place for branch in BRANCHES for place in branch.switches if ":" in place]


def names_read_in_functions(path):
    """Names that code inside functions reads, without their defaults and decorators."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Lambda)]
    bodies = [node.body if isinstance(node.body, list) else [node.body] for node in functions]
    nodes = [node for body in bodies for part in body for node in ast.walk(part)]
    loads = {node.id for node in nodes if isinstance(node, ast.Name)}
    return loads | {node.attr for node in nodes if isinstance(node, ast.Attribute)}


def test_branches__have_names_of_their_own_and_agree_within_a_group():
    assert len({branch.name for branch in BRANCHES}) == len(BRANCHES)
    for group in groups():
        members = [branch for branch in BRANCHES if branch.group == group]
        places = {}
        for branch in members:
            for place, value in branch.switches.items():
                assert places.setdefault(place, value) is value, (group, place)


@pytest.mark.parametrize("branch", BRANCHES, ids=lambda branch: branch.name)
def test_switched__applies_a_branch_and_restores_everything(branch):
    places = {
        place: f"morgs_mi.{place.replace(':', '.')}" for place in branch.switches if ":" in place
    }
    originals = {place: vars_of(target) for place, target in places.items()}
    with switched([branch], CONFIG, WIDTH) as config:
        assert (config != CONFIG) == any(":" not in place for place in branch.switches)
        for place, target in places.items():
            value = branch.switches[place]
            value = value.at(WIDTH) if isinstance(value, PerWidth) else value
            assert vars_of(target) is value or vars_of(target) == value
    assert all(vars_of(target) is originals[place] for place, target in places.items())


def vars_of(target):
    """The entry of a module or class, as it stands there: properties are not evaluated."""
    owner, _, name = target.rpartition(".")
    return vars(resolve_name(owner))[name]


def test_branches__change_values_that_functions_read():
    """A name that only a default argument or another constant reads would switch nothing."""
    unread = []
    for place in NAMES:
        module, _, name = place.partition(":")
        source = PACKAGE / f"{module.replace('.', '/')}.py"
        *owner, attribute = name.split(".")
        sources = [*PACKAGE.rglob("*.py")] if owner else [source]
        if not any(attribute in names_read_in_functions(path) for path in sources):
            unread.append(place)
    assert unread == []
    equal = [
        branch.name
        for branch in BRANCHES
        for place, value in branch.switches.items()
        if ":" in place
        and isinstance(value, int | float)
        and vars_of(f"morgs_mi.{place.replace(':', '.')}") == value
    ]
    assert equal == []


def row(off=(), seed=0, place="a", **scores):
    """A fit of a set; scores are differences from the default's, which vary by 0.1 over seeds."""
    noise = 0.1 * seed
    base = {
        "psnr_first": 30.0,
        "psnr_later": 30.0 + noise,
        "psnr_moving": 25.0 + noise,
        "motion_error": 1.0 + noise,
        "bytes": 1000.0,
        "seconds": 1.0,
        "cpu_s": 2.0,
    }
    values = {name: value + scores.get(name, 0.0) for name, value in base.items()}
    stream = [seed, *off] if scores else [seed]
    return {"set": place, "off": list(off), "seed": seed, "code": "", "stream": stream, **values}


DEFAULTS = [row(seed=seed) for seed in SEEDS]


def three(spread=0.02, **scores):
    """Fits with three seeds, whose differences from the default vary."""
    return [
        row("x", seed, **{name: value + spread * (seed - 1) for name, value in scores.items()})
        for seed in SEEDS
    ]


# Differences without a branch, number of seeds, and the state of it that follows.
CASES = {
    "the same stream": ({}, 1, "no effect"),
    "more than 0.1 dB": ({"psnr_later": -0.15}, 1, "close"),
    "more than twice": ({"psnr_first": -0.25}, 1, "needed"),
    "a gain": ({"psnr_later": 3.0, "motion_error": -0.5, "bytes": -500}, 1, "not needed"),
    "moving, more": ({"psnr_moving": -0.25}, 1, "needed"),
    "motion, more": ({"motion_error": 0.3}, 1, "needed"),
    "bytes by 7 %": ({"bytes": 70}, 1, "needed"),
    "one slow fit": ({"seconds": 1.0, "cpu_s": 2.0}, 1, "not needed"),
    "three fits, 0.15 dB": ({"psnr_later": -0.15}, 3, "needed"),
    "three fits, moving by 0.15 dB": ({"psnr_moving": -0.15}, 3, "needed"),
    "three fits, moving by 0.05 dB": ({"psnr_moving": -0.05}, 3, "needed by little"),
    "three fits, moving by 0.05 and later by 0.12 dB": (
        {"psnr_moving": -0.05, "psnr_later": -0.12},
        3,
        "needed",
    ),
    "three fits, 0.12 dB within the noise": ({"psnr_later": -0.12, "spread": 0.2}, 3, "close"),
    "three slow fits": ({"seconds": 1.0, "cpu_s": 2.0}, 3, "slower"),
    "three fits, slow by one clock": ({"seconds": 1.0, "cpu_s": 0.0}, 3, "not needed"),
}


@pytest.mark.parametrize("name", CASES)
def test_compared__states_of_paired_fits(name):
    scores, seeds, state = CASES[name]
    without = three(**scores) if seeds == 3 else [row("x", **scores)]
    assert compared(DEFAULTS[:seeds], without, DEFAULTS).state == state


def test_verdict__by_all_sets():
    both = [*DEFAULTS, *(row(seed=seed, place="b") for seed in SEEDS)]
    fine = {"psnr_later": -0.01}
    rows = {
        "gone": [row(["x"], **fine), row(["x"], place="b", **fine)],
        "one": [row(["x"], **fine)],
        "kept": [row(["x"], **fine), row(["x"], place="b", psnr_later=-1.0)],
        "company": [row(["x", "y"], **fine), row(["x"], place="b", **fine)],
        "never": [row(["x"]), row(["x", "y"], place="b")],
        "untried": [row(["y"], **fine), row(["x", "y"], psnr_later=-1.0)],
    }
    words = {name: verdict(trials_of([*both, *r]), "x", "ab")[0] for name, r in rows.items()}
    assert words == {
        "gone": "goes",
        "one": "not needed on 1 of 2 sets",
        "kept": "kept",
        "company": "goes",
        "never": "no effect on 2 of 2 sets",
        "untried": "not yet tried",
    }


GROUPS = {"a": [["x", "y", "z"], ["u"]], "b": [["x", "y", "z"], []]}


def fake(needed, close=()):
    """A fit in which some branches are needed on set a, and others close to it."""

    def fit(place, off, seed):
        loss = {"a": 1.0, "b": 0.0}[place] * len({*needed} & {*off})
        loss += 0.15 * len({*close} & {*off})
        scores = row(off, seed, place, psnr_later=-loss, bytes=float(len(off)))
        return {name: scores[name] for name in scores.keys() - {"set", "off", "seed", "code"}}

    return fit


def test_next_fit__groups_first_then_single_ones_then_seeds_then_all_together():
    rows = run_trial(None, GROUPS, fake(needed="x", close="z"))
    fits = [(r["set"], "".join(r["off"]), r["seed"]) for r in rows]
    assert fits == [
        *(("a", "", seed) for seed in SEEDS),
        ("a", "xyz", 0),  # needed
        ("a", "x", 0),  # needed, and not tried again
        ("a", "y", 0),
        ("a", "z", 0),  # close
        ("a", "u", 0),
        ("a", "z", 1),
        ("a", "z", 2),  # needed
        ("a", "yu", 0),
        *(("b", "", seed) for seed in SEEDS),
        ("b", "y", 0),
    ]
    assert next_fit(rows, GROUPS) is None


def test_next_fit__halves_of_branches_that_stand_in_for_each_other():
    names = tuple("abcdefghijkl")

    def fit(place, off, seed):
        scores = row(off, seed, place, psnr_later=-float({"a", "l"} <= {*off}))
        return {name: scores[name] for name in scores.keys() - {"set", "off", "seed", "code"}}

    rows = run_trial(None, {"a": [names]}, fit)
    assert [tuple(r["off"]) for r in rows if len(r["off"]) > 1] == [names, names[:6], names[6:]]


def test_run_trial__continues_fit_by_fit_and_by_code(tmp_path):
    path = tmp_path / "fits.json"
    count = 0

    def fit(*args):
        nonlocal count
        count += 1
        return fake("x")(*args)

    run_trial(path, GROUPS, fit, most=4)
    assert len(read_json(path)["fits"]) == count == 4
    rows = run_trial(path, GROUPS, fit)
    assert rows == run_trial(None, GROUPS, fake("x"))
    assert run_trial(path, GROUPS, fit) == rows == read_json(path)["fits"]
    assert count == len(rows)
    # Fits of other code stay in the file, and count only if that is asked for.
    others = [{**r, "code": "other"} for r in rows]
    write_json(path, {"fits": others})
    assert run_trial(path, GROUPS, fit, any_commit=True) == others
    assert run_trial(path, GROUPS, fit, most=1)[0]["code"] == code_hash()
    document = read_json(path)
    assert document["fits"][:-1] == others
    assert rows_of(document) == document["fits"][-1:]


def test_tables__have_every_branch_and_set():
    rows = [row(seed=seed, place="demo") for seed in SEEDS]
    rows += [row(["search"], place="demo", psnr_moving=-0.5, bytes=1.0)]
    rows += [row(["offset", "offset loss"], place="demo", bytes=20.0)]
    text = branches_table(rows)
    names = [
        name.partition(" (")[0]
        for line in text.splitlines()[2:]
        for name in line.strip("| ").split(" | ")[2].split("; ")
    ]
    assert sorted(names) == sorted(branch.name for branch in BRANCHES)
    assert "| kept | search (demo: -0.50 dB where things move) |" in text
    assert "| offset | not needed | offset; offset loss |" in text
    assert len(sets_table(rows).splitlines()) == len(RECORDINGS) + 2
    assert all(asdict(recording)["frames"] for recording in RECORDINGS.values())
