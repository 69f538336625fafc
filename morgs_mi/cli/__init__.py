"""The command line, and the only argument parser.

`morgs-mi synth`, `info`, `calibrate`, `fit`, `render`, `export`, `view`, `eval`, `salvage` and `demo`.

Results go to standard output; progress, warnings and complaints to standard error. What the user can set right is
one sentence and exit status 1, an interruption 130; `--debug` shows where it came from. Arguments that the parser
refuses give status 2.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro
from rich.logging import RichHandler
from tyro.conf import arg

from morgs_mi.cli.captures import Calibrate, Info, Synth
from morgs_mi.cli.console import ERR, warn
from morgs_mi.cli.exports import Export, View
from morgs_mi.cli.streams import Demo, Eval, Fit, Render, Salvage

__all__ = ["Common", "main", "run"]

Command = (
    Annotated[Synth, tyro.conf.subcommand("synth")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Salvage, tyro.conf.subcommand("salvage")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


@dataclass(frozen=True)
class Common:
    """Options of every command."""

    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Mitsuba's variant: llvm_ad_rgb runs on any processor, cuda_ad_rgb on an NVIDIA GPU."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show where an error came from, and more of what happens."""


@dataclass(frozen=True)
class Options(Common):
    """Dynamic Gaussian splatting in Mitsuba 3: a multi-view clip goes in, a stream of moving Gaussians comes out."""

    command: Annotated[Command, arg(name="")] = tyro.MISSING


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status; `args` default to those of the process."""
    return run(Options, "morgs-mi", args)


def run(options_type: type[Common], prog: str, args: Sequence[str] | None = None) -> int:
    """Parse `args` into options with a `command`, run that, and return the exit status."""
    args = sys.argv[1:] if args is None else list(args)
    try:
        options = tyro.cli(
            options_type,
            prog=prog,
            args=args,
            config=(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes),
        )
        _set_up(options)
        options.command.run()
        return 0
    except (KeyboardInterrupt, ValueError, OSError, MemoryError, ArithmeticError) as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        sentence = "Interrupted; a stream file is whole up to its last frame." if interrupted else str(error)
        warn(" ".join(sentence.split()) or f"{type(error).__name__}.")
        # A setting may be refused before there are options to ask.
        if "--debug" in args:
            ERR.print_exception()
        return 130 if interrupted else 1


def _set_up(options: Common) -> None:
    """Send warnings to standard error and choose Mitsuba's variant."""
    import mitsuba as mi

    level = logging.DEBUG if options.debug else logging.WARNING
    logging.basicConfig(
        level=level, format="%(message)s", handlers=[RichHandler(console=ERR, show_time=False, show_path=False)]
    )
    try:
        mi.set_variant(options.variant)
    except ImportError as error:
        raise ValueError(f"--variant {options.variant} cannot be used here ({error}); try llvm_ad_rgb.") from error
