"""Completion of commands in a shell, and the command that a mistyped one resembles."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import is_dataclass
from difflib import get_close_matches
from functools import reduce
from itertools import takewhile
from typing import Any, get_args, get_type_hints

from tyro.conf import subcommand

from morgs_mi.cli.console import print_warning

__all__ = ["completion_script", "near_command", "suggesting_command"]

_SUBCOMMAND: Any = type(subcommand())
# Changes of tyro's scripts: they complete no positional arguments, though most are files, and in bash they take the
# words before the current one for a part of it.
_FOUND = "get_completions(words, current_index, COMPLETION_SPEC)"
_CHANGES = {
    _FOUND: f"{_FOUND} or ['__TYRO_COMPLETE_FILES__']",
    'compgen -f -- "$cur"': 'compgen -f -- "${COMP_WORDS[COMP_CWORD]}"',
    "complete -F": "complete -o filenames -F",
}


def completion_script(parse: Callable[[Sequence[str]], Any], shell: str) -> str:
    """Return the script with which a shell completes commands, options and their values, otherwise names of files.

    Args:
        parse: parser of the arguments, by tyro.
        shell: bash, zsh or fish.
    """
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        parse(["--tyro-write-completion", shell, "-"])
    return reduce(lambda script, change: script.replace(*change), _CHANGES.items(), printed.getvalue())


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
