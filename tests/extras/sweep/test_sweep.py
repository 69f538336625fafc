"""Sweeps: arms continue one first frame, their scores are those of an evaluation, and fits that are
there are not made again. Parts are left out alone and together.
"""

import re
import tomllib
from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.extras.sweep import fits as fits_module
from morgs_mi.extras.sweep import sweep as module
from morgs_mi.extras.sweep.clock import Clock
from morgs_mi.extras.sweep.fits import Fits, StoredFit
from morgs_mi.extras.sweep.statistics import INDEX, SCORES
from morgs_mi.extras.sweep.sweep import PARTS, leave_out, sweep
from morgs_mi.extras.sweep.vary import Vary
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.config import apply_values, config_toml, read_config
from morgs_mi.platform.files import write_json
from morgs_mi.platform.progress import name_of
from morgs_mi.playback.streams import open_stream
from tests.cli.commands import interrupt
from tests.cli.conftest import run
from tests.quick import NO_DENSITY, quick
from tests.scenes.recording import CONFIG, recording, write_recording

__all__ = ["run"]

QUICK = quick(density=NO_DENSITY)


def test_sweep__writes_nothing_into_a_capture(tmp_path):
    capture = load_capture(write_recording(tmp_path / "clip"))
    content = {*(tmp_path / "clip").rglob("*")}
    with pytest.raises(ValueError, match="expected an output outside of captures"):
        sweep(capture, out=tmp_path / "clip" / "results", seeds=1)
    assert {*(tmp_path / "clip").rglob("*")} == content


@pytest.mark.slow
def test_sweep__arms_continue_one_first_frame_and_are_not_fitted_again(tmp_path, monkeypatch):
    capture = load_capture(write_recording(tmp_path / "clip", 3), test_view=0)
    out = tmp_path / "out"
    configs = {"default": QUICK, "baseline": apply_preset(QUICK, "baseline")}
    arguments = (capture, configs, Vary((2, 1), (9, 6)), 2, 2, out)
    states = []
    result = sweep(*arguments, lambda *state: states.append(state))
    stages, counts, totals = zip(*states, strict=True)
    assert {name_of(stage) for stage in stages} == {"Fitting and evaluating"}
    assert counts == tuple(sorted(counts))
    assert {*totals} == {12}
    arms = [(arm.name, arm.point) for arm in result.arms]
    first_arms = [("default and baseline", 6), ("default and baseline", 9)]
    later_arms = [("default", 1), ("baseline", 1), ("default", 2), ("baseline", 2)]
    assert arms == [*first_arms, *later_arms], "the cheapest first"
    first_packets = (set(), set())
    for (name, epochs), scores in zip(later_arms, result.scores[2:], strict=True):
        for seed in range(2):
            folder = out / f"{name}-epochs{epochs}-seed{seed}"
            stream = open_stream(folder)
            config = stream.metadata["config"]
            assert (config["fit"]["epochs"], config["seed"]) == (epochs, seed)
            assert config["motion"]["learn_motion"] == (name == "default")
            assert [packet.frame for packet in stream] == [0, 1]
            first_packets[seed].add(next(iter(stream)).encoded)
            evaluation = evaluate_stream(folder)
            later = evaluation.frames[1]
            expected = {
                "first_seconds": evaluation.seconds.first,
                "seconds": later.seconds,
                "psnr": later.scores.psnr,
                "kilobytes": later.num_bytes / 1e3,
            }
            assert {name: scores[seed, INDEX[name]] for name in expected} == expected
    assert [len(packets) for packets in first_packets] == [1, 1]
    assert first_packets[0] != first_packets[1]
    document = read_json(out / "sweep.json")
    assert document["complete"]
    assert document["scores"] == np.where(np.isnan(result.scores), None, result.scores).tolist()
    assert document["settings"]["configs"]["baseline"]["fit"]["num_gaussians"] == 80

    monkeypatch.setattr(fits_module, "stream_capture", interrupt)
    states = []
    again = sweep(*arguments, lambda *state: states.append(state))
    assert states == [("Fitting and evaluating", 12, 12)], "fits that are there have no pace"
    assert_array_equal(again.scores, result.scores)
    assert again.tables == result.tables


@pytest.mark.slow
def test_sweep__measures_lpips_of_fits_that_are_there(tmp_path, monkeypatch):
    class HalfLpips:
        def __init__(self, path):
            assert path == "net:1.onnx"

        def distance_map(self, image, truth):
            return np.full((1, 1), 0.5)

    capture = load_capture(write_recording(tmp_path / "clip", 2), test_view=0)
    arguments = (capture, {"mine": QUICK})
    out = tmp_path / "out"
    result = sweep(*arguments, Vary((1,), ()), 1, out=out)
    assert np.isnan(result.scores[0, 0, INDEX["lpips"]])
    monkeypatch.setattr(fits_module, "Lpips", HalfLpips)
    monkeypatch.setattr(fits_module, "stream_capture", interrupt)
    again = sweep(*arguments, Vary((1,), (), "lpips:net:1.onnx"), 1, out=out)
    assert again.scores[0, 0, INDEX["lpips"]] == 0.5
    assert again.scores[0, 0, INDEX["psnr"]] == result.scores[0, 0, INDEX["psnr"]]


@pytest.mark.slow
def test_sweep__has_what_was_fitted_after_an_interruption(tmp_path, monkeypatch, run):
    clip = write_recording(tmp_path / "clip", 2)
    out = tmp_path / "out"
    settings = tmp_path / "settings.toml"
    settings.write_text(config_toml(QUICK))
    fit = fits_module.stream_capture

    def fit_until_the_second_arm(capture, folder, *arguments):
        if "epochs2" in folder.name:
            raise KeyboardInterrupt
        return fit(capture, folder, *arguments)

    monkeypatch.setattr(fits_module, "stream_capture", fit_until_the_second_arm)
    varied = ("--presets", "default", "--epochs", 1, 2, "--first-frame-steps", 6)
    options = (*varied, "--seeds", 1, "--config", settings)
    status, output, error = run("sweep", clip, out, *options)
    assert status == 130
    assert "Interrupted. The same command goes on" in error
    assert "later frame: means over the seeds" in output
    document = read_json(out / "sweep.json")
    psnr = np.array(document["scores"], float)[:, 0, INDEX["psnr"]]
    assert np.isfinite(psnr).tolist() == [True, True, False]
    assert not document["complete"]

    monkeypatch.undo()
    status, output, error = run("sweep", clip, out, *options)
    assert status == 0, error
    assert read_json(out / "sweep.json")["complete"]
    assert np.array(read_json(out / "sweep.json")["scores"])[0, 0, INDEX["psnr"]] == psnr[0]


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
    assert len([*out.glob("first-frame-*")]) == 2
    sentence = next(line for line in output.splitlines() if line.startswith("Within 100 dB"))
    config = apply_values(StreamConfig(), read_config(out / "leave-out.toml"))
    assert config.motion.learn_offset != ("offset" in sentence)
    assert (config.fit.exposure == "off") == ("exposure" in sentence)


def fake_fits(changes):
    """Return a function in place of `fit_arms`: the scores change by what the settings that leave
    out some parts make of them.
    """

    def fit_arms(arms, capture, seeds, out, measure, progress, on_fit):
        fits = Fits.of(len(arms), seeds)
        fits.scores[:] = 1
        fits.calls[:] = arms[0].name
        for k, arm in enumerate(arms):
            parts = [
                part
                for part, text in PARTS.items()
                if apply_values(arm.config, tomllib.loads(text)) == arm.config
            ]
            for name, change in changes(parts).items():
                fits.scores[k, :, INDEX[name]] += change
            fits.clocks.append(Clock())
        return fits

    return fit_arms


def with_changes(parts):
    """Search and propagation stand in for each other, the moving pixels need the offset, the motion
    the flow guidance, the time the active set and the size the exposure.
    """
    lost = {"search", "propagation"} <= {*parts}
    return {
        "psnr": -1.0 * lost - 0.01 * ("search" in parts),
        "psnr_moving": -1.0 * ("offset" in parts),
        "motion_error_moving": 1.0 * ("flow guidance" in parts),
        "kilobytes": 1.0 * ("exposure" in parts),
        "seconds": 1.0 * ("active set" in parts),
    }


REASONS = {
    "flow guidance": "motion error",
    "offset": "moving PSNR",
    "active set": "later frame",
    "exposure": "size",
}


@pytest.fixture
def no_plots(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)


@pytest.mark.usefixtures("no_plots")
@pytest.mark.parametrize(
    ("changes", "reasons"), [(lambda parts: {}, {}), (with_changes, {**REASONS, "search": ""})]
)
def test_leave_out__finds_the_parts_that_are_not_needed_together(
    tmp_path, monkeypatch, changes, reasons
):
    monkeypatch.setattr(module, "fit_arms", fake_fits(changes))
    result = leave_out(recording(), seeds=2, out=tmp_path)
    left_out = [part for part in PARTS if part not in reasons]
    assert ", ".join(left_out) in result.sentence
    assert (tmp_path / "leave-out.toml").read_text() == result.toml
    config = apply_values(StreamConfig(), tomllib.loads(result.toml))
    for part, text in PARTS.items():
        assert (apply_values(config, tomllib.loads(text)) == config) == (part in left_out)
    (table,) = result.tables.values()
    expected = [reasons.get(part) or "not needed" for part in PARTS]
    assert [row[-1] for row in table[2 : 2 + len(PARTS)]] == expected
    assert table[-1][0] == f"{len(left_out)} together"
    assert table[-1][-1] == "not needed"


@pytest.mark.usefixtures("no_plots")
def test_leave_out__may_find_that_all_parts_are_needed(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "fit_arms", fake_fits(lambda parts: {"psnr": -9.0 * len(parts)}))
    result = leave_out(recording(), seeds=2, out=tmp_path)
    assert "needs each of the parts" in result.sentence
    assert result.toml == ""


@pytest.mark.usefixtures("no_plots")
@pytest.mark.parametrize("vary", [Vary(), Vary(measure="motion_error_moving"), Vary(epochs=())])
def test_sweep__rows_fit_80_columns_with_whole_names(tmp_path, monkeypatch, vary):
    monkeypatch.setattr(module, "fit_arms", fake_fits(lambda parts: {"psnr": 30, "seconds": 12}))
    configs = {"ml-mo-mc": StreamConfig(), "with few Gaussians": StreamConfig()}
    result = sweep(recording(), configs, vary, out=tmp_path)
    assert result.tables
    for table in (*result.tables.values(), *leave_out(recording(), out=tmp_path).tables.values()):
        titles, *rows = table
        # Where a terminal is narrow, the seconds of the first frame are left out of `leave_out`.
        is_narrow = "without" in titles
        widths = [
            max(map(len, "\n".join(column).split("\n")))
            for column in zip(titles, *rows, strict=True)
            if not (is_narrow and column[0].startswith("first"))
        ]
        assert sum(widths) + 2 * len(widths) <= 80


@pytest.mark.usefixtures("no_plots")
def test_sweep__configs_with_one_first_frame_share_its_curve(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "fit_arms", fake_fits(lambda parts: {}))
    configs = {
        "default": StreamConfig(),
        "baseline": apply_preset(StreamConfig(), "baseline"),
        "long": StreamConfig(fit=FitConfig(first_frame_steps=9000)),
        "flat": StreamConfig(fit=FitConfig(sh_degree=0)),
    }
    result = sweep(recording(), configs, Vary((2,), (5, 3)), out=tmp_path)
    assert [*result.curves(True)] == ["default and baseline and long", "flat"]
    assert [*result.curves(False)] == [*configs]
    assert result.reference.tolist() == [0, 0, 2, 2, 4, 4, 4, 4]


@pytest.mark.usefixtures("no_plots")
def test_sweep__is_tables_and_a_plot_in_a_notebook(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="comes with the extra `plots`")
    monkeypatch.setattr(module, "fit_arms", fake_fits(lambda parts: {}))
    text = sweep(recording(), {"a b": StreamConfig()}, out=tmp_path)._repr_html_()
    assert "<tr><td>a b<td>1<td>1.00<td>1.00" in text
    assert "data:image/png;base64,iVBOR" in text
    assert "density control" in leave_out(recording(), out=tmp_path)._repr_html_()


def test_sweep__draws_whatever_is_fitted_so_far(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="comes with the extra `plots`")

    def fit_arms(arms, capture, seeds, out, measure, progress, on_fit):
        fits = Fits.of(len(arms), seeds)
        on_fit(fits)
        for seed, k in np.ndindex(seeds, len(arms)):
            fits.scores[k, seed] = np.where(np.arange(len(SCORES)) == INDEX["lpips"], np.nan, k + 1)
            fits.calls[k, seed] = "call"
            fits.clocks.append(Clock())
            on_fit(fits)
            assert (out / f"{name}.png").stat().st_size > 1000
        return fits

    monkeypatch.setattr(module, "fit_arms", fit_arms)
    monkeypatch.setattr(module, "PARTS", {name: PARTS[name] for name in ("offset",)})
    name = "sweep"
    sweep(recording(), configs=("s",), vary=Vary((1,), (9,)), seeds=2, out=tmp_path)
    name = "leave-out"
    leave_out(recording(), seeds=2, out=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"configs": ("defaults",)}, "`configs` must be a list, each item one of default, l, s"),
        ({"configs": {"mine": {}}}, "`configs['mine']` must be"),
        ({"configs": {3: StreamConfig()}}, "`name of a config` must be"),
        ({"configs": {}}, "expected a config and something to vary, got none"),
        ({"vary": (1, 2)}, "`vary` must be"),
        ({"vary": Vary(epochs=(0,))}, "`epochs` must be a list, each item at least 1"),
        ({"vary": Vary(first_frame_steps=(1.5,))}, "`first_frame_steps` must be"),
        ({"vary": Vary(measure="mse")}, "`measure` must be one of psnr, psnr_moving"),
        ({"frames": "8"}, "`frames` must be a whole number"),
        ({"frames": 1}, "`frames` must be at least 2, got 1"),
        ({"seeds": -1}, "`seeds` must be at least 1, got -1"),
    ],
)
def test_sweep__refuses(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=r"^sweep\(\): ") as refusal:
        sweep(recording(), out=tmp_path / "out", **arguments)
    assert message in str(refusal.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": -1}, "`tolerance` must be at least 0, got -1"),
        ({"tolerance": float("nan")}, "`tolerance` must be a finite number"),
        ({"config": {}}, "`config` must be"),
        ({"seeds": 0}, "`seeds` must be at least 1, got 0"),
    ],
)
def test_leave_out__refuses(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        leave_out(recording(), out=tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "text",
    [
        "5",
        '{"made": []}',
        '{"clock": {"x": 1}, "scores": []}',
        '{"clock": {}, "scores": 5}',
        '{"clock": {}, "scores": [1]}',
        '{"clock": {}, "scores": [1, 2, 3, 4, 5, 6, 7, "x"]}',
        '{"clock": {}, "scores": [1, 2, 3, 4, 5, 6, 7, 8], "x": 1}',
    ],
)
def test_stored_fit__refuses_what_no_sweep_has_written(tmp_path, text):
    (tmp_path / "scores.json").write_text(text)
    with pytest.raises(ValueError, match=r"scores\.json: expected the scores of a fit, got a bro"):
        fits_module.stored_fit(tmp_path / "scores.json")


def test_stored_fit__is_what_was_written(tmp_path):
    scores = [1.0, 2.0, 3.0, 4.0, 0.5, None, None, 8.0]
    fit = StoredFit([{}, None], Clock("date", "call", 1.0, 2.0, 3.0, 4.0), "", scores)
    write_json(tmp_path / "scores.json", asdict(fit))
    assert fits_module.stored_fit(tmp_path / "scores.json") == fit


def test_first_frame_config__is_shared_by_the_presets_and_parts_of_later_frames():
    first = fits_module.first_frame_config
    presets = ["l", "s", "baseline", "ml", "ml-mo", "ml-mo-mc", "paper"]
    configs = [first(apply_preset(StreamConfig(), name)) for name in presets]
    assert all(config == first(StreamConfig()) for config in configs)
    first_parts = [
        part
        for part, text in PARTS.items()
        if first(apply_values(StreamConfig(), tomllib.loads(text))) != first(StreamConfig())
    ]
    assert first_parts == ["density control", "SH above 0", "exposure"]
