"""Command line, the package's only argument parser.

`morgs-mi fit`, `render`, `export`, `view`, `eval`, `accuracy`, and the commands of extras.

Results go to standard output; progress, warnings and errors to standard error. An error that the
user can correct is one sentence and exit status 1, an interruption by Ctrl-C or SIGTERM is status
130; `--debug` adds the traceback. Arguments that the parser rejects give status 2.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from functools import partial
from importlib.metadata import version
from io import StringIO, TextIOWrapper
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import arg

from morgs_mi.cli.accuracy import Accuracy
from morgs_mi.cli.console import (
    ERR,
    STDOUT,
    LogHandler,
    naming_output,
    print_result,
    print_warning,
    sentence_of,
)
from morgs_mi.cli.evaluate import Eval
from morgs_mi.cli.export import Export
from morgs_mi.cli.fit import Fit
from morgs_mi.cli.render import Render
from morgs_mi.cli.settings import (
    Flag,
    fill_help,
    one_command,
    options,
)
from morgs_mi.cli.view import ViewStream
from morgs_mi.platform.extras import extra, places
from morgs_mi.platform.interrupts import INTERRUPTED, interruptible, is_interruption

# Exit status of a shell for a program whose reader has ended, such as `head`.
_CLOSED = 141
# Exit status for arguments that the parser would reject.
_REJECTED = 2
# The class of each command, in the order of the help: a dataclass of its options, with `run`.
COMMANDS = {
    "fit": Fit,
    "render": Render,
    "export": Export,
    "view": ViewStream,
    "eval": Eval,
    "accuracy": Accuracy,
    **{name: extra("commands", name) for name in places("commands")},
}

# Options that went, and what to do instead.
OLD_OPTIONS = {
    "--animation": "went: scene files pose meshes by functions of the time, see the page on scenes",
    "--back-and-forth": "went: play a video backwards by another program",
    "--color": "went: --exposure balances the cameras",
    "--completion": "is now --tyro-write-completion bash FILE",
    "--deep": "went: `info` checks the poses, and --time finds the time offsets",
    "--front": "is now --camera",
    "--format": "went: the name of the output determines the format",
    "--key-views": "is now `key_views` in `[motion]` of a file of settings (--config)",
    "--loop": "went: a video is played once; name a longer one",
    "--open-browser": "is now --browser",
    "--no-open-browser": "is now --no-browser",
    "--reproducible": "went: on a CPU, fits without a limit of the clock are; leave it out",
    "--segments": "is now --chunks",
    "--test-view": "is now --hold-out",
    "--validate": "went: the time of its trials is left to the first frame; leave it out",
    "--without": "is now --exclude",
}


@options
class Common:
    """Options of every command."""

    variant: Annotated[
        Literal["llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"], arg(metavar="NAME")
    ] = "llvm_ad_rgb"
    """Mitsuba variant: llvm_ad_rgb for any processor, cuda_ad_rgb for an NVIDIA GPU, metal_ad_rgb
    for a Mac's.
    """
    debug: Flag = False
    """Print tracebacks and debug messages."""


@options
class Options(Common):
    """Dynamic Gaussian splatting in Mitsuba 3: from a multi-view clip to a stream of moving
    Gaussians.

    Alone, --version prints the version, and --tyro-write-completion bash FILE writes the completion
    of a shell.
    """

    command: Annotated[Any, one_command(COMMANDS)] = tyro.MISSING


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status; `args` default to the process's."""
    return run(Options, "morgs-mi", args)


def run(options_type: type[Common], prog: str, args: Sequence[str] | None = None) -> int:
    """Parse `args` into options with a `command`, run the command, and return the exit status."""
    args = sys.argv[1:] if args is None else list(args)
    # A character that the encoding does not have is printed as a code.
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        if args == ["--version"]:
            print_result(f"{prog} {version('morgs-mi')}")
            _flush_output()
            return 0
        parse = partial(
            tyro.cli,
            options_type,
            prog=prog,
            args=args,
            config=(
                tyro.conf.CascadeSubcommandArgs,
                tyro.conf.DisallowNone,
                tyro.conf.OmitSubcommandPrefixes,
                tyro.conf.PositionalMetavarFromFieldName,
            ),
        )
        if options_type is Options and (sentence := _old_option(args)):
            print_warning(f"{prog}: {sentence}")
            return _REJECTED
        options: Any = _help(parse, args) if {"-h", "--help"} & {*args} else parse()
        _set_up(options)
        with interruptible():
            options.command.run()
            _flush_output()
        return 0
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, BrokenPipeError) and error.filename == STDOUT:
            _drop_output()
            return _CLOSED
        status = 1
        sentence = sentence_of(error)
        if is_interruption(error):
            status = INTERRUPTED
            sentence = "Interrupted."
        print_warning(" ".join([sentence, *getattr(error, "__notes__", [])]))
        # The error may come from parsing, before `options` exist.
        if "--debug" in args:
            ERR.print_exception()
        _drop_output()
        return status


def _old_option(args: Sequence[str]) -> str:
    """Return a sentence on the first option that went; empty if there is none."""
    for word in args:
        option = word.partition("=")[0].replace("_", "-")
        if option in OLD_OPTIONS:
            return f"{option} {OLD_OPTIONS[option]}."
    return ""


def _help(parse: Callable[[], Any], args: Sequence[str]) -> Any:
    """Print the help of a command in lines that fit the terminal."""
    fill_help()
    text = StringIO()
    try:
        with redirect_stdout(text):
            return parse()
    except SystemExit:  # after the help, or a mistake before it
        width = shutil.get_terminal_size().columns
        command = next((COMMANDS[word] for word in args if word in COMMANDS), None)
        groups = getattr(command, "groups", {})
        titles = {option: title for title, options in groups.items() for option in options}
        rule = f" {'-' * (width - 2)}"
        blocks = {"": []} | {title: [f" {title}", rule] for title in groups}
        title = ""
        # No value is no default.
        content = re.sub(r"\s+\(default:\s*(None|False)?\)", "", text.getvalue())
        for line in map(str.rstrip, content.splitlines()):
            if not line.startswith("   "):
                title = titles.get(line.removeprefix("  --").partition(" ")[0], "")
            # The names of all commands are one word.
            line = line.replace(",", ", ") if line.startswith("usage:") else line
            blocks[title] += textwrap.wrap(line, width) if len(line) > width else [line]
        print_result("\n\n".join("\n".join(block).rstrip() for block in blocks.values()))
        raise


def _flush_output() -> None:
    with naming_output():
        sys.stdout.flush()


def _drop_output() -> None:
    """Discard what could not be written to a full or closed standard output; Python would fail
    again at its end.
    """
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _set_up(options: Common) -> None:
    """Send warnings to standard error, set Mitsuba's variant, and let it load its own plugins
    rather than files of their names in the current folder.
    """
    import mitsuba as mi

    logging.basicConfig(
        level=logging.DEBUG if options.debug else logging.WARNING, handlers=[LogHandler()]
    )
    try:
        mi.set_variant(options.variant)
    except ImportError as error:
        raise ValueError(
            f"--variant {options.variant} cannot be used here ({error}); try llvm_ad_rgb."
        ) from error
    file_resolver: Any = mi.file_resolver
    file_resolver().prepend(os.path.dirname(mi.__file__))
