"""Configs: frozen dataclasses whose types contain the ranges of their fields, such as
``epochs: Annotated[int, Ge(1)] = 8``, and whose values are replaced by name and stored as TOML.

An integer has at most 64 bits, as in the header of a stream, and a number is finite in float32.
A key such as ``fit.density.rounds`` names a setting. In a TOML file it is ``rounds`` in the table
``[fit.density]``. TOML has no null: the string ``"none"`` stands for None.
"""

from __future__ import annotations

import json
import operator
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as shortened
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from annotated_types import Ge, Gt, Le, Lt, MultipleOf

from morgs_mi.platform.bounded import JsonObject, read_toml
from morgs_mi.platform.checks import check_type
from morgs_mi.platform.documentation import documented, field_docs, with_pages

NonNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]
NonNegativeInt = Annotated[int, Ge(0)]
Count = Annotated[int, Ge(1)]

Config = TypeVar("Config")
_NONE = "none"
_COMMENT_WIDTH = 112
_BOUNDS = {
    Ge: ("at least", operator.ge),
    Gt: ("above", operator.gt),
    Le: ("at most", operator.le),
    Lt: ("below", operator.lt),
    MultipleOf: ("a multiple of", lambda value, divisor: value % divisor == 0),
}
# Integers as in the header of a stream, and numbers as in float32.
_NUMBERS = {
    int: (Integral, -(2**63), 2**64 - 1),
    float: (Real, -3.4e38, 3.4e38),
}
_WORDS = {
    bool: "true or false",
    str: "a string",
    Path: "a path",
    NoneType: "none",
    int: "a whole number below 2^64",
    float: "a finite number",
}


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def config_class(kind: type[Config]) -> type[Config]:
    """Return a class as a frozen dataclass that checks its ranges, before its `__post_init__` if
    there is one, and whose docstring lists its fields.
    """
    further_checks = getattr(kind, "__post_init__", lambda config: None)

    def check(config: Any) -> None:
        check_ranges(config)
        further_checks(config)

    setattr(kind, "__post_init__", check)  # noqa: B010 (the class declares none)
    return documented(dataclass(frozen=True)(kind))


def check_ranges(config: Any, place: str = "") -> None:
    """Raise an error unless every field of a dataclass has a value of its type and within its
    range.

    Args:
        config: an instance of a dataclass.
        place: where the error's sentence begins; by default the name of the class.

    Raises:
        ValueError: a field has another value; the message names the field, its range and the value.
    """
    for name, kind in types_of(type(config)).items():
        check_value(place or f"{type(config).__name__}()", name, getattr(config, name), kind)


def check_value(place: str, name: str, value: object, kind: Any, remedy: str = "") -> None:
    """Raise an error unless the value of a field has its type and lies within its range.

    Args:
        place: where the error's sentence begins.
        name: of the field.
        value: of the field.
        kind: its type: numbers, strings, booleans, None, tuples, dicts, literals, classes, and
            unions of them.
        remedy: what the caller of the program can do; empty: give such a value.

    Raises:
        ValueError: its type is another one, or it lies outside of its range.
    """
    if expected := _expected(value, kind):
        end = f"; {remedy}" if remedy else ""
        raise ValueError(f"{place}: `{name}` must be {expected}, got {shortened(value)}{end}.")


def config_or_default(
    place: str, config: Config | None, default: Config, name: str = "config"
) -> Config:
    """Return the config that a caller passes, or `default` for None.

    Args:
        place: where the error's sentence begins.
        config: the argument.
        default: a config of the type that it must have.
        name: of the argument.

    Raises:
        ValueError: it has another type.
    """
    result = default if config is None else config
    check_type(place, name, result, type(default))
    return result


@cache
def types_of(config_type: Any) -> dict[str, Any]:
    """Return the types of a dataclass's fields by name, with their ranges."""
    hints = get_type_hints(config_type, include_extras=True)
    return {field.name: hints[field.name] for field in fields(config_type)}


def _expected(value: object, kind: Any) -> str:
    """Return a type in words, or its range alone where the type is right; empty if a value fits."""
    origin = get_origin(kind)
    args = get_args(kind)
    if origin in (Union, UnionType):
        arms = {arm: _expected(value, arm) for arm in args}
        fits = not all(arms.values())
        return "" if fits else " or ".join(arms[arm] for arm in args if arm is not NoneType)
    if origin is Annotated:
        limits = [limit for limit in args[1:] if type(limit) in _BOUNDS]
        bounds = [(*_BOUNDS[type(limit)], *astuple(limit)) for limit in limits]
        words = " and ".join(f"{words} {limit}" for words, _, limit in bounds)
        if expected := _expected(value, args[0]):
            return f"{expected}, {words}" if words else expected
        return "" if all(holds(value, limit) for _, holds, limit in bounds) else words
    if origin is tuple:  # (kind, ...) or one kind several times
        length = "" if args[1] is ... else f" of {len(args)} items"
        if not isinstance(value, tuple) or (length and len(value) != len(args)):
            return f"a list{length}"
        return _first_misfit(value, args[0], "a list, each item")
    if origin is dict and isinstance(value, dict):
        return _first_misfit(value.values(), args[1], "a table, each value")
    if origin is Literal:
        return "" if value in args else f"one of {', '.join(args)}"
    if kind in _NUMBERS:
        number, low, high = _NUMBERS[kind]
        fits = isinstance(value, number) and not isinstance(value, bool) and low <= value <= high
    else:
        fits = isinstance(value, origin or kind)
    return "" if fits else _WORDS.get(kind, "a table")


def _first_misfit(items: Iterable[object], kind: Any, words: str) -> str:
    """Return words with the type of the first item that does not fit; empty if all fit."""
    misfits = filter(None, (_expected(item, kind) for item in items))
    return next((f"{words} {expected}" for expected in misfits), "")


def apply_values(
    config: Config, values: Mapping[str, Any], source: object = "apply_values()", prefix: str = ""
) -> Config:
    """Return a config with some of its settings replaced.

    Args:
        config: a config of numbers, strings, booleans, tuples, None and further configs.
        values: new values by field name, with lists for tuples; a mapping for a nested config,
            which replaces only the fields it names.
        source: where the values come from, for messages: a file or a function.
        prefix: key of the config with a dot behind it; empty for a config that is in no other.

    Raises:
        ValueError: an unknown key, a value of the wrong type, or one that is out of range.
    """
    kinds = types_of(type(config))
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name not in kinds:
            near = get_close_matches(name, kinds, 1) or kinds
            keys = " or ".join(f"`{prefix}{name}`" for name in near)
            raise ValueError(f"{source}: `{prefix}{name}` is unknown, expected {keys}.")
        nested: Any = getattr(config, name)
        if is_dataclass(nested) and isinstance(value, Mapping):
            changes[name] = apply_values(nested, value, source, f"{prefix}{name}.")
        elif value == _NONE and NoneType in get_args(kinds[name]):
            changes[name] = None
        else:
            changes[name] = tuple(value) if isinstance(value, list) else value
    try:
        return replace(config, **changes)  # pyright: ignore[reportArgumentType]
    except ValueError as error:
        raise relocated(error, source, prefix, list(kinds)) from None


def read_config(path: str | Path) -> JsonObject:
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
    """
    header = f'# The string "{_NONE}" stands for no value.'
    return "\n".join((header, "", *_table(config, ""))) + "\n"


def _table(config: Any, prefix: str) -> Iterator[str]:
    """Yield the lines of a table: its own settings, then the tables inside it."""
    docs = field_docs(type(config))
    for name, value in sorted(vars(config).items(), key=lambda item: is_dataclass(item[1])):
        comment = textwrap.wrap(
            with_pages(" ".join(docs.get(name, "").split())),
            _COMMENT_WIDTH,
            initial_indent="# ",
            subsequent_indent="# ",
            break_long_words=False,
            break_on_hyphens=False,
        )
        if is_dataclass(value):
            yield from ("", *comment, f"[{prefix}{name}]", *_table(value, f"{prefix}{name}."))
            continue
        # JSON's values are TOML's, except that TOML has DEL escaped.
        text = json.dumps(_NONE if value is None else value, ensure_ascii=False)
        yield from (*comment, f"{name} = {text}".replace("\x7f", "\\u007f"))


def relocated(error: ValueError, source: object, prefix: str, names: list[str]) -> ValueError:
    """Return an error of a config's check with `source` as the place and full keys in place of
    field names.

    ``FitConfig(): `epochs` must be ...`` becomes ``FILE.toml: `fit.epochs` must be ...``. An error
    that names none of the fields is returned as it is.
    """
    text = re.sub(r"^[\w.]+\(\): ", "", str(error))
    named = rf"`({'|'.join(names)})`"
    keyed_text = re.sub(named, rf"`{prefix}\1`", text)
    return ValueError(f"{source}: {keyed_text}") if re.search(named, text) else error
