"""Frozen dataclasses to and from the JSON of a report.

A field's JSON key is its name, or the ``key`` of its metadata. JSON has no NaN: a null is read as NaN if the field is a
float.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Self, TypeVar, get_args, get_origin, get_type_hints

__all__ = ["Record", "from_json", "to_json"]

T = TypeVar("T")


class Record:
    """Base of a report's result, a frozen dataclass that is stored as JSON."""

    def as_dict(self) -> dict[str, Any]:
        """Return the result as JSON."""
        return to_json(self)

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Self:
        """Return the result that is stored as JSON in `value`."""
        return from_json(cls, value)


def to_json(value: Any) -> Any:
    """Return a value with a dict in place of each dataclass and a list in place of each tuple."""
    if is_dataclass(value) and not isinstance(value, type):
        return {_key(field): to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    return [to_json(entry) for entry in value] if isinstance(value, list | tuple) else value


def from_json(kind: type[T], value: Any) -> T:
    """Return the dataclass `kind` of what `to_json` has returned.

    Raises:
        KeyError: a field is missing.
    """
    return _parse(kind, value)


def _parse(kind: Any, value: Any) -> Any:
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{field.name: _parse(hints[field.name], value[_key(field)]) for field in fields(kind)})
    origin, parts = get_origin(kind), get_args(kind)
    if origin is types.UnionType and type(None) in parts:
        return None if value is None else _parse(parts[0], value)
    if origin is tuple:
        return tuple(_parse(parts[0], entry) for entry in value)
    if origin is Mapping:
        return {key: _parse(parts[1], entry) for key, entry in value.items()}
    return float("nan") if kind is float and value is None else value


def _key(field: Any) -> str:
    return field.metadata.get("key", field.name)
