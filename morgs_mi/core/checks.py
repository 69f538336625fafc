"""Checks of values that callers pass, with one sentence for each kind of fault."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 1e12
"""Largest coordinate or coefficient that is read, in its own unit: its cube is still a float32."""


def bounded(values: ArrayLike) -> bool:
    """Return whether all numbers are finite, and at most `LARGEST` in absolute value."""
    return bool((np.abs(values) <= LARGEST).all())


def check_number(place: str, name: str, value: Any, interval: str) -> None:
    """Raise an error unless a setting is a number in an interval.

    Args:
        place: where the error's sentence begins.
        name: of the setting.
        value: of the setting.
        interval: such as ``[0, 1)``, which contains 0 but not 1; a bound may be ``inf``.

    Raises:
        ValueError: it is not, which includes NaN.
    """
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if not is_number or not _lies_in(value, interval):
        raise ValueError(
            f"{place}: `{name}` must be a number in {interval}, got {value!r}; set another value."
        )


def _lies_in(x: Any, interval: str) -> bool:
    """Return whether an interval contains a number, also an integer of hundreds of digits."""
    low, high = map(float, interval[1:-1].split(","))
    above = low <= x if interval[0] == "[" else low < x
    return above and (x <= high if interval[-1] == "]" else x < high)


def check_type(
    place: str, name: str, value: Any, kind: type, remedy: str = "pass another value"
) -> None:
    """Raise an error unless an argument is an instance of a class.

    Args:
        place: where the error's sentence begins.
        name: of the argument.
        value: of the argument.
        kind: the class.
        remedy: end of the sentence.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(value, kind):
        expected = f"{kind.__module__}.{kind.__qualname__}"
        raise ValueError(
            f"{place}: `{name}` must be a {expected}, got a {type(value).__name__}; {remedy}."
        )


def check_size(place: str, width: Any, height: Any) -> None:
    """Raise an error unless the size of an image is two integers of at least 1.

    Raises:
        ValueError: it is not.
    """
    if not all(isinstance(v, (int, np.integer)) and v >= 1 for v in (width, height)):
        raise ValueError(
            f"{place}: the image size must be at least 1x1 in integers, got {width!r}x{height!r}; "
            "check width and height."
        )


def check_mask(place: str, mask: Any, height: int, width: int) -> None:
    """Raise an error unless the mask of an image [H, W, ...] is a bool array [H, W].

    Raises:
        ValueError: it is not.
    """
    if not isinstance(mask, np.ndarray) or mask.shape != (height, width) or mask.dtype != bool:
        raise ValueError(
            f"{place}: the mask must be bool [{height}, {width}] like its image, got "
            f"{kind_of(mask)}; resize it without interpolation, or compare it with a threshold."
        )


def kind_of(value: Any) -> str:
    """Return the numbers and the shape of an array in words, or the name of another type."""
    return (
        f"{value.dtype} {list(value.shape)}"
        if isinstance(value, np.ndarray)
        else type(value).__name__
    )


def numbers(place: str, name: str, values: ArrayLike) -> np.ndarray:
    """Return an argument as a NumPy array, which is not a copy where it is one already.

    Raises:
        ValueError: it is not an array of real numbers.
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # for instance rows of different lengths
        array = np.array(None)
    if array.dtype.kind not in "fiub":
        kind = kind_of(values) if isinstance(values, np.ndarray) else repr(values)[:80]
        raise ValueError(
            f"{place}: `{name}` must be an array of real numbers, got {kind}; convert it to floats."
        )
    return array


def check_points(
    place: str, points: ArrayLike, colors: ArrayLike, most: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours as arrays [P, 3], P >= 0, if they are finite and the colours lie in
    [0, most].

    Raises:
        ValueError: they are not.
    """
    points = numbers(place, "points", points)
    colors = numbers(place, "point_colors", colors)
    if not points.size and not colors.size:
        return np.zeros((0, 3)), np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(
            f"{place}: `points` must be [P, 3], got {list(points.shape)}; pass one row for each "
            "point."
        )
    if colors.shape != points.shape:
        raise ValueError(
            f"{place}: `point_colors` must be {list(points.shape)} like `points`, got "
            f"{list(colors.shape)}; pass one colour for each point."
        )
    requirement = f"`points` must be finite and at most {LARGEST:g}"
    _check_rows(place, requirement, points, np.abs(points) <= LARGEST, "remove this point")
    requirement = f"`point_colors` must be in [0, {most:g}]"
    is_color = (colors >= 0) & (colors <= most)
    _check_rows(place, requirement, colors, is_color, "divide colours of 8 bits by 255")
    return points, colors


def _check_rows(
    place: str, requirement: str, values: np.ndarray, good: np.ndarray, remedy: str
) -> None:
    """Raise an error about the first row of `values` [P, 3] that is not all `good` [P, 3]."""
    if not good.all():
        row = np.flatnonzero(~good.all(axis=1))[0]
        raise ValueError(f"{place}: {requirement}, got {values[row].tolist()} at {row}; {remedy}.")
