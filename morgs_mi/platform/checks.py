"""Checks of values that callers pass, with one sentence for each kind of fault."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 1e12
"""Largest coordinate or coefficient that is read, in its own unit: its cube is still a float32."""


@contextmanager
def errors_at(place: object) -> Iterator[None]:
    """Prefix the errors of values with their place, such as a file and a row.

    Raises:
        ValueError: a value is broken.
    """
    try:
        yield
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise ValueError(f"{place}: {error}") from None


def bounded(values: ArrayLike) -> bool:
    """Return whether all numbers are finite, and at most `LARGEST` in absolute value."""
    return bool((np.abs(values) <= LARGEST).all())


def require(holds: object, place: object, requirement: str, value: object, remedy: str) -> None:
    """Raise an error unless a condition holds.

    Args:
        holds: the condition.
        place: where the error's sentence begins, such as a function or a file.
        requirement: what must be, in words.
        value: what is instead.
        remedy: end of the sentence.

    Raises:
        ValueError: the condition is false.
    """
    if not holds:
        raise ValueError(f"{place}: {requirement}, got {value}; {remedy}.")


def check_number(place: object, name: str, value: object, interval: str) -> None:
    """Raise an error unless a setting is a number in an interval.

    Args:
        place: where the error's sentence begins.
        name: of the setting.
        value: of the setting.
        interval: such as ``[0, 1)``, which contains 0 but not 1; a bound may be ``inf``.

    Raises:
        ValueError: it is not, which includes NaN.
    """
    low, high = map(float, interval[1:-1].split(","))
    number: Any = value if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    lies_in = (low <= number if interval[0] == "[" else low < number) and (
        number <= high if interval[-1] == "]" else number < high
    )
    require(
        lies_in, place, f"`{name}` must be a number in {interval}", repr(value), "set another value"
    )


def check_type(
    place: str, name: str, value: object, kind: type, remedy: str = "pass another value"
) -> None:
    """Raise an error unless an argument is an instance of a class.

    Args:
        place: where the error's sentence begins.
        name: of the argument.
        value: of the argument.
        kind: the class.
        remedy: end of the sentence.

    Raises:
        ValueError: it is of another class.
    """
    require(
        isinstance(value, kind),
        place,
        f"`{name}` must be a {kind.__module__}.{kind.__qualname__}",
        f"a {type(value).__name__}",
        remedy,
    )


def check_size(place: str, width: object, height: object) -> None:
    """Raise an error unless the size of an image is two integers of at least 1.

    Raises:
        ValueError: a side is below 1, or no integer.
    """
    require(
        all(isinstance(v, (int, np.integer)) and v >= 1 for v in (width, height)),
        place,
        "the image size must be at least 1x1 in integers",
        f"{width!r}x{height!r}",
        "check width and height",
    )


def check_mask(place: str, mask: object, height: int, width: int) -> None:
    """Raise an error unless the mask of an image [H, W, ...] is a bool array [H, W].

    Raises:
        ValueError: the mask has another shape or type.
    """
    require(
        isinstance(mask, np.ndarray) and mask.shape == (height, width) and mask.dtype == bool,
        place,
        f"the mask must be bool [{height}, {width}] like its image",
        kind_of(mask),
        "resize it without interpolation, or compare it with a threshold",
    )


def valid_pixels(mask: np.ndarray | None, shape: Sequence[int]) -> np.ndarray:
    """Return a mask [H, W] of valid pixels, all of an image of a shape [H, W, ...] for None."""
    return np.ones(shape[:2], bool) if mask is None else mask


def view_index(place: object, setting: str, view: Any, names: Sequence[str]) -> int:
    """Return the index of a view that a setting gives by its name, or by its index.

    Raises:
        ValueError: there is no such view.
    """
    names = list(map(composed, names))
    name = composed(view) if isinstance(view, str) else view
    index = names.index(name) if name in names else view
    if str(index).isdecimal() and int(index) < len(names):
        return int(index)
    raise ValueError(
        f"{place}: {setting} must be an index in 0..{len(names) - 1} or one of {', '.join(names)}, "
        f"got {view!r}."
    )


def composed(name: str) -> str:
    """Return a name in Unicode's composed form (NFC), in which names are compared.

    Files copied from macOS have decomposed names: a letter, then its accent.
    """
    return unicodedata.normalize("NFC", name)


def few(names: Sequence[object] | np.ndarray, most: int = 10) -> str:
    """Return the first of some names in words."""
    rest = len(names) - most
    return ", ".join(map(str, names[:most])) + (f" and {rest} more" if rest > 0 else "")


def quantity(count: int, noun: str) -> str:
    """Return a number of things in words, such as ``2 frames``."""
    return f"{count} {noun if count == 1 else noun + 's'}"


def kind_of(value: object) -> str:
    """Return the numbers and the shape of an array in words, or the name of another type."""
    return (
        f"{value.dtype} {list(value.shape)}"
        if isinstance(value, np.ndarray)
        else type(value).__name__
    )


def numbers(place: object, name: str, values: ArrayLike, *shape: int) -> np.ndarray:
    """Return an argument as a NumPy array, which is not a copy where it is one already.

    Raises:
        ValueError: it is not an array of real numbers, or not of this shape, if one is given.
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # for instance rows of different lengths
        array = np.array(None)
    is_array = isinstance(values, np.ndarray) or array.dtype.kind in "fiub"
    require(
        array.dtype.kind in "fiub" and (not shape or array.shape == shape),
        place,
        f"`{name}` must be an array of real numbers {list(shape) or ''}".rstrip(),
        kind_of(array) if is_array else repr(values)[:80],
        "convert it to floats of that shape" if shape else "convert it to floats",
    )
    return array


def check_points(
    place: object, points: ArrayLike, colors: ArrayLike, most: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours as arrays [P, 3], P >= 0, if they are finite and the colours lie in
    [0, most].

    Raises:
        ValueError: they have another shape, are not finite, or a colour is out of range.
    """
    points = numbers(place, "points", points)
    colors = numbers(place, "point_colors", colors)
    if not points.size and not colors.size:
        return np.zeros((0, 3)), np.zeros((0, 3))
    require(
        points.ndim == 2 and points.shape[1] == 3 and colors.shape == points.shape,
        place,
        "`points` and `point_colors` must be [P, 3]",
        f"{list(points.shape)} and {list(colors.shape)}",
        "pass a row and a colour for each point",
    )
    outer = int(np.argmin((np.abs(points) <= LARGEST).all(axis=1)))
    require(
        bounded(points),
        place,
        f"`points` must be finite and at most {LARGEST:g}",
        f"{points[outer].tolist()} at {outer}",
        "remove this point",
    )
    are_colors = (colors >= 0) & (colors <= most)
    other = int(np.argmin(are_colors.all(axis=1)))
    require(
        are_colors.all(),
        place,
        f"`point_colors` must be in [0, {most:g}]",
        f"{colors[other].tolist()} at {other}",
        "divide colours of 8 bits by 255",
    )
    return points, colors
