"""Ranges of settings as a part of their types, such as ``epochs: Annotated[int, AtLeast(1)] = 8``.

`check_ranges`, which a config calls in its `__post_init__`, compares all its fields with their
types. An integer is one of at most 64 bits, as the header of a stream has no longer ones, and any
number is finite.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import cache
from math import isfinite
from numbers import Integral, Real
from reprlib import repr as shortened
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

_WORDS = {bool: "true or false", str: "a string", NoneType: "none", dict: "a table"}
_WORDS |= {int: "a whole number below 2^64", float: "a finite number"}


@dataclass(frozen=True)
class _Bound:
    limit: float
    words: ClassVar[str]
    holds: ClassVar[Callable[[Any, Any], bool]]

    def __str__(self) -> str:
        return f"{self.words} {self.limit:g}"


class AtLeast(_Bound):
    """Closed lower bound of a number."""

    words = "at least"
    holds = operator.ge


class Above(_Bound):
    """Open lower bound of a number."""

    words = "above"
    holds = operator.gt


class AtMost(_Bound):
    """Closed upper bound of a number."""

    words = "at most"
    holds = operator.le


class Below(_Bound):
    """Open upper bound of a number."""

    words = "below"
    holds = operator.lt


class MultipleOf(_Bound):
    """Divisor of an integer."""

    words = "a multiple of"
    holds = staticmethod(lambda value, divisor: value % divisor == 0)


def check_ranges(config: Any, place: str = "") -> None:
    """Raise an error unless every field of a dataclass has a value of its type and within its
    range.

    Args:
        config: an instance of a dataclass.
        place: where the error's sentence begins; by default the name of the class.

    Raises:
        ValueError: a field has another value; the message names the field, its range and the value.
    """
    place = place or f"{type(config).__name__}()"
    for name, kind in types_of(type(config)).items():
        check_value(place, name, getattr(config, name), kind)


def check_value(place: str, name: str, value: Any, kind: Any) -> None:
    """Raise an error unless the value of a field has its type and lies within its range.

    Args:
        place: where the error's sentence begins.
        name: of the field.
        value: of the field.
        kind: its type: numbers, strings, booleans, None, tuples, dicts, literals, classes, and
            unions of them.

    Raises:
        ValueError: it has not.
    """
    if not _fits(value, kind):
        raise ValueError(
            f"{place}: `{name}` must be {_expected(value, kind)}, got {shortened(value)}."
        )


@cache
def types_of(config_type: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields by name, with their ranges."""
    return {
        n: t
        for n, t in get_type_hints(config_type, include_extras=True).items()
        if get_origin(t) is not ClassVar
    }


def arms_of(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def item_kinds(kinds: tuple[Any, ...], count: int) -> tuple[Any, ...]:
    """Return the types of the items of a tuple, for `count` of them where any number is allowed.

    Args:
        kinds: the arguments of the tuple's type, such as (int, str), or (int, ...).
        count: number of items.
    """
    return kinds[:1] * count if kinds[1:] == (...,) else kinds


def _fits(value: Any, kind: Any) -> bool:
    origin = get_origin(kind)
    args = get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, arm) for arm in args)
    if origin is Annotated:
        bounds = (bound for bound in args[1:] if isinstance(bound, _Bound))
        return _fits(value, args[0]) and all(bound.holds(value, bound.limit) for bound in bounds)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in args)
    if origin is tuple:
        kinds = item_kinds(args, len(value)) if isinstance(value, tuple) else None
        return kinds is not None and len(kinds) == len(value) and all(map(_fits, value, kinds))
    if origin is dict:
        return isinstance(value, dict) and all(
            _fits(k, args[0]) and _fits(v, args[1]) for k, v in value.items()
        )
    if kind is int:
        return _is_number(value, Integral) and -(2**63) <= int(value) < 2**64
    if kind is float:
        try:
            return _is_number(value, Real) and isfinite(value)
        except OverflowError:  # an integer of hundreds of digits
            return False
    return isinstance(value, kind)


def _is_number(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _in_words(kind: Any) -> str:
    """Return a type in words, such as "a finite number, at least 0 and below 1"."""
    if len(arms := arms_of(kind)) > 1:
        return " or ".join(map(_in_words, arms))
    origin = get_origin(kind)
    args = get_args(kind)
    if origin is Annotated:
        return ", ".join(filter(None, (_in_words(args[0]), _bounds(args[1:]))))
    if origin is Literal:
        return _joined(list(map(str, args)), "or")
    if origin is tuple:
        repeats = args[1:] == (...,)
        items = f"each {_in_words(args[0])}" if repeats else ", ".join(map(_in_words, args))
        return f"a list ({items})"
    name = getattr(kind, "__name__", str(kind))
    if is_dataclass(kind):
        return f"a table ({name})"
    return _WORDS.get(origin or kind, name)


def _expected(value: Any, kind: Any) -> str:
    """Return the expected value in words: a range alone where the type is right, such as "at least
    1".
    """
    for arm in arms_of(kind):
        if get_origin(arm) is Annotated and _fits(value, get_args(arm)[0]):
            return _bounds(get_args(arm)[1:])
    return _in_words(kind)


def _bounds(bounds: Any) -> str:
    return _joined([str(bound) for bound in bounds if isinstance(bound, _Bound)], "and")


def _joined(words: list[str], last: str) -> str:
    """Return "a, b and c"."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))
