"""Ranges of settings: which values fit a type, and the sentence about one that does not."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pytest

from morgs_mi.core.ranges import Above, AtLeast, AtMost, Below, MultipleOf, check_ranges, types_of


@dataclass(frozen=True)
class Config:
    """A field of every kind."""

    kind: ClassVar[str] = "not a field"

    count: Annotated[int, AtLeast(1)] = 8
    width: Annotated[int, AtLeast(4), MultipleOf(4)] | None = None
    share: Annotated[float, Above(0), AtMost(1)] = 1.0
    opacity: Annotated[float, AtLeast(0), Below(1)] | None = 0.5
    number: float = 0.0
    seed: int = 0
    on: bool = True
    name: str = ""
    mode: Literal["off", "auto", "on"] = "off"
    blurs: tuple[Annotated[float, Above(0)], ...] = (6.0, 3.0)
    size: tuple[int, int] | None = None
    offset: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        check_ranges(self)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"count": 1, "width": 4, "share": 1, "opacity": 0, "seed": -(2**63), "number": -1e308},
        {"count": np.int64(3), "share": np.float32(0.5), "opacity": None, "seed": 2**64 - 1},
        {
            "mode": "auto",
            "blurs": (),
            "size": (2, 3),
            "offset": (("a", 1), ("b", 0.5)),
            "name": "none",
        },
    ],
)
def test_check_ranges__accepts_values_within_their_ranges(values: dict[str, Any]):
    Config(**values)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("count", 0, "at least 1, got 0."),
        ("count", 2.5, "a whole number below 2^64, at least 1, got 2.5."),
        ("count", True, "a whole number below 2^64, at least 1, got True."),
        ("count", None, "a whole number below 2^64, at least 1, got None."),
        ("width", 6, "at least 4 and a multiple of 4, got 6."),
        (
            "width",
            8.0,
            "a whole number below 2^64, at least 4 and a multiple of 4 or none, got 8.0.",
        ),
        ("share", 0, "above 0 and at most 1, got 0."),
        ("share", 1.5, "above 0 and at most 1, got 1.5."),
        ("share", nan, "a finite number, above 0 and at most 1, got nan."),
        ("share", "1", "a finite number, above 0 and at most 1, got '1'."),
        ("opacity", 1, "at least 0 and below 1, got 1."),
        ("number", inf, "a finite number, got inf."),
        ("number", 10**400, "a finite number, got 1000000"),
        ("seed", 2**64, "a whole number below 2^64, got 18446744073709551616."),
        ("on", 1, "true or false, got 1."),
        ("name", None, "a string, got None."),
        ("mode", "yes", "off, auto or on, got 'yes'."),
        ("blurs", (3, -1), "a list (each a finite number, above 0), got (3, -1)."),
        (
            "size",
            (1,),
            "a list (a whole number below 2^64, a whole number below 2^64) or none, got (1,).",
        ),
    ],
)
def test_check_ranges__names_the_field_its_range_and_the_value(
    name: str, value: object, expected: str
):
    with pytest.raises(ValueError, match=r"^Config\(\): ") as caught:
        Config(**{name: value})
    assert str(caught.value).startswith(f"Config(): `{name}` must be {expected}")


def test_check_ranges__begins_with_the_given_place():
    config = Config()
    object.__setattr__(config, "count", 0)
    with pytest.raises(ValueError, match=r"^fit_live\(\): `count` must be at least 1, got 0\."):
        check_ranges(config, "fit_live()")


def test_types_of__are_those_of_the_fields():
    assert list(types_of(Config))[:2] == ["count", "width"]
