"""Suggestion of the command that a mistyped one resembles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from difflib import get_close_matches
from itertools import takewhile
from typing import Any, get_args, get_type_hints

from tyro.conf import subcommand

from morgs_mi.cli.console import print_warning

__all__ = ["near_command", "suggesting_command"]

_SUBCOMMAND: Any = type(subcommand())


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
    """Return the words of the command that `words` resemble; empty if none does, or if they are a command.

    Args:
        owner: dataclass with the commands.
        words: the arguments before the first option.
    """
    commands = _commands(owner)
    if not commands or not words:
        return []
    if words[0] not in commands:
        return get_close_matches(words[0], commands, 1)
    rest = near_command(commands[words[0]], words[1:])
    return [words[0], *rest] if rest else []


def _commands(owner: Any) -> dict[str, Any]:
    """Return the commands of a dataclass by their names: the types in the union of one of its fields."""
    try:
        hints = get_type_hints(owner, include_extras=True) if is_dataclass(owner) else {}
    except NameError:  # a type of a command's option that is known to type checkers alone
        return {}
    members = (member for hint in hints.values() for union in get_args(hint) for member in get_args(union))
    pairs = ((get_args(member)[0], extra) for member in members for extra in get_args(member)[1:])
    return {extra.name: command for command, extra in pairs if isinstance(extra, _SUBCOMMAND)}
