"""CRC-32 of many ranges of bytes that may overlap, in one pass over the bytes.

A CRC is a polynomial over GF(2) modulo the polynomial of the code; its highest bit is the coefficient of x^0. Each
byte that follows multiplies it by x^8. The CRC of a range therefore results from the CRCs of the bytes up to its two
ends (as in zlib's `crc32_combine`).
"""

from __future__ import annotations

import zlib

import numpy as np

__all__ = ["range_crcs"]

_POLYNOMIAL = np.uint32(0xEDB88320)
_X8 = np.uint32(1 << 31 - 8)


def range_crcs(data: bytes, starts: np.ndarray, stops: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return `zlib.crc32(data[start:stop], value)` of each range, uint32 [K].

    It takes the time of one CRC of the data, plus K log(length).

    Args:
        data: the bytes.
        starts: int64 [K].
        stops: int64 [K], not before the starts.
        values: uint32 [K], CRCs of the bytes that precede each range.
    """
    ends, where = np.unique(np.concatenate([starts, stops]), return_inverse=True)
    prefixes, crc, at = np.empty(len(ends), np.uint32), 0, 0
    view = memoryview(data)
    for k, end in enumerate(ends.tolist()):
        crc, at = zlib.crc32(view[at:end], crc), end
        prefixes[k] = crc
    before, after = prefixes[where].reshape(2, len(starts))
    return _shifted(before ^ values, stops - starts) ^ after


def _shifted(crcs: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return polynomials uint32 [K] times x^8 to the powers `counts` [K]."""
    power = np.array([_X8])
    for bit in range(int(counts.max(initial=0)).bit_length()):
        some = np.flatnonzero(counts >> bit & 1)
        crcs[some] = _product(crcs[some], power[0])
        power = _product(power, power[0])
    return crcs


def _product(crcs: np.ndarray, factor: np.uint32) -> np.ndarray:
    product = np.zeros_like(crcs)
    for bit in range(31, -1, -1):
        if factor >> np.uint32(bit) & np.uint32(1):
            product ^= crcs
        crcs = crcs >> np.uint32(1) ^ _POLYNOMIAL * (crcs & np.uint32(1))
    return product
