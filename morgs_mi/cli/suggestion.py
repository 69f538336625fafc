"""Choice of a command by its name, and suggestion of the one that a mistyped name resembles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import reduce
from itertools import takewhile
from operator import or_
from typing import Annotated, Any

from tyro.conf import arg, subcommand

from morgs_mi.cli.console import print_warning


def one_command(commands: Mapping[str, type]) -> Any:
    """Return the annotation of an argument that is one of several commands, by their names."""
    union: Any = reduce(
        or_, (Annotated[command, subcommand(name)] for name, command in commands.items())
    )
    return arg(name="", constructor=union)


@contextmanager
def suggesting_command(options_type: type, prog: str, args: Sequence[str]) -> Iterator[None]:
    """Print the command that a mistyped one resembles, if the parser refuses the arguments."""
    try:
        yield
    except SystemExit as stop:
        words = list(takewhile(lambda word: not word.startswith("-"), args))
        if stop.code and (near := near_command(options_type, words)):
            print_warning(f"Did you mean `{' '.join([prog, *near])}`?")
        raise


def near_command(owner: Any, words: Sequence[str]) -> list[str]:
    """Return the words of the command that `words` resemble; empty if none does, or if they are a
    command.

    Args:
        owner: class with the mapping `commands`, or a command without one.
        words: the arguments before the first option.
    """
    commands: Mapping[str, type] = getattr(owner, "commands", {})
    if not commands or not words:
        return []
    if words[0] not in commands:
        return get_close_matches(words[0], commands, 1)
    rest = near_command(commands[words[0]], words[1:])
    return [words[0], *rest] if rest else []
