"""A sweep fits a ladder of epochs and seeds, and its scores are those of an evaluation."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.core.config import config_toml
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.playback.streams import open_stream
from morgs_mi.studio import sweep as module
from morgs_mi.studio.sweep import mean_scores, sweep, write_sweep_plot
from tests.cli.commands import assert_refused
from tests.cli.conftest import run
from tests.scenes.recording import CONFIG, write_recording

__all__ = ["run"]


@pytest.mark.slow
def test_sweep__scores_every_number_of_epochs_with_every_seed(tmp_path, monkeypatch):
    capture = load_capture(write_recording(tmp_path / "clip", 2))
    calls = []
    for name in ("_compile_kernels", "stream_capture"):
        original = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, f=original, n=name: (calls.append(n), f(*a))[1]
        )
    rows = sweep(capture, tmp_path / "out", (2, 1, 2), 2, CONFIG)
    assert calls == ["_compile_kernels"] + 4 * ["stream_capture"]
    assert [(row["epochs"], row["seed"]) for row in rows] == [(2, 0), (2, 1), (1, 0), (1, 1)]
    for row in rows:
        folder = tmp_path / f"out/epochs{row['epochs']}-seed{row['seed']}"
        config = open_stream(folder).metadata["config"]
        assert (config["fit"]["epochs"], config["seed"]) == (row["epochs"], row["seed"])
        assert config["fit"]["num_gaussians"] == CONFIG.fit.num_gaussians
    result = evaluate_stream(tmp_path / "out/epochs1-seed1")
    assert rows[3]["psnr"] == result.scores.psnr
    assert (
        rows[3]["bytes_per_frame"]
        == (tmp_path / "out/epochs1-seed1/stream.morgs").stat().st_size / 2
    )
    assert rows[3]["later_seconds"] == result.seconds.per_later_frame
    written = json.loads((tmp_path / "out/sweep.json").read_text())["rows"]
    assert [row["psnr"] for row in written] == [row["psnr"] for row in rows]


@pytest.mark.slow
def test_sweep__prints_a_table_and_plots(tmp_path, run):
    clip = write_recording(tmp_path / "clip", 2)
    out = tmp_path / "out"
    plot = tmp_path / "plots/sweep.png"
    settings = tmp_path / "settings.toml"
    settings.write_text(config_toml(replace(CONFIG, seed=5)))
    status, output, _ = run(
        "sweep", clip, out, "--epochs", 1, 2, "--config", settings, "--plot", plot
    )
    assert status == 0
    header, *_ = (line.split() for line in output.splitlines() if "epochs" in line)
    assert (
        " ".join(header)
        == "epochs first, s later, s bytes PSNR, dB moving, dB motion error, px IoU"
    )
    rows = [line.split() for line in output.splitlines() if line.split()[:1] in (["1"], ["2"])]
    assert [(row[0], row[-1]) for row in rows] == [("1", "-"), ("2", "-")], (
        "there is no ground truth"
    )
    image = cv2.imread(str(plot))
    assert image.shape[1] > 2 * image.shape[0]
    assert image.std() > 5


NAMES = (
    "first_seconds",
    "later_seconds",
    "bytes_per_frame",
    "psnr",
    "psnr_moving",
    "motion_error_moving",
)


def test_mean_scores__are_over_the_seeds(tmp_path):
    rows = [
        {
            "epochs": epochs,
            "seed": seed,
            **dict.fromkeys(NAMES, epochs + 0.5 * seed),
            "confidence_iou": float("nan"),
        }
        for epochs in (4, 1)
        for seed in range(3)
    ]
    means = mean_scores(rows)
    assert [(row["epochs"], row["psnr"], row["later_seconds"]) for row in means] == [
        (4, 4.5, 4.5),
        (1, 1.5, 1.5),
    ]
    write_sweep_plot(tmp_path / "a.png", rows)
    height, width, _ = cv2.imread(str(tmp_path / "a.png")).shape
    assert 4 < width / height < 5, "four panels, none for what is unknown"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--epochs", 0), "epochs must be at least 1, got 0"),
        (("--seeds", 0), "seeds must be at least 1, got 0"),
        (("--plot", "a.txt"), "the suffix of a plot must be .png"),
    ],
)
def test_sweep__refuses(tmp_path, run, options, message):
    assert_refused(
        run("sweep", write_recording(tmp_path / "clip", 2), tmp_path / "out", *options), message
    )
    assert not (tmp_path / "out").exists()
