"""Sweeps: arms continue one first frame, their scores are those of an evaluation, and fits that are
there are not made again. Parts are left out alone and together.
"""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.core.bounded import read_json
from morgs_mi.core.config import apply_values, config_toml, read_config
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.extras.sweep import sweep as module
from morgs_mi.extras.sweep.sweep import (
    PARTS,
    TITLES,
    SweepResult,
    leave_out,
    stored_scores,
    sweep,
)
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.streams import open_stream
from tests.cli.commands import assert_refused, interrupt
from tests.cli.conftest import run
from tests.quick import quick
from tests.scenes.recording import CONFIG, write_recording

__all__ = ["run"]

# Provisional first frames come from its rounds of density control.
QUICK = quick(density=DensityConfig(rounds=2, later_frames=False))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "5",
        "[]",
        "null",
        '{"made": []}',
        '{"made": [], "scores": 5}',
        '{"made": [], "scores": [1, 2]}',
        '{"made": [], "scores": [[1], [2, 3]]}',
        '{"made": [], "scores": [[1, "x"]]}',
    ],
)
def test_stored_scores__refuse_what_no_sweep_has_written(tmp_path, text):
    (tmp_path / "scores.json").write_text(text)
    with pytest.raises(ValueError, match=r"scores\.json: expected the scores of a fit, got a bro"):
        stored_scores(tmp_path / "scores.json")


def test_stored_scores__have_none_where_a_score_is_unknown(tmp_path):
    for scores in ([1.0, 2.0, None, 4, 5, 6], [[1.0, None], [2, 3]]):
        (tmp_path / "scores.json").write_text(json.dumps({"made": [{}, None], "scores": scores}))
        assert stored_scores(tmp_path / "scores.json") == ([{}, None], scores)


@pytest.mark.slow
def test_sweep__arms_continue_one_first_frame_and_are_not_fitted_again(tmp_path, monkeypatch):
    capture = load_capture(write_recording(tmp_path / "clip", 3), test_view=0)
    out = tmp_path / "out"
    arguments = (capture, ("default", "baseline"), (2, 1), 2, 2, out, QUICK)
    result = sweep(*arguments)
    arms = [*zip(result.arms, result.epochs, strict=True)]
    assert arms == [("default", 1), ("default", 2), ("baseline", 1), ("baseline", 2)]
    first_packets = (set(), set())
    for (arm, epochs), scores in zip(arms, result.scores, strict=True):
        for seed in range(2):
            folder = out / f"{arm}-epochs{epochs}-seed{seed}"
            stream = open_stream(folder)
            config = stream.metadata["config"]
            assert (config["fit"]["epochs"], config["seed"]) == (epochs, seed)
            assert config["motion"]["learn_motion"] == (arm == "default")
            assert [packet.frame for packet in stream] == [0, 1]
            first_packets[seed].add(next(iter(stream)).encoded)
            evaluation = evaluate_stream(folder)
            first, later = (frame.scores.psnr for frame in evaluation.frames)
            expected = [evaluation.seconds.first, evaluation.seconds.per_later_frame, later]
            assert scores[seed, :3].tolist() == expected
            assert result.first_frames[seed][-1][1] == first
    assert [len(packets) for packets in first_packets] == [1, 1]
    assert first_packets[0] != first_packets[1]
    for curve in result.first_frames:
        seconds = [second for second, _ in curve]
        assert len(curve) >= 3
        assert seconds == sorted(seconds)

    document = read_json(out / "sweep.json")
    assert document["scores"][3][1][2] == result.scores[3, 1, 2]

    monkeypatch.setattr(module, "stream_capture", interrupt)
    states = []
    again = sweep(*arguments, lambda *state: states.append(state))
    assert states == [("Fitting and evaluating", 8, 8)], "fits that are there have no pace"
    assert_array_equal(again.scores, result.scores)
    assert again.table == result.table
    with pytest.raises(KeyboardInterrupt):
        sweep(*arguments[:4], 3, out, QUICK)


@pytest.mark.slow
def test_leave_out__parts_of_the_first_frame_have_their_own(tmp_path, monkeypatch, run):
    names = ("offset", "exposure")
    monkeypatch.setattr(module, "PARTS", {name: PARTS[name] for name in names})
    clip = write_recording(tmp_path / "clip", 2)
    out = tmp_path / "out"
    settings = tmp_path / "settings.toml"
    settings.write_text(config_toml(replace(CONFIG, seed=5)))
    options = ("--seeds", 1, "--frames", 2, "--config", settings, "--tolerance", 100)
    status, output, error = run("sweep", clip, out, "--leave-out", *options)
    assert status == 0, error
    for name in names:
        config = open_stream(out / f"without-{name}-epochs2-seed0").metadata["config"]
        assert config["motion"]["learn_offset"] == (name != "offset")
        assert config["fit"]["exposure"] == ("off" if name == "exposure" else "auto")
    # Whether a part is needed also depends on the seconds, which the load of the machine changes.
    sentence = next(line for line in output.splitlines() if line.startswith("Within 100 dB"))
    config = apply_values(StreamConfig(), read_config(out / "leave-out.toml"))
    assert config.motion.learn_offset != ("offset" in sentence)
    assert (config.fit.exposure == "off") == ("exposure" in sentence)
    assert (out / "leave-out.png").stat().st_size > 10_000


def fake_fits(changes):
    """Return a function in place of `fit_arms`: the scores change by what the parts that an arm
    lacks make of them.
    """

    def fit_arms(arms, *_):
        scores = np.ones((len(arms), 2, len(TITLES)))
        for k, (name, *_) in enumerate(arms[1:], 1):
            scores[k] += changes(name.removeprefix("without ").split(", "))
        names = [name for name, *_ in arms]
        return SweepResult(
            "clip", True, names, [8] * len(arms), scores, [[(1.0, 20.0), (2.0, 21.0)]] * 2
        )

    return fit_arms


def with_changes(parts):
    """Search and propagation stand in for each other, the moving pixels need the offset, the motion
    the flow guidance, the time the active set and the size the exposure.
    """
    lost = {"search", "propagation"} <= {*parts}
    needs = [part in parts for part in ("active set", "offset", "flow guidance", "exposure")]
    seconds, moving, motion, size = np.array(needs, float)
    return np.array([0, seconds, -1.0 * lost - 0.01 * ("search" in parts), -moving, motion, size])


@pytest.mark.parametrize(
    ("changes", "needed"),
    [
        (lambda parts: np.zeros(len(TITLES)), set()),
        (with_changes, {"flow guidance", "offset", "search", "active set", "exposure"}),
    ],
)
def test_leave_out__finds_the_parts_that_are_not_needed_together(
    tmp_path, monkeypatch, changes, needed
):
    monkeypatch.setattr(module, "fit_arms", fake_fits(changes))
    result = leave_out(None, out=tmp_path)
    left_out = [part for part in PARTS if part not in needed]
    assert ", ".join(left_out) in result.sentence
    assert (tmp_path / "leave-out.toml").read_text() == result.toml
    config = apply_values(StreamConfig(), tomllib.loads(result.toml))
    for part, text in PARTS.items():
        assert (apply_values(config, tomllib.loads(text)) == config) == (part in left_out)
    *rows, last_row = result.table[2:]
    assert [row[-1] == "yes" for row in rows] == [part in needed - {"search"} for part in PARTS]
    assert last_row[-1] == "no"


def test_leave_out__may_find_that_all_parts_are_needed(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "fit_arms", fake_fits(lambda parts: np.full(6, -9)))
    result = leave_out(None, out=tmp_path)
    assert "needs each of the parts" in result.sentence
    assert result.toml == ""


def test_sweep__is_a_table_and_a_plot_in_a_notebook():
    pytest.importorskip("matplotlib", reason="comes with the extra `plots`")
    scores = np.array([[[9.0, k, 29 + k, np.nan, np.nan, 4 + k]] * 2 for k in (1, 2)])
    # The second seed has balanced exposures in one round less.
    curves = [[(0.5, 18.0), (1.0, 20.0), (2.0, 21.0)], [(1.0, 20.0), (2.0, 21.0)]]
    table = [["arm", "kB"], ["<default>", "5"]]
    text = SweepResult("clip", True, ["default"] * 2, [1, 2], scores, curves, table)._repr_html_()
    assert "<td>arm<td>kB<tr><td>&lt;default&gt;<td>5</table>" in text
    assert "data:image/png;base64,iVBOR" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--seeds", 0), "seeds must be at least 1, got 0"),
        (("--frames", 1), "frames must be at least 2, got 1"),
    ],
)
def test_sweep__refuses(tmp_path, run, options, message):
    clip = write_recording(tmp_path / "clip", 2)
    assert_refused(run("sweep", clip, tmp_path / "out", *options), message)
    assert not (tmp_path / "out").exists()
