"""Frames <-> packets: a keyframe contains all integers of a frame, a residual the changes since the
frame before.

The state of a stream is a `CodedFrame`. Encoder and decoder compute it from the same packets with
the same integers, so the two cannot drift: after making a packet, take its `decode` as the new
state, and fit the next frame to that. Each residual also names the state that it continues, and is
refused by any other.

`source` [N'] maps a frame to the frame before: the index of the same Gaussian there, -1 for a
birth. Survivors come first in ascending order, births after them. Each Gaussian has one number in
`ids` for life; births get the next free ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import chain
from math import prod

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.entropy import LIMIT, ColumnReader, ColumnWriter, column_bits
from morgs_mi.codec.frame_source import FrameState
from morgs_mi.codec.quantisation import (
    KNOWN_OPTIONAL,
    Grid,
    bounded,
    finite_fields,
    new_grid,
    num_exponents,
    num_integers,
    optional_mask,
    optional_names,
    real_values,
    split_groups,
    stored_fields,
)
from morgs_mi.codec.residuals import Coder, offset_steps, take_change
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians

# An entropy code stores a column of one value in almost no bytes. A small packet must not request
# much memory: it has a word for each 16 Gaussians that it adds, or for each 16 of their integers if
# the state has more than 2^22. The integers of a fit take about four bits each, twice as much.
_PER_WORD = 16
_FREE_INTEGERS = 2**22
_DTYPES = {"head": "uint32", "code": "uint32", "parent": "uint8", "offset": "uint32"}
_COARSEST = 80  # quarter octaves: a million times the step


@dataclass(frozen=True, eq=False)
class CodedFrame(FrameState):
    """State of a stream after a packet, the same in encoder and decoder to the bit."""

    grid: Grid  #: Its N Gaussians as integers, for which `gaussians` stand.
    next_id: int  #: Number of the next birth.

    @cached_property
    def digest(self) -> np.ndarray:
        """BLAKE2b of all integers, uint8 [8], by which a residual names its parent."""
        grid = self.grid
        hasher = blake2b(digest_size=8)
        for array, dtype in (
            (self.ids, "<u4"),
            (grid.largest_components, "u1"),
            (grid.exponents, "i1"),
            (grid.values, "<i4"),
        ):
            hasher.update(np.ascontiguousarray(array, dtype).data)
        # A mask of the confidence alone follows from the number of exponents.
        mask = [grid.optional] if grid.optional > 1 else []
        hasher.update(np.array([self.next_id, grid.degree, *mask], "<u4").data)
        return np.frombuffer(hasher.digest(), np.uint8)


def keyframe_packet(
    gaussians: Gaussians,
    frame: int,
    cameras: Sequence[Camera] = (),
    config: CodecConfig | None = None,
) -> Packet:
    """Return the packet with every stored attribute of `gaussians`, which are new: their numbers
    start at zero.

    Args:
        gaussians: N Gaussians; their `motion` and `offset` are not stored.
        frame: index of the video frame.
        cameras: cameras in which the error is measured.
        config: tolerated errors.

    Raises:
        ValueError: an attribute is not finite.
    """
    grid = new_grid(split_groups(finite_fields(gaussians)), cameras, config or CodecConfig())
    return reemitted_keyframe(
        CodedFrame(frame, np.arange(len(grid), dtype=np.uint32), gaussians, grid, len(grid))
    )


def reemitted_keyframe(coded: CodedFrame) -> Packet:
    """Return the keyframe that decodes to exactly `coded`: an entry point for readers, without any
    loss.
    """
    grid = coded.grid
    writer = ColumnWriter()
    writer.put(np.diff(coded.ids.astype(np.int64), prepend=-1) - 1)
    _put_grid(writer, grid)
    head = np.array([len(grid), grid.degree, grid.optional, coded.next_id], np.uint32)
    return Packet(
        PacketKind.KEYFRAME,
        coded.frame,
        {"head": head, "code": _padded(writer.words(), len(grid), len(grid), grid)},
    )


def residual_packet(
    previous: CodedFrame,
    gaussians: Gaussians,
    source: np.ndarray | None = None,
    cameras: Sequence[Camera] = (),
    config: CodecConfig | None = None,
) -> Packet:
    """Return the packet that leads from `previous` to `gaussians` (eq. 3); it contains changed
    Gaussians only.

    A change counts from one step on, of a base colour from half a step on. With a `target_size`,
    the steps of the changes are widened until the packet fits.

    Args:
        previous: state of the decoder, N Gaussians.
        gaussians: N' Gaussians of the next frame; with `config.offset`, `offset` is stored where
            the means change.
        source: int [N'], see above; None if there are no births and no deaths.
        cameras: cameras in which the error of births is measured.
        config: tolerated errors.

    Raises:
        ValueError: `source` or the attributes do not fit, or an attribute is not finite.
    """
    config = config or CodecConfig()
    grid = previous.grid
    _check_attributes(previous, gaussians.sh_degree, optional_mask(gaussians.items()))
    source = _checked(np.arange(len(grid)) if source is None else source, len(grid), len(gaussians))
    fields = finite_fields(gaussians)
    survivors = source[source >= 0]
    coder = _coder(previous, fields, survivors, _offset_of(gaussians) if config.offset else None)
    births = len(gaussians) - len(survivors)
    birth_grid = _birth_grid(fields, births, cameras, config) if births else None
    coarseness, codes = _sized_codes(coder, birth_grid, config)
    arrays = {"parent": previous.digest, "head": np.array([births, coarseness], np.uint32), **codes}
    return Packet(PacketKind.RESIDUAL, previous.frame + 1, arrays)


def _birth_grid(
    fields: Mapping[str, np.ndarray], births: int, cameras: Sequence[Camera], config: CodecConfig
) -> Grid:
    """Return the last Gaussians of stored `fields`, which are new."""
    groups = {name: value[-births:] for name, value in split_groups(fields).items()}
    return new_grid(groups, cameras, config)


def _offset_of(gaussians: Gaussians) -> np.ndarray:
    """Return the offsets of Gaussians [N, 3], 0 where they have none."""
    if gaussians.offset is None:
        return np.zeros((len(gaussians), 3))
    return np.asarray(gaussians.offset)


def _sized_codes(
    coder: Coder, birth_grid: Grid | None, config: CodecConfig
) -> tuple[int, dict[str, np.ndarray]]:
    """Return the coarseness of the changes, at which they fit into the `target_size` if there is
    one, and their words.
    """
    target = config.target_size
    coarseness = round(4 * np.log2(config.birth_precision))
    if target:
        coarseness = _fitting(coder, coarseness, target)
    codes = _codes(coder, coarseness, birth_grid)
    while target and coarseness < _COARSEST and sum(c.nbytes for c in codes.values()) > target:
        coarseness += 1
        codes = _codes(coder, coarseness, birth_grid)
    return coarseness, codes


def decode(previous: CodedFrame | None, packet: Packet) -> CodedFrame:
    """Return the state after a packet.

    Args:
        previous: the state before it; not needed for a keyframe.
        packet: a packet of the stream.

    Raises:
        ValueError: a residual without the state that it continues, a packet that contradicts
            itself, or a packet of a frame that is not after the frame of `previous`.
    """
    where = packet.place or f"packet of frame {packet.frame}"
    try:
        _check_names(packet)
        _check_dtypes(packet)
        return _next_state(previous, packet)
    except ValueError as error:
        raise ValueError(f"{where}: {error}.") from None


def _check_names(packet: Packet) -> None:
    is_residual = packet.kind == PacketKind.RESIDUAL
    names = {"head", "code", "parent"} if is_residual else {"head", "code"}
    optional = {"offset"} if is_residual else set()
    if packet.arrays.keys() - optional != names:
        raise ValueError(f"expected the arrays {sorted(names)}, got {sorted(packet.arrays)}")


def _check_dtypes(packet: Packet) -> None:
    for name, array in packet.arrays.items():
        if array.ndim != 1 or array.dtype != _DTYPES[name]:
            raise ValueError(
                f"`{name}` must be {_DTYPES[name]} [n], got {array.dtype} {list(array.shape)}"
            )


def _next_state(previous: CodedFrame | None, packet: Packet) -> CodedFrame:
    """Return the state after a packet, if it may follow on `previous`."""
    if previous is not None and packet.frame <= previous.frame:
        raise ValueError(
            f"its frame must be above {previous.frame}, the frame of the state, got {packet.frame}"
        )
    if packet.kind == PacketKind.KEYFRAME:
        first_id = 0 if previous is None else previous.first_id + max(previous.next_id, 1)
        return _decoded_keyframe(packet, first_id)
    if previous is None:
        raise ValueError("a residual needs the frame before it, got none; start from a keyframe")
    if not np.array_equal(packet.arrays["parent"], previous.digest):
        raise ValueError(
            f"it does not continue the state after frame {previous.frame}; a packet is missing"
        )
    return _decoded_residual(previous, packet)


def coded_frames(packets: Iterable[Packet]) -> Iterator[CodedFrame]:
    """Decode packets in order and yield the state after each frame."""
    coded = None
    for packet in packets:
        if coded is None or (packet.kind, packet.frame) != (PacketKind.KEYFRAME, coded.frame):
            coded = decode(coded, packet)
            yield coded  # a re-emitted keyframe is for readers that start there


def _decoded_keyframe(packet: Packet, first_id: int) -> CodedFrame:
    code = packet.arrays["code"]
    N, degree, optional, next_id = _head(packet, 4)
    _check_optional(optional)
    _check_most(degree, 3, "its degree")
    _check_most(next_id, LIMIT - 1, "its next id")
    _check_words(code, N, N, degree, optional)
    reader = ColumnReader(code)
    ids = np.cumsum(reader.take(N) + 1) - 1
    grid = _taken_grid(reader, N, degree, optional)
    if np.any(np.diff(ids, prepend=-1) < 1) or (N and ids[-1] >= next_id):
        raise ValueError("its ids do not ascend")
    return CodedFrame(
        packet.frame, ids.astype(np.uint32), grid.gaussians(), grid, next_id, first_id=first_id
    )


def _check_optional(mask: int) -> None:
    if unknown_bits := mask & ~KNOWN_OPTIONAL:
        raise ValueError(
            f"its mask of optional attributes must have no bits beyond {KNOWN_OPTIONAL:#b}, got "
            f"{mask:#b} with the unknown {unknown_bits:#b}; read it with the release that "
            "wrote it"
        )


def _decoded_residual(previous: CodedFrame, packet: Packet) -> CodedFrame:
    births, coarseness = _residual_head(previous, packet)
    code = packet.arrays["code"]
    grid = previous.grid
    reader = ColumnReader(code)
    survivors, new = _taken_survivors(reader, grid, coarseness)
    _check_words(code, births, len(survivors) + births, grid.degree, grid.optional)
    motion = new.real("means").astype(np.float32) - np.asarray(previous.gaussians.means)[survivors]
    offset = _taken_offset(packet, new, grid.values[survivors, grid.columns["means"]], coarseness)
    if births:
        new = new.concatenate(_taken_grid(reader, births, grid.degree, grid.optional))
        motion = _with_births(motion, births)
        offset = None if offset is None else _with_births(offset, births)
    return replace(
        previous,
        frame=packet.frame,
        ids=_next_ids(previous, survivors, births),
        gaussians=new.gaussians(motion, offset),
        grid=new,
        next_id=previous.next_id + births,
    )


def _residual_head(previous: CodedFrame, packet: Packet) -> tuple[int, int]:
    """Return the number of births and the coarseness of a residual."""
    births, coarseness = _head(packet, 2)
    _check_most(coarseness, _COARSEST, "its coarseness")
    _check_most(previous.next_id + births, LIMIT - 1, "its next id")
    return births, coarseness


def _taken_survivors(reader: ColumnReader, grid: Grid, coarseness: int) -> tuple[np.ndarray, Grid]:
    """Return the indices of the survivors in `grid`, ascending, and the survivors after their
    changes.
    """
    values, dead = take_change(reader, grid, coarseness)
    survivors = np.flatnonzero(~dead)
    return survivors, replace(grid, values=values).select(survivors)


def _next_ids(previous: CodedFrame, survivors: np.ndarray, births: int) -> np.ndarray:
    """Return the numbers of the survivors of a state and of births, uint32."""
    new_ids = previous.next_id + np.arange(births, dtype=np.uint32)
    return np.concatenate([previous.ids[survivors], new_ids]).astype(np.uint32)


def _with_births(rows: np.ndarray, births: int) -> np.ndarray:
    """Return rows [S, 3] of the survivors, followed by zeros for births."""
    return np.pad(rows, ((0, births), (0, 0)))


def _taken_offset(
    packet: Packet, grid: Grid, previous_means: np.ndarray, coarseness: int
) -> np.ndarray | None:
    """Return the offsets of the survivors [S, 3], float32, or None if a packet has none.

    Args:
        packet: a residual.
        grid: the survivors.
        previous_means: integers of their means in the state before, int32 [S, 3].
        coarseness: of the changes.
    """
    if "offset" not in packet.arrays:
        return None
    means = grid.values[:, grid.columns["means"]]
    rows = np.flatnonzero(np.any(means != previous_means, axis=1))
    offset = np.zeros((len(grid), 3), np.float32)
    offset[rows] = _taken_offsets(packet.arrays["offset"], grid.select(rows), coarseness)
    return offset


def _taken_offsets(code: np.ndarray, grid: Grid, coarseness: int) -> np.ndarray:
    """Return the offsets [M, 3] of the Gaussians whose means change, from `Coder.offsets`."""
    reader = ColumnReader(code)
    r = np.stack([reader.take(len(grid)) for _ in range(3)], axis=1)
    return r * offset_steps(grid, coarseness)


def _words(columns: Iterable[np.ndarray]) -> np.ndarray:
    writer = ColumnWriter()
    for column in columns:
        writer.put(column)
    return writer.words()


def _put_grid(writer: ColumnWriter, grid: Grid) -> None:
    columns = np.concatenate(
        [grid.largest_components[:, None], grid.exponents, grid.values], axis=1, dtype=np.int64
    )
    middle = _middle(columns)
    writer.put(middle)
    # Small integers have a token of their own, large ones one per octave.
    for column in (columns - middle).T:
        writer.put(column)


def _middle(columns: np.ndarray) -> np.ndarray:
    """Return the medians of columns [N, C], or 0 where the difference would leave the limit."""
    if not len(columns):
        return np.zeros(columns.shape[1], np.int64)
    middle = np.sort(columns, axis=0)[len(columns) // 2]
    middle[np.abs(columns - middle).max(0, initial=0) >= LIMIT] = 0
    return middle


def _taken_grid(reader: ColumnReader, N: int, degree: int, optional: int) -> Grid:
    first = 1 + num_exponents(optional)  # column of the values
    middle = reader.take(num_integers(degree, optional))
    largest = _taken_largest(reader, N, middle[0])
    exponents = np.empty((N, first - 1), np.int8)
    values = np.empty((N, len(middle) - first), np.int32)
    _fill(exponents, reader, middle[1:first], 128, "exponent")
    _fill(values, reader, middle[first:], LIMIT, "value")
    return Grid(values, exponents, largest, degree, optional)


def _taken_largest(reader: ColumnReader, N: int, shift: int) -> np.ndarray:
    """Return the largest components of N quaternions, uint8."""
    largest = reader.take(N) + shift
    if np.any((largest < 0) | (largest > 3)):
        raise ValueError("the largest component of a quaternion must be 0 to 3")
    return largest.astype(np.uint8)


def _fill(
    columns: np.ndarray, reader: ColumnReader, shifts: np.ndarray, limit: int, what: str
) -> None:
    """Read values into the columns [N, C], and add the shift of each column."""
    for column, shift in zip(columns.T, shifts, strict=True):
        column[:] = bounded(reader.take(len(columns)) + shift, limit, what)


def _coder(
    previous: CodedFrame,
    fields: Mapping[str, np.ndarray],
    survivors: np.ndarray,
    offset: np.ndarray | None,
) -> Coder:
    """Return the coder of the changes to the next stored `fields`; survivors without any difference
    are skipped.
    """
    grid = previous.grid
    indices = np.flatnonzero(_differs(stored_fields(previous.gaussians), fields, survivors))
    rows = survivors[indices]
    groups = {name: value[indices] for name, value in split_groups(fields).items()}
    change = real_values(groups, grid.select(rows))
    change -= grid.values[rows].T
    return Coder(grid, survivors, rows, change, offset)


def _differs(
    previous_fields: Mapping[str, np.ndarray],
    fields: Mapping[str, np.ndarray],
    survivors: np.ndarray,
) -> np.ndarray:
    """Return the mask [S] of the survivors of which a field is another one than before."""
    differs = np.zeros(len(survivors), bool)
    for name, value in fields.items():
        differences = value[: len(survivors)] != previous_fields[name][survivors]
        differs |= differences.reshape(len(survivors), prod(value.shape[1:])).any(1)
    return differs


def _codes(coder: Coder, coarseness: int, birth_grid: Grid | None) -> dict[str, np.ndarray]:
    """Return the words of the changes in steps of a coarseness, and of the births."""
    r = coder.rounded(coarseness)
    writer = ColumnWriter()
    births = 0 if birth_grid is None else len(birth_grid)
    for column in coder.columns(r):
        writer.put(column)
    if birth_grid is not None:
        _put_grid(writer, birth_grid)
    codes = {"code": _padded(writer.words(), births, len(coder.survivors) + births, coder.grid)}
    if coder.offset is not None:
        codes["offset"] = _words(coder.offsets(r, coarseness))
    return codes


def _fitting(coder: Coder, low: int, target: int) -> int:
    """Return the least coarseness from `low` at which the changes are estimated to take `target`
    bytes.
    """
    high = _COARSEST
    while low < high:
        middle = (low + high) // 2
        r = coder.rounded(middle)
        bits = sum(map(column_bits, chain(coder.columns(r), coder.offsets(r, middle))))
        if bits / 8 <= target:
            high = middle
        else:
            low = middle + 1
    return low


def _check_attributes(previous: CodedFrame, degree: int, optional: int) -> None:
    grid = previous.grid
    if (degree, optional) != (grid.degree, grid.optional):
        names, new_names = (list(optional_names(mask)) for mask in (grid.optional, optional))
        raise ValueError(
            f"residual_packet(): frame {previous.frame + 1} must have SH of degree {grid.degree} "
            f"and the optional attributes {names} as the frame before, got degree {degree} and "
            f"{new_names}; write a keyframe instead."
        )


def _checked(source: np.ndarray, N: int, next_N: int) -> np.ndarray:
    """Return the sources of the next Gaussians, if they are in order and refer to N Gaussians."""
    source = np.asarray(source)
    if source.shape != (next_N,) or not _is_ordered(source) or np.any(source >= N):
        raise ValueError(
            f"residual_packet(): `source` must be [{next_N}] with survivors of 0..{N - 1} in "
            f"ascending order, then -1 for each birth, got {source.shape}; sort the Gaussians in "
            "this order."
        )
    return source


def _is_ordered(source: np.ndarray) -> bool:
    """Return whether survivors ascend and births come last."""
    births = source < 0
    ascends = np.all(np.diff(source[~births]) > 0)
    return bool(ascends and np.all(np.diff(births.astype(int)) >= 0))


def _head(packet: Packet, count: int) -> list[int]:
    head = packet.arrays["head"]
    if head.shape != (count,):
        raise ValueError(f"its head must have {count} numbers, got {list(head.shape)}")
    return [int(number) for number in head]


def _check_most(number: int, most: int, what: str) -> None:
    if number > most:
        raise ValueError(f"{what} must be at most {most}, got {number}")


def _padded(words: np.ndarray, births: int, total: int, grid: Grid) -> np.ndarray:
    return np.pad(
        words, (0, max(0, _least_words(births, total, grid.degree, grid.optional) - len(words)))
    )


def _check_words(code: np.ndarray, births: int, total: int, degree: int, optional: int) -> None:
    least = _least_words(births, total, degree, optional)
    if len(code) < least:
        raise ValueError(
            f"{births} new of {total} Gaussians take at least {least} words of code, got "
            f"{len(code)}"
        )


def _least_words(births: int, total: int, degree: int, optional: int) -> int:
    """Return the number of words that a packet has at least if it adds some Gaussians to a state
    with a new total.
    """
    integers = num_integers(degree, optional)
    return -(-births * (integers if total * integers > _FREE_INTEGERS else 1) // _PER_WORD)
