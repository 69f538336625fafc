"""Report on the method: every figure results from the fits."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.reports import __main__ as cli
from benchmarks.reports import method
from benchmarks.reports.method import Options, aggregate, settings_of, variants_of
from benchmarks.reports.method_tables import (
    ablation_table,
    best_rows,
    gains_table,
    key_views_rows,
    key_views_table,
)
from benchmarks.reports.study import Variant
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from tests.benchmarks.reports.pages import ROOT, page

ARGS = [
    "--presets",
    "baseline",
    "default",
    "--epochs",
    "1",
    "2",
    "--key-views",
    "1",
    "2",
    "99",
    "--rates",
    "1",
    "2",
]
ARGS += ["--tuned", "baseline", "--seeds", "1", "--num-gaussians", "200"]
ARGS += [
    "--stream.fit.sh-degree",
    "0",
    "--stream.fit.first-frame-steps",
    "10",
    "--stream.fit.confidence-steps",
    "2",
]


def tiny(clip: Path, out: Path) -> Options:
    """Return the options of `ARGS`."""
    fit = FitConfig(sh_degree=0, first_frame_steps=10, confidence_steps=2)
    return Options(
        captures=(clip,),
        out=out,
        presets=("baseline", "default"),
        epochs=(1, 2),
        key_views=(1, 2, 99),
        rates=(1, 2),
        tuned=("baseline",),
        seeds=1,
        num_gaussians=200,
        stream=StreamConfig(fit=fit),
    )


def made_up(clip, keyframe, config):
    """Return scores in place of a fit's; more epochs and key views are better."""
    score = 20.0 + config.fit.epochs + 0.1 * config.motion.key_views + 100 * config.fit.rates.means
    names = (
        "psnr",
        "psnr_moving",
        "psnr_still",
        "ssim",
        "motion_error_moving",
        "motion_error_still",
    )
    names += (
        "true_motion_moving",
        "num_bytes",
        *(f"motion_3d_{name}" for name in method._MOTION_3D),
    )
    frames = {name: [score - 1, score + 1] for name in method._BY_FRAME}
    rest = {
        "confidence_iou": None,
        "mtv": 0.5,
        "mtv_input": 0.6,
        "psnr_slope": 2.0,
        "seconds": 0.1 * score,
    }
    return dict.fromkeys(names, score) | rest | {"by_frame": frames}


@pytest.fixture(scope="module", params=["made up", pytest.param("fitted", marks=pytest.mark.slow)])
def reported(request, clip, tmp_path_factory):
    """A report: its JSON, its folder and the number of fits."""
    out = tmp_path_factory.mktemp("report")
    fits = []
    fit = made_up if request.param == "made up" else method.later_frames

    def counted(clip, keyframe, config):
        fits.append(config)
        return fit(clip, keyframe, config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(method, "later_frames", counted)
        assert cli.main(["method", str(clip), "--out", str(out), *ARGS]) == 0
    return json.loads((out / "method.json").read_text()), out, len(fits)


@pytest.mark.slow
def test_method_command__fits_every_setting(reported):
    result, out, fits = reported
    # 2 epochs of a default and a baseline at 2 rates; 2 presets with 1, 2 and all 4 views at 2
    # epochs.
    assert fits == 6 + 6
    (clip,) = result["clips"]
    assert [(row["preset"], row["epochs"], row["rates"]) for row in best_rows(clip)[2:]] == [
        ("default", 1, 1.0),
        ("default", 2, 1.0),
    ]
    order = [(row["preset"], row["key_views"]) for row in key_views_rows(clip)]
    assert order == [(preset, views) for preset in ("ml", "ml-mo") for views in (1, 2, 4)]
    pytest.importorskip("matplotlib")
    assert (out / "method.png").stat().st_size > 10_000


@pytest.mark.slow
def test_method_command__scores_are_those_of_the_held_out_view(reported):
    (clip,) = reported[0]["clips"]
    for row in clip["rows"] + clip["key_view_rows"]:
        mean = row["mean"]
        assert mean["psnr"] == pytest.approx(sum(row["by_frame"]["psnr"]) / 2, rel=1e-4)
        assert 5 < mean["psnr"] < 40
        assert mean["seconds"] > 0
        assert 0 < mean["motion_error_moving"] < 5 * mean["true_motion_moving"]
        assert mean["mtv_input"] == clip["rows"][0]["mean"]["mtv_input"]
        assert set(row["std"].values()) == {None}, "of a single run"
    assert 0 < clip["cue"]["error"] < 2


@pytest.mark.slow
def test_method_tables__are_complete(reported):
    (clip,) = reported[0]["clips"]
    for table, rows in (
        (ablation_table(clip, 2), 2),
        (key_views_table(clip), 6),
    ):
        lines = table.splitlines()
        assert len(lines) == 2 + rows
        assert len({line.count("|") for line in lines}) == 1
        assert "nan" not in table


def test_gains_table__has_the_best_rates():
    def row(preset: str, epochs: int, rates: float, best: bool, psnr: float, error: float) -> dict:
        mean = {"psnr": psnr, "psnr_moving": psnr - 10, "motion_error_moving": error, "mtv": None}
        return {
            "preset": preset,
            "epochs": epochs,
            "key_views": 4,
            "rates": rates,
            "mean": mean,
            "best": best,
        }

    rows = [row("baseline", 8, 1, False, 30.0, 2.0), row("baseline", 8, 4, True, 31.0, 3.0)]
    rows += [
        row("ml", 8, 1, True, 32.5, 1.5),
        row("default", 8, 2, True, 33.0, 0.9),
        row("default", 2, 1, True, 31, 1),
    ]
    clip = {"name": "balls", "cue": {"error": 0.5}, "rows": rows}
    gains = [line.split(" | ") for line in gains_table([clip]).splitlines()]
    assert gains[3][:4] == ["| balls", "8", "+1.50 / +1.50 / -1.50", "- / - / -"]


@pytest.mark.slow
def test_later_frames__has_the_scores_of_a_fit(clip, tmp_path):
    """One genuine fit; the fixture `reported` makes up its scores unless slow tests run."""
    options = replace(tiny(clip, tmp_path), presets=("default",), epochs=(1,), key_views=())
    (row,) = method.measure(clip, options)["rows"]
    mean = row["mean"]
    assert mean["psnr"] == pytest.approx(sum(row["by_frame"]["psnr"]) / 2, rel=1e-4)
    assert 5 < mean["psnr"] < 40
    assert mean["seconds"] > 0
    assert 0 < mean["motion_error_moving"] < 5 * mean["true_motion_moving"]
    assert mean.keys() | {"by_frame"} == made_up(None, None, options.base).keys()


def test_settings_of__changes_its_own_settings_only():
    base = Options(captures=()).base
    config = settings_of(base, "paper", 3, 2, 4.0)
    assert (config.fit.epochs, config.motion.key_views) == (3, 2)
    assert config.fit.rates.means == 4 * base.fit.rates.means
    assert config.fit.first_frame_rates == base.fit.first_frame_rates
    assert not config.motion.lift_flow
    assert settings_of(base, "default", base.fit.epochs, base.motion.key_views, 1.0) == base


def test_aggregate__selects_the_best_rate_by_the_first_seed():
    rows = []
    variants = []
    for rate, values in ((1.0, (30.0, 40.0)), (2.0, (31.0, 33.0)), (4.0, (20.0,))):
        keys = {"preset": "baseline", "epochs": 2, "key_views": 4, "rates": rate}
        variants.append(Variant(keys, StreamConfig()))
        for seed, psnr in enumerate(values):
            rows.append(
                {
                    **keys,
                    "fit_seed": seed,
                    "psnr": psnr,
                    "ssim": None,
                    "by_frame": {"psnr": [psnr, 1.0]},
                }
            )
    table = aggregate(rows, variants)
    assert [row["best"] for row in table] == [False, True, False]
    assert table[1]["mean"]["psnr"] == 32
    assert table[1]["std"]["psnr"] == pytest.approx(2**0.5)
    assert table[1]["by_frame"]["psnr"] == [32, 1]
    assert table[1]["mean"]["ssim"] is None
    assert len(aggregate(rows, variants[:1])) == 1


def test_variants_of__tunes_the_given_presets_and_limits_the_key_views():
    presets, key_views = (
        [v.keys for v in group] for group in variants_of(tiny(Path(), Path()), num_views=3)
    )
    assert len(presets) == 2 * 3
    assert {keys["rates"] for keys in presets if keys["preset"] == "default"} == {1.0}
    assert {keys["key_views"] for keys in presets} == {3}
    assert {(keys["preset"], keys["key_views"]) for keys in key_views} == {
        (preset, views) for preset in ("ml", "ml-mo") for views in (1, 2, 3)
    }
    assert {keys["epochs"] for keys in key_views} == {2}


@pytest.mark.slow
def test_fitted__runs_later_seeds_at_the_best_rate_only(clip, tmp_path, monkeypatch):
    ran = []

    def scores(clip, keyframe, config):
        rates = round(config.fit.rates.means / FitConfig().rates.means)
        preset = "default" if config.motion.learn_motion else "baseline"
        ran.append((config.seed, preset, config.fit.epochs, rates))
        psnr = 30.0 + {1: 1, 2: 3, 4: 2}[rates] * (1 if config.fit.epochs == 2 else -1)
        return {"psnr": psnr + 10 * config.seed, "by_frame": {}}

    monkeypatch.setattr(method, "later_frames", scores)
    options = replace(tiny(clip, tmp_path), rates=(1, 2, 4), seeds=3, key_views=())
    result = method.measure(clip, options)
    assert [seed for seed, *_ in ran] == 8 * [0] + 4 * [1] + 4 * [2]
    expected = {("baseline", 1, 1), ("baseline", 2, 2), ("default", 1, 1), ("default", 2, 1)}
    assert {tuple(cell) for seed, *cell in ran if seed == 1} == expected
    best = {(row["preset"], row["epochs"]): row for row in best_rows(result)}
    for epochs, rates, psnr in ((1, 1, 39), (2, 2, 43)):
        row = best["baseline", epochs]
        assert (row["rates"], row["runs"], row["mean"]["psnr"]) == (rates, 3, psnr)


def test_options__refuse_bad_settings_and_captures(clip, tmp_path):
    with pytest.raises(
        ValueError, match=r"`presets` and `tuned` must be among default, .*, got none"
    ):
        Options(captures=(), presets=("ml", "none"))
    for name, value in (("epochs", ()), ("seeds", 0), ("presets", ())):
        with pytest.raises(ValueError, match="one seed or more, got none"):
            Options(captures=(), **{name: value})
    with pytest.raises(ValueError, match="with distinct names, got spheres, spheres"):
        replace(tiny(clip, tmp_path), captures=(clip, clip)).run()
    with pytest.raises(ValueError, match="two frames or more, got 1"):
        replace(tiny(clip, tmp_path), frames=1).run()


def test_method_report__has_the_figures_of_its_page():
    for name, section in (("method_report", "Four clips"), ("method_parts", "Parts")):
        result = json.loads((ROOT / f"benchmarks/results/{name}.json").read_text(encoding="utf-8"))
        (section_text,) = re.findall(
            rf"^## {section}\n(.*?)^##", page("method.md"), re.DOTALL | re.MULTILINE
        )
        figures = set(re.findall(r"\d+\.\d+", gains_table(result["clips"])))
        for clip in result["clips"]:
            rows = [row for row in best_rows(clip) for row in (row["mean"], row["std"])]
            rounded = (f"{v:.2f}" for row in rows for v in row.values() if v is not None)
            figures |= {*rounded, f"{clip['cue']['error']:.2f}"}
            figures |= {f"{row['psnr']:.2f}" for row in clip["scratch"]}
            figures |= {f"{row['by_frame']['psnr'][-1]:.2f}" for row in best_rows(clip)}
            errors = (row["mean"]["motion_error_moving"] for row in best_rows(clip))
            figures |= {f"{error / clip['cue']['error']:.2f}" for error in errors}
        assert set(re.findall(r"\d+\.\d+", section_text)) - figures == set()
        # Null means all frames.
        assert (
            f"{result['settings']['frames'] or result['clips'][0]['frames']} frames" in section_text
        )
