"""Frames <-> packets: a keyframe states all integers of a frame, a residual what changes from the frame before.

The state of a stream is a `CodedFrame`. Encoder and decoder get it from the same packets by the same integers, so the
two cannot drift: after making a packet, take `decode` of it as the new state, and fit the next frame to that. Each
residual also names the state that it continues, and is refused by any other.

`source` [N'] says who is who: the index of the same Gaussian in the frame before, -1 for one that was born. Survivors
come first in ascending order, births after them. Each keeps its number in `ids` for life, births get the next free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b

import numpy as np

from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.entropy import LIMIT, ColumnReader, ColumnWriter, column_bits
from morgs_mi.codec.quantisation import Grid, attributes, bounded, columns_of, new_grid, real_values, step_sizes
from morgs_mi.codec.reader import StreamReader
from morgs_mi.codec.residuals import columns_of_change, take_change
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians

__all__ = [
    "CodedFrame",
    "coded_frames",
    "decode",
    "keyframe_packet",
    "play",
    "reemitted_keyframe",
    "residual_packet",
    "seek",
]

# A packet has at least a word per 16 Gaussians that it brings, so that no damaged number can ask for much memory.
_PER_WORD = 16
# Where no number of a group changes by a step, that is the fit's jitter, but colours show every bit of it. A little
# less than a step, for a decoded state is rounded to float32, and must give the packet that it came from.
_LEAST, _LEAST_COLOR = 0.99, 0.5
_COARSEST = 80  # quarter octaves: a million times the step


@dataclass(frozen=True, eq=False)
class CodedFrame:
    """State of a stream after a packet, the same in encoder and decoder to the bit.

    Attributes:
        frame: index of the video frame.
        grid: its N Gaussians as integers.
        ids: uint32 [N], ascending: which Gaussian each one is, from its birth to its death.
        next_id: what the next to be born gets.
        gaussians: the same as numbers; `motion` is the displacement since the frame before, zero where there is none,
            `offset` its learned part, None if the packet does not tell.
    """

    frame: int
    grid: Grid
    ids: np.ndarray
    next_id: int
    gaussians: Gaussians

    def __len__(self) -> int:
        return len(self.grid)

    @cached_property
    def digest(self) -> np.ndarray:
        """BLAKE2b of all integers, uint8 [8]: what a residual names as its parent."""
        grid, hashed = self.grid, blake2b(digest_size=8)
        for array, dtype in (
            (self.ids, "<u4"),
            (grid.largest_components, "u1"),
            (grid.exponents, "i1"),
            (grid.values, "<i4"),
        ):
            hashed.update(np.ascontiguousarray(array, dtype))
        hashed.update(np.array([self.next_id, grid.degree], "<u4"))
        return np.frombuffer(hashed.digest(), np.uint8)


def keyframe_packet(
    gaussians: Gaussians, frame: int, cameras: Sequence[Camera] = (), config: CodecConfig | None = None
) -> Packet:
    """Return the packet that states every attribute of `gaussians`, which are new: their numbers count from zero.

    Args:
        gaussians: N Gaussians; their `motion` and `offset` are not written.
        frame: index of the video frame.
        cameras: on whose screens errors count.
        config: what may be off.

    Raises:
        ValueError: an attribute is not finite.
    """
    grid = new_grid(attributes(gaussians), cameras, config or CodecConfig())
    return reemitted_keyframe(CodedFrame(frame, grid, np.arange(len(grid), dtype=np.uint32), len(grid), gaussians))


def reemitted_keyframe(coded: CodedFrame) -> Packet:
    """Return the keyframe that leads to the very state `coded`: a place to start from, with nothing lost."""
    grid, writer = coded.grid, ColumnWriter()
    writer.put(np.diff(coded.ids.astype(np.int64), prepend=-1) - 1)
    _put_grid(writer, grid)
    head = np.array([len(grid), grid.degree, grid.has_confidence, coded.next_id], np.uint32)
    return Packet(PacketKind.KEYFRAME, coded.frame, {"head": head, "code": _padded(writer.words(), len(grid))})


def residual_packet(
    previous: CodedFrame,
    gaussians: Gaussians,
    source: np.ndarray | None = None,
    cameras: Sequence[Camera] = (),
    config: CodecConfig | None = None,
) -> Packet:
    """Return the packet that leads from `previous` to `gaussians` (eq. 3); only those that changed are written.

    What changed by less than a step, a colour by less than half of one, did not change. With a `target_size`, steps
    are widened until it is kept.

    Args:
        previous: state that the decoder has, N Gaussians.
        gaussians: of the frame after it, N'; their `offset` counts with `config.offset`, where positions change.
        source: int [N'], see above; None if nobody was born or died.
        cameras: on whose screens the errors of those born count.
        config: what may be off.

    Raises:
        ValueError: `source` or the attributes do not fit, or an attribute is not finite.
    """
    config, grid = config or CodecConfig(), previous.grid
    same = gaussians.sh_degree == grid.degree and (gaussians.logit_confidence is not None) == grid.has_confidence
    if not same:
        raise ValueError(
            f"residual_packet(): frame {previous.frame + 1} must have SH of degree {grid.degree} "
            f"{'and' if grid.has_confidence else 'but no'} confidence as the frame before; write a keyframe instead."
        )
    source = _checked(np.arange(len(grid)) if source is None else source, len(grid), len(gaussians))
    survivors, births = source[source >= 0], int((source < 0).sum())
    raw, count = attributes(gaussians), len(survivors)
    touched = _touched(raw, previous.gaussians.numpy(), survivors)
    rows = survivors[touched]
    change = real_values({name: value[touched] for name, value in raw.items()}, grid.select(rows))
    change -= grid.values[rows].T
    born = new_grid({name: value[count:] for name, value in raw.items()}, cameras, config) if births else None
    dead = np.ones(len(grid), bool)
    dead[survivors] = False

    def rounded(coarseness: int) -> np.ndarray:
        r, scaled = np.zeros((len(change), len(grid)), np.int32), change / step_sizes(np.array(coarseness))
        for name, at in grid.columns.items():
            scaled[at][:, np.abs(scaled[at]).max(0) < (_LEAST_COLOR if name == "color" else _LEAST)] = 0
        r[:, rows] = np.clip(np.rint(scaled, out=scaled), 1 - LIMIT, LIMIT - 1, out=scaled)
        return r

    def offsets(r: np.ndarray, coarseness: int) -> Iterator[np.ndarray]:
        moved = np.flatnonzero(r[grid.columns["position"]].any(0)[survivors])
        offset = np.zeros((len(gaussians), 3)) if gaussians.offset is None else np.asarray(gaussians.offset)
        real = offset[moved] / _offset_steps(grid.select(survivors[moved]), coarseness)
        yield from np.clip(np.rint(real), 1 - LIMIT, LIMIT - 1).astype(np.int32).T

    def columns(coarseness: int) -> Iterator[np.ndarray]:
        r = rounded(coarseness)
        yield from columns_of_change(r, dead, grid)
        if config.offset:
            yield from offsets(r, coarseness)

    coarseness = least = round(4 * np.log2(config.birth_precision))
    if config.target_size:
        coarseness = _fitting(columns, least, config.target_size)
    while True:
        r, writer = rounded(coarseness), ColumnWriter()
        for column in columns_of_change(r, dead, grid):
            writer.put(column)
        if born is not None:
            _put_grid(writer, born)
        codes = {"code": _padded(writer.words(), births)}
        if config.offset:
            codes["offset"] = _words(offsets(r, coarseness))
        size = sum(code.nbytes for code in codes.values())
        if not config.target_size or size <= config.target_size or coarseness >= _COARSEST:
            break
        coarseness += 1
    arrays = {"parent": previous.digest, "head": np.array([births, coarseness], np.uint32), **codes}
    return Packet(PacketKind.RESIDUAL, previous.frame + 1, arrays)


def decode(previous: CodedFrame | None, packet: Packet) -> CodedFrame:
    """Return the state after a packet.

    Args:
        previous: the state before it; a keyframe does not ask for it.
        packet: of the stream.

    Raises:
        ValueError: a residual without the state that it continues, or a packet that contradicts itself.
    """
    where = f"packet of frame {packet.frame}"
    names = {"head", "code"} | ({"parent"} if packet.kind == PacketKind.RESIDUAL else set())
    optional = {"offset"} if packet.kind == PacketKind.RESIDUAL else set()
    if packet.arrays.keys() - optional != names:
        raise ValueError(f"{where}: expected the arrays {sorted(names)}, got {sorted(packet.arrays)}.")
    if any(array.ndim != 1 for array in packet.arrays.values()):
        raise ValueError(f"{where}: its arrays must have one axis each.")
    try:
        if packet.kind == PacketKind.KEYFRAME:
            return _decoded_keyframe(packet)
        if previous is None:
            raise ValueError("a residual needs the frame before it, got none; start from a keyframe")
        if not np.array_equal(packet.arrays["parent"], previous.digest):
            raise ValueError(f"it does not continue the state after frame {previous.frame}; a packet is missing")
        return _decoded_residual(previous, packet)
    except ValueError as error:
        raise ValueError(f"{where}: {error}.") from None


def coded_frames(packets: Iterable[Packet]) -> Iterator[CodedFrame]:
    """Decode packets in order and yield the state after each frame."""
    coded = None
    for packet in packets:
        if coded is None or packet.frame != coded.frame:  # a keyframe that restates is for those who start there
            coded = decode(coded, packet)
            yield coded


def play(packets: Iterable[Packet]) -> Iterator[tuple[int, Gaussians]]:
    """Decode packets in order and yield (frame, Gaussians), once for each frame."""
    return ((coded.frame, coded.gaussians) for coded in coded_frames(packets))


def seek(stream: StreamReader, frame: int) -> CodedFrame:
    """Return the state at a frame, decoding no more than what lies between it and the keyframe before it.

    Raises:
        ValueError: the stream has no such frame, is no file, or a packet is broken.
    """
    for coded in coded_frames(stream.near(frame)):
        if coded.frame == frame:
            return coded
    raise ValueError(f"{stream.path}: expected a frame of the stream, got {frame}; it has none of that number.")


def _decoded_keyframe(packet: Packet) -> CodedFrame:
    code = packet.arrays["code"]
    N, degree, has_confidence, next_id = _head(packet, 4)
    if _PER_WORD * len(code) < N or degree > 3 or has_confidence > 1 or next_id >= LIMIT:
        raise ValueError(f"its head {[N, degree, has_confidence, next_id]} does not fit its {len(code)} words of code")
    reader = ColumnReader(code)
    ids = np.cumsum(reader.take(N) + 1) - 1
    grid = _taken_grid(reader, N, degree, bool(has_confidence))
    if np.any(np.diff(ids, prepend=-1) < 1) or (N and ids[-1] >= next_id):
        raise ValueError("its ids do not ascend")
    return CodedFrame(packet.frame, grid, ids.astype(np.uint32), next_id, grid.gaussians())


def _decoded_residual(previous: CodedFrame, packet: Packet) -> CodedFrame:
    births, coarseness = _head(packet, 2)
    code, grid = packet.arrays["code"], previous.grid
    if _PER_WORD * len(code) < births or coarseness > _COARSEST or previous.next_id + births >= LIMIT:
        raise ValueError(f"its head {[births, coarseness]} does not fit its {len(code)} words of code")
    reader = ColumnReader(code)
    values, dead = take_change(reader, grid, float(step_sizes(np.array(coarseness))))
    survivors = np.flatnonzero(~dead)
    new = replace(grid, values=values).select(survivors)
    motion = np.zeros((len(survivors) + births, 3), np.float32)
    before = np.asarray(previous.gaussians.means)[survivors]
    motion[: len(survivors)] = new.real("position").astype(np.float32) - before
    offset = None
    if "offset" in packet.arrays:
        offset, at, words = np.zeros_like(motion), grid.columns["position"], ColumnReader(packet.arrays["offset"])
        moved = np.flatnonzero((new.values[:, at] != grid.values[survivors, at]).any(1))
        r = np.stack([words.take(len(moved)) for _ in range(3)], axis=1)
        offset[moved] = r * _offset_steps(new.select(moved), coarseness)
    if births:
        new = new.concatenate(_taken_grid(reader, births, grid.degree, grid.has_confidence))
    ids = np.concatenate([previous.ids[survivors], previous.next_id + np.arange(births, dtype=np.uint32)])
    gaussians = new.gaussians(motion, offset)
    return CodedFrame(packet.frame, new, ids.astype(np.uint32), previous.next_id + births, gaussians)


def _offset_steps(grid: Grid, coarseness: int) -> np.ndarray:
    """Return by how much the integers of an offset count, float64 [N, 1], world units: as those of a displacement."""
    return grid.steps("position") * step_sizes(np.array(coarseness))


def _words(columns: Iterable[np.ndarray]) -> np.ndarray:
    writer = ColumnWriter()
    for column in columns:
        writer.put(column)
    return writer.words()


def _put_grid(writer: ColumnWriter, grid: Grid) -> None:
    columns = np.concatenate([grid.largest_components[:, None], grid.exponents, grid.values], axis=1, dtype=np.int64)
    middle = np.sort(columns, axis=0)[len(grid) // 2] if len(grid) else np.zeros(columns.shape[1], np.int64)
    middle[np.abs(columns - middle).max(0, initial=0) >= LIMIT] = 0  # what is as large as can be is not made larger
    writer.put(middle)
    for column in (columns - middle).T:  # small numbers are coded one by one, large ones by their octave
        writer.put(column)


def _taken_grid(reader: ColumnReader, N: int, degree: int, has_confidence: bool) -> Grid:
    first = 9 + has_confidence  # column of the values
    middle = reader.take(first + max(at.stop for at in columns_of(degree, has_confidence).values()))
    columns = np.stack([reader.take(N) + shift for shift in middle], axis=1)
    if np.any((columns[:, 0] < 0) | (columns[:, 0] > 3)):
        raise ValueError("a quaternion's pivot must be 0 to 3")
    exponents = bounded(columns[:, 1:first], 128, "exponent").astype(np.int8)
    values = bounded(columns[:, first:], LIMIT, "value").astype(np.int32)
    return Grid(values, exponents, columns[:, 0].astype(np.uint8), degree)


def _touched(now: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray], survivors: np.ndarray) -> np.ndarray:
    """Return who of the survivors has any attribute that differs: the others need not be looked at."""
    differs = np.zeros(len(survivors), bool)
    for name, value in now.items():
        differs |= (value[: len(survivors)] != before[name][survivors]).reshape(len(survivors), -1).any(1)
    return np.flatnonzero(differs)


def _fitting(columns: Callable[[int], Iterator[np.ndarray]], low: int, target: int) -> int:
    """Return the least coarseness from `low` at which the columns are estimated to take `target` bytes."""
    high = _COARSEST
    while low < high:
        middle = (low + high) // 2
        if sum(map(column_bits, columns(middle))) / 8 <= target:
            high = middle
        else:
            low = middle + 1
    return low


def _checked(source: np.ndarray, before: int, now: int) -> np.ndarray:
    source = np.asarray(source)
    born = source < 0
    survivors = source[~born]
    sound = source.shape == (now,) and np.all(np.diff(survivors) > 0) and np.all(np.diff(born.astype(int)) >= 0)
    if not sound or np.any(survivors >= before):
        raise ValueError(
            f"residual_packet(): `source` must be [{now}] with survivors of 0..{before - 1} in ascending order, then "
            f"-1 for each birth, got {source.shape}; sort the Gaussians so."
        )
    return source


def _head(packet: Packet, count: int) -> list[int]:
    head = packet.arrays["head"]
    if head.shape != (count,):
        raise ValueError(f"its head must have {count} numbers, got {list(head.shape)}")
    return [int(number) for number in head]


def _padded(words: np.ndarray, count: int) -> np.ndarray:
    return np.pad(words, (0, max(0, -(-count // _PER_WORD) - len(words))))
