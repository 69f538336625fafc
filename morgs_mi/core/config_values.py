"""Values of configs: replaced by name, and as TOML files.

A key such as ``fit.density.rounds`` names a setting. In a TOML file it is ``rounds`` in the table
``[fit.density]``. TOML has no null: the string ``"none"`` stands for None.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from reprlib import repr as shortened
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_origin

from morgs_mi.core.bounded import read_toml
from morgs_mi.core.documentation import field_docs, with_pages
from morgs_mi.core.ranges import arms_of, check_value, item_kinds, types_of

Config = TypeVar("Config")
_NONE = "none"
_COMMENT_WIDTH = 110


def apply_values(
    config: Config, values: Mapping[str, Any], source: str = "apply_values()"
) -> Config:
    """Return a config with some of its settings replaced.

    Args:
        config: a frozen dataclass of numbers, strings, booleans, tuples, None and further such
            dataclasses.
        values: new values by field name; a mapping for a nested dataclass, which replaces only the
            fields it names.
        source: where the values come from, for messages: a file or a function.

    Raises:
        ValueError: an unknown key, a value of the wrong type, or one that is out of range.
    """
    return _replaced(config, values, source, "")


def read_config(path: str | Path) -> dict[str, Any]:
    """Return the settings that a TOML file gives, as `apply_values` takes them; they are not
    checked yet.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: as for `read_toml`.
    """
    try:
        return read_toml(path)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{path}: expected a TOML file with settings, found none; write one with `morgs-mi "
            "fit --print-config`."
        ) from None


def config_toml(config: Any) -> str:
    """Return a config as TOML: every setting with its docstring as a comment.

    `apply_values`, given the values that `read_config` returns for this text, makes any config of
    the same type equal.

    Raises:
        TypeError: a value has no TOML form here, see `apply_values`.
        ValueError: an optional string is "none", which would be read as None.
    """
    return (
        "\n".join((f'# The string "{_NONE}" stands for no value.', "", *_table(config, ""))) + "\n"
    )


def relocated(error: ValueError, source: str, prefix: str, names: list[str]) -> ValueError:
    """Return an error of a config's check with `source` as the place and full keys in place of
    field names.

    ``FitConfig(): `epochs` must be ...`` becomes ``FILE.toml: `fit.epochs` must be ...``. An error
    that names none of the fields is returned as it is.
    """
    text = re.sub(r"^[\w.]+\(\): ", "", str(error))
    keyed_text = re.sub(r"`(\w+)`", lambda m: f"`{prefix}{m[1]}`" if m[1] in names else m[0], text)
    return (
        ValueError(f"{source}: {keyed_text}")
        if any(f"`{name}`" in text for name in names)
        else error
    )


def _replaced(config: Any, values: Mapping[str, Any], source: str, prefix: str) -> Any:
    """Return `config` with `values`; `prefix` is its own key with a dot behind it, or empty."""
    kinds = types_of(type(config))
    changes: dict[str, Any] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if name not in kinds:
            near = get_close_matches(name, kinds, 1) or kinds
            keys = " or ".join(f"`{prefix}{name}`" for name in near)
            raise ValueError(f"{source}: `{key}` is unknown, expected {keys}.")
        kind = kinds[name]
        configs = (arm for arm in arms_of(kind) if is_dataclass(arm) and isinstance(arm, type))
        config_type = next(configs, None)
        if config_type is not None and isinstance(value, Mapping):
            nested = getattr(config, name)
            nested = config_type() if nested is None else nested
            changes[name] = _replaced(nested, value, source, f"{key}.")
        else:
            changes[name] = _converted(value, kind)
            check_value(source, key, changes[name], kind)
    try:
        return replace(config, **changes)
    except ValueError as error:
        raise relocated(error, source, prefix, list(kinds)) from None


def _converted(value: Any, kind: Any) -> Any:
    """Return a TOML value as a field's type has it: tuples for lists, floats for integers, None for
    "none".
    """
    arms = [get_args(arm)[0] if get_origin(arm) is Annotated else arm for arm in arms_of(kind)]
    if NoneType in arms and value in (None, _NONE):
        return None
    if type(value) is int and float in arms:
        with suppress(OverflowError):
            return float(value)
    if isinstance(value, (list, tuple)):
        kinds = item_kinds(_arguments(arms, tuple), len(value))
        if len(kinds) == len(value):
            return tuple(map(_converted, value, kinds))
    types = _arguments(arms, dict)
    if isinstance(value, dict) and types:
        return {k: _converted(v, types[1]) for k, v in value.items()}
    return value


def _arguments(arms: Sequence[Any], origin: type) -> tuple[Any, ...]:
    """Return the arguments of the first type of an origin among `arms`; none if there is none."""
    return next((get_args(arm) for arm in arms if get_origin(arm) is origin), ())


def _table(config: Any, key: str) -> Iterator[str]:
    """Yield the lines of a table: its own settings, then the tables inside it."""
    docs = field_docs(type(config))
    kinds = types_of(type(config))
    values = {name: getattr(config, name) for name in kinds}
    nested = {name: value for name, value in values.items() if is_dataclass(value)}
    for name, value in values.items():
        if name not in nested:
            if value == _NONE and NoneType in arms_of(kinds[name]):
                raise ValueError(
                    f"config_toml(): `{name}` must not be the string 'none', which stands for None."
                )
            yield from _comment(docs.get(name, ""))
            yield f"{name} = {_toml(value)}"
    for name, value in nested.items():
        path = f"{key}.{name}" if key else name
        yield from ("", *_comment(docs.get(name, "")), f"[{path}]")
        yield from _table(value, path)


def _comment(text: str) -> list[str]:
    """Return a docstring as lines of comment."""
    lines = textwrap.wrap(
        with_pages(" ".join(text.split())),
        _COMMENT_WIDTH,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [f"# {line}" for line in lines]


def _toml(value: Any) -> str:
    """Return a number, string, boolean, tuple or None as TOML has it."""
    if value is None:
        return f'"{_NONE}"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(float(value) if isinstance(value, float) else int(value))
    if isinstance(value, str):
        # JSON's strings are TOML's, except that TOML has DEL escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    raise TypeError(
        "config_toml(): expected numbers, strings, booleans, tuples or None, got "
        f"{shortened(value)}."
    )
