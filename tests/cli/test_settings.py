"""Settings of a fit: presets, files, options and their order."""

import re
import tomllib
from dataclasses import asdict, fields
from functools import reduce
from pathlib import Path
from typing import get_type_hints

import pytest

from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.cli.main import main
from morgs_mi.cli.settings import SETTINGS, Reading
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.config import apply_values, config_toml
from tests.cli.commands import assert_one_sentence


def printed_config(run, *args):
    status, text, error = run("fit", *args, "--print-config")
    assert (status, error) == (0, "")
    return apply_values(StreamConfig(), tomllib.loads(text))


@pytest.mark.parametrize(
    ("args", "key", "expected"),
    [
        (("--preset", "s", "--config", "FILE"), "fit.epochs", 3),
        (("--preset", "paper", "--config", "FILE"), "motion.lift_flow", False),
        (("--config", "FILE", "--flow", "dis"), "motion.flow_method", "dis"),
        (("--config", "FILE", "--target-size", "0"), "codec.target_size", 0),
    ],
)
def test_fit__overrides_defaults_by_preset_by_file_by_options(tmp_path, run, args, key, expected):
    file = tmp_path / "a.toml"
    file.write_text(
        "[fit]\nepochs = 3\n[motion]\nflow_method = 'files:nowhere'\n[codec]\nquality = "
        "2.5\ntarget_size = 9\n"
        "[render]\nblock_width = 4\n"
    )
    config = printed_config(run, *(file if arg == "FILE" else arg for arg in args))
    assert reduce(getattr, key.split("."), config) == expected


@pytest.mark.parametrize(
    "args",
    [
        (),
        ("--preset", "paper"),
        (
            *(
                "--seed",
                3,
                "--num-gaussians",
                7,
                "--first-frame-steps",
                5,
                "--first-frame-seconds",
                9.5,
                "--epochs",
                4,
            ),
            *(
                "--sh-degree",
                2,
                "--flow",
                "rlof",
                "--masks",
                "none",
                "--quality",
                0.3,
                "--target-size",
                99,
            ),
            *("--refine-cameras", "auto", "--exposure", "on"),
        ),
    ],
)
def test_fit__prints_a_config_that_it_reads_back(tmp_path, run, args):
    config = printed_config(run, *args)
    (tmp_path / "a.toml").write_text(config_toml(config))
    assert printed_config(run, "--config", tmp_path / "a.toml") == config
    if len(args) > 2:
        default, values = (flattened(asdict(c)) for c in (StreamConfig(), config))
        assert {key for key in values if values[key] != default[key]} == set(SETTINGS.values())


@pytest.mark.parametrize(("name", "epochs", "interval"), [("meet_room", 15, 3), ("n3dv", 8, 10)])
def test_reproduction_page__settings_are_accepted(tmp_path, run, name, epochs, interval):
    page = Path(__file__).parents[2] / "docs/experiments/reproduction.md"
    pattern = rf"<!-- settings: {name}.toml -->\n```toml\n(.*?)```"
    (text,) = re.findall(pattern, page.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "a.toml").write_text(text)
    config = printed_config(run, "--preset", "paper", "--config", tmp_path / "a.toml")
    assert (config.fit.epochs, config.motion.mask_interval) == (epochs, interval)
    assert len(config.motion.key_views) == 4
    assert not config.motion.two_gates


def flattened(values, prefix=""):
    pairs = [
        flattened(value, f"{prefix}{name}.")
        if isinstance(value, dict)
        else {f"{prefix}{name}": value}
        for name, value in values.items()
    ]
    return {key: value for part in pairs for key, value in part.items()}


def check_help(command, config, capsys):
    """Assert that the help of a command has the defaults of a config."""
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for option, key in SETTINGS.items():
        default = reduce(getattr, key.split("."), config)
        shown = (
            "" if default is None or default is False else rf" (?:(?!--).)*\(default: {default}\)"
        )
        assert re.search(rf"--{option.replace('_', '-')}{shown}", text), option
    return text


def test_help__shows_the_defaults_of_the_options(capsys):
    assert "None)" not in check_help("fit", StreamConfig(), capsys)


def test_Reading__has_the_fields_of_the_config():
    hints = get_type_hints(ReadConfig)
    types = get_type_hints(Reading)
    assert {field.name: types[field.name] for field in fields(Reading)} == {
        "exclude": hints.pop("without"),
        **hints,
    }
    assert Reading().read_config() == ReadConfig()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["cam01", "abc"], "such as cam01 -0.5, got cam01 abc."),
        (["cam01", "1", "cam02"], "got cam01 1 cam02."),
        (["cam01", "1", "cam01", "2"], "expected each camera once, with a number of frames"),
    ],
)
def test_offset__refuses_what_is_no_pair(words, sentence, capsys):
    with pytest.raises(SystemExit):
        main(["info", "capture", "--offset", *words])
    captured = capsys.readouterr()
    assert sentence in " ".join((captured.out + captured.err).replace("│", " ").split())


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("--preset", "the preset must be one of l, s, "),
        ("--refine-cameras", "`fit.refine_cameras` must be one of off, auto, on, got 'maybe'"),
        ("--exposure", "`fit.exposure` must be one of off, auto, on, got 'maybe'"),
    ],
)
def test_fit__lists_the_choices_of_an_option(option, sentence, run):
    status, output, error = run("fit", "capture", "out", option, "maybe")
    assert (status, output) == (1, "")
    assert_one_sentence(error, sentence)
