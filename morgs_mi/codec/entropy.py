"""Integers <-> words: adaptive entropy coding in columns.

A column is an array of integers that are expected to follow one distribution. Each integer v
becomes a token. Where a token stands for more than one value, the remaining bits are coded
uniformly:

    m = |v| below 16, else 12 + k with k = floor(log2 |v|), the rest being |v| - 2^k of k bits
    token = 0 for v = 0, 2 m - 1 for v > 0, 2 m for v < 0

Tokens are coded in blocks of 16, 16, 32, 64, ...; the distribution of a block follows from the
tokens of the blocks before it, so it is not stored. docs/stream-format.md specifies every bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import constriction
import numpy as np

LIMIT = 2**30
"""Integers must lie between -LIMIT and LIMIT."""

_stream = cast(Any, constriction).stream  # a compiled submodule, which type checkers cannot see
_QUEUE = _stream.queue
_MODEL = _stream.model
_DIRECT = 16
_TOKENS = 2 * 42 + 1
_BLOCK = 16  # integers of the first block; each further one ends at twice the place
_LOW = 16  # bits of one uniform model, which must have fewer than 24
_WEIGHT = 32  # of an observed token, relative to the prior below
_PRIOR = np.maximum(1, 256 // (1 + np.arange(_TOKENS)) ** 2)


class ColumnWriter:
    """Encoder of columns of integers."""

    def __init__(self) -> None:
        self._encoder = _QUEUE.RangeEncoder()

    def put(self, values: np.ndarray) -> None:
        """Append a column [n] of integers between -LIMIT and LIMIT."""
        tokens, bits, rest = _tokens(values)
        counts = _PRIOR.copy()
        for block in _blocks(len(tokens)):
            self._encoder.encode(tokens[block], _model(counts))
            counts += _WEIGHT * np.bincount(tokens[block], minlength=_TOKENS)
        for shift, some, num_values in _halves(bits):
            half = (rest[some] >> shift) & (2**_LOW - 1)
            self._encoder.encode(half.astype(np.int32), _MODEL.Uniform(), num_values)

    def words(self) -> np.ndarray:
        """Return the words of all columns so far, uint32."""
        return self._encoder.get_compressed()


class ColumnReader:
    """Decoder of columns, in the order in which they were encoded.

    Args:
        words: uint32 with any content: damage results in wrong integers or a ValueError, never in
            more integers.
    """

    def __init__(self, words: np.ndarray) -> None:
        self._decoder = _QUEUE.RangeDecoder(np.ascontiguousarray(words, np.uint32))

    def take(self, count: int) -> np.ndarray:
        """Return the next column, int64 [count].

        Raises:
            ValueError: the words do not encode such a column.
        """
        tokens = np.zeros(count, np.int64)
        counts = _PRIOR.copy()
        try:
            for block in _blocks(count):
                tokens[block] = self._decoder.decode(_model(counts), block.stop - block.start)
                counts += _WEIGHT * np.bincount(tokens[block], minlength=_TOKENS)
            size = (tokens + 1) // 2  # the magnitude m of the module
            if np.any(size >= _DIRECT):
                bits = np.where(size < _DIRECT, 0, size - 12)
                rest = np.zeros(count, np.int64)
                for shift, some, num_values in _halves(bits):
                    half = self._decoder.decode(_MODEL.Uniform(), num_values)
                    rest[some] |= half.astype(np.int64) << shift
                size = np.where(bits > 0, (1 << bits) + rest, size)
        except AssertionError as error:  # raised by constriction where no symbol has this code
            raise ValueError(f"its code is broken ({error})") from None
        return np.where(tokens % 2, size, -size)


def _tokens(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tokens as int32, the number of remaining bits of each, and those bits."""
    size = np.abs(values.astype(np.int64))
    largest = size.max(initial=0)
    assert largest < LIMIT
    if largest < _DIRECT:
        zeros = np.zeros(len(size), np.int64)
        return _signed(size, values), zeros, zeros
    bits = np.where(size < _DIRECT, 0, np.frexp(size.astype(np.float64))[1] - 1)
    tokens = _signed(np.where(bits > 0, 12 + bits, size), values)
    return tokens, bits, np.where(bits > 0, size - (1 << bits), 0)


def _signed(m: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the tokens of values with the magnitudes m, int32."""
    return np.where(values > 0, 2 * m - 1, 2 * m).astype(np.int32)


def _blocks(count: int) -> Iterator[slice]:
    start = 0
    stop = _BLOCK
    while start < count:
        yield slice(start, min(stop, count))
        start = stop
        stop = 2 * stop


def _halves(bits: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (shift, indices, numbers of values) of the low and the high halves of the remaining
    bits.
    """
    for shift in (0, _LOW):
        some = np.flatnonzero(bits > shift)
        if len(some):
            yield shift, some, (1 << np.minimum(bits[some] - shift, _LOW)).astype(np.int32)


def _model(counts: np.ndarray) -> Any:
    return _MODEL.Categorical(counts.astype(np.float64), perfect=False)
