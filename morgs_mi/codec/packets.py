"""Frames <-> packets: a keyframe contains all integers of a frame, a residual the changes since the
frame before.

The state of a stream is a `CodedFrame`. Encoder and decoder compute it from the same packets with
the same integers, so the two cannot drift: after making a packet, take its `decode` as the new
state, and fit the next frame to that. Each residual also names the state that it continues, and is
refused by any other.

`source` [N'] maps a frame to the frame before: the index of the same Gaussian there, -1 for a
birth. Survivors come first in ascending order, births after them. Each Gaussian has one number in
`ids` for life; births get the next free ones.

Changes between two frames <-> columns: flags first, then the integers of the flagged groups.

Each Gaussian has one flag for each of the three groups of its geometry and one for each other
group, or is marked dead. The Gaussians that moved last and the static ones, as far as the
confidence distinguishes them, are coded separately, because their flags and residuals differ most.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import chain

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.entropy import LIMIT, ColumnReader, ColumnWriter
from morgs_mi.codec.frame_source import FrameState
from morgs_mi.codec.quantisation import (
    GROUPS,
    KNOWN_OPTIONAL,
    Grid,
    bounded,
    check_finite,
    groups_of,
    new_grid,
    num_exponents,
    num_integers,
    optional_mask,
    real_values,
    step_sizes,
)
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.platform.config import config_or_default

# Flags of the geometry of a Gaussian that dies; the first three groups are the bits below, all
# others those above.
_DEAD = 8
# Changes below a step are jitter of the fit, but in the base colour every bit is visible. Slightly
# less than a step, because a decoded state is rounded to float32 and must give the packet that it
# was decoded from.
_THRESHOLD = 0.99
_THRESHOLD_DC = 0.5
# An entropy code stores a column of one value in almost no bytes. A small packet must not request
# much memory: it has a word for each 16 Gaussians that it adds, or for each 16 of their integers if
# the state has more than 2^22. The integers of a fit take about four bits each, twice as much.
_PER_WORD = 16
_FREE_INTEGERS = 2**22
_MAX_QUANTIZER_STEP = 80  # quarter octaves: a million times the step


@dataclass(frozen=True, eq=False)
class Coder:
    """Coder of the changes from a state to the next Gaussians, with any quantizer step."""

    grid: Grid  #: The N Gaussians of the state.
    survivors: np.ndarray  #: Their indices in the state [S], ascending; the others die.
    rows: np.ndarray  #: Indices of the M survivors that differ.
    change: np.ndarray  #: Their differences by integer, in multiples of the grid's steps [C, M].

    def rounded(self, quantizer_step: int) -> np.ndarray:
        """Return the changes in whole steps, int32 [C, N]."""
        r = np.zeros((len(self.change), len(self.grid)), np.int32)
        steps = self.change / step_sizes(np.array(quantizer_step))
        for name, at in self.grid.columns.items():
            threshold = _THRESHOLD_DC if name == "sh_dc" else _THRESHOLD
            steps[at, np.max(np.abs(steps[at]), axis=0) < threshold] = 0
        r[:, self.rows] = np.clip(np.rint(steps, out=steps), 1 - LIMIT, LIMIT - 1, out=steps)
        return r

    def columns(self, r: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the columns of changes `r` [C, N] and of the deaths; `take_change` reads them."""
        flags = np.zeros(len(self.grid), np.int32)
        for name, at in self.grid.columns.items():
            flags |= np.any(r[at], axis=0).astype(np.int32) << GROUPS.index(name)
        dead = np.ones(len(self.grid), bool)
        dead[self.survivors] = False
        geometry = np.where(dead, _DEAD, flags % _DEAD)
        for rows in _classes(self.grid):
            yield geometry[rows]
            for some in _shape_classes(geometry[rows]):
                yield flags[rows[some]] // _DEAD
            for name, at in self.grid.columns.items():
                yield from r[at].take(rows[flags[rows] >> GROUPS.index(name) & 1 == 1], axis=1)


def take_change(
    reader: ColumnReader, grid: Grid, quantizer_step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the integers int32 [N, C] after changes with a quantizer step, and the mask of
    deaths, bool [N].

    Raises:
        ValueError: the columns do not describe changes, or a value leaves its range.
    """
    values = grid.values.copy()
    dead = np.zeros(len(grid), bool)
    step = step_sizes(np.array(quantizer_step))
    bits = sum(1 << GROUPS.index(name) for name in grid.columns) // _DEAD
    for rows in _classes(grid):
        geometry = reader.take(len(rows))
        appearance = np.zeros(len(rows), np.int64)
        for some in _shape_classes(geometry):
            appearance[some] = reader.take(int(some.sum()))
        if np.any((geometry < 0) | (geometry > _DEAD) | (appearance & ~bits != 0)):
            raise ValueError("its flags name groups that do not exist")
        dead[rows] = geometry == _DEAD
        flags = geometry % _DEAD + appearance * _DEAD  # bit k: the k-th of all groups changes
        for name, at in grid.columns.items():
            changed = rows[flags >> GROUPS.index(name) & 1 == 1]
            for column in values.T[at]:
                change = np.rint(reader.take(len(changed)) * step).astype(np.int64)
                column[changed] = bounded(column[changed] + change, -LIMIT, LIMIT - 1)
    return values, dead


def _shape_classes(geometry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of the Gaussians that keep their geometry, and of those that change it."""
    return geometry == 0, (geometry > 0) & (geometry < _DEAD)


def _classes(grid: Grid) -> list[np.ndarray]:
    """Return the indices of the static and of the moving Gaussians; without confidence, all count
    as static.
    """
    confidence = grid.columns.get("logit_confidence")
    moving = (
        np.zeros(len(grid), bool) if confidence is None else grid.values[:, confidence.start] > 0
    )
    return [np.flatnonzero(~moving), np.flatnonzero(moving)]


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
    groups = groups_of(gaussians)
    check_finite(groups)
    config = config_or_default("keyframe_packet()", config, CodecConfig())
    grid = new_grid(groups, cameras, config)
    return reemitted_keyframe(
        CodedFrame(frame, np.arange(len(grid), dtype=np.uint32), gaussians, grid, len(grid))
    )


def reemitted_keyframe(coded: CodedFrame) -> Packet:
    """Return the keyframe that decodes to exactly `coded`: an entry point for readers, without any
    loss.
    """
    grid = coded.grid
    gaps = np.diff(coded.ids.astype(np.int64), prepend=-1) - 1
    words = _words(chain([gaps], _grid_columns(grid)))
    head = np.array([len(grid), grid.degree, grid.optional, coded.next_id], np.uint32)
    return Packet(
        PacketKind.KEYFRAME,
        coded.frame,
        {"head": head, "code": _padded(words, len(grid), len(grid), grid.num_integers)},
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
        gaussians: N' Gaussians of the next frame with the same attributes.
        source: int [N'], see above; None if there are no births and no deaths.
        cameras: cameras in which the error of births is measured.
        config: tolerated errors.

    Raises:
        ValueError: an attribute is not finite.
    """
    config = config_or_default("residual_packet()", config, CodecConfig())
    grid = previous.grid
    source = np.arange(len(grid)) if source is None else np.asarray(source)
    survivors = source[source >= 0]
    assert (gaussians.sh_degree, optional_mask(gaussians.items())) == (grid.degree, grid.optional)
    assert np.all(np.diff(survivors) > 0)
    groups = groups_of(gaussians)
    check_finite(groups)

    # Survivors without any difference are skipped.
    previous_groups = groups_of(previous.gaussians)
    differs = np.zeros(len(survivors), bool)
    for name, value in groups.items():
        differences = value[: len(survivors)] != previous_groups[name][survivors]
        differs |= differences.any(axis=tuple(range(1, differences.ndim)))
    indices = np.flatnonzero(differs)
    rows = survivors[indices]
    new_groups = {name: value[indices] for name, value in groups.items()}
    change = real_values(new_groups, grid.select(rows))
    change -= grid.values[rows].T
    coder = Coder(grid, survivors, rows, change)

    births = len(gaussians) - len(survivors)
    birth_groups = {name: value[len(survivors) :] for name, value in groups.items()}
    birth_grid = new_grid(birth_groups, cameras, config)
    quantizer_step = round(4 * np.log2(config.birth_precision))
    if config.target_size:

        def fits(step: int) -> bool:
            return _code(coder, step, birth_grid).nbytes <= config.target_size

        quantizer_step = bisect_left(range(_MAX_QUANTIZER_STEP), True, quantizer_step, key=fits)
    arrays = {
        "parent": previous.digest,
        "head": np.array([births, quantizer_step], np.uint32),
        "code": _code(coder, quantizer_step, birth_grid),
    }
    return Packet(PacketKind.RESIDUAL, previous.frame + 1, arrays)


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
        is_residual = packet.kind == PacketKind.RESIDUAL
        expected = {"head": "uint32 [n]", "code": "uint32 [n]"}
        if is_residual:
            expected |= {"parent": "uint8 [n]"}
            # Earlier streams may have the learned part of the motion, which nothing else reads.
            expected |= {"offset": "uint32 [n]"} if "offset" in packet.arrays else {}
        arrays = {
            name: f"{array.dtype} {'[n]' if array.ndim == 1 else list(array.shape)}"
            for name, array in packet.arrays.items()
        }
        if arrays != expected:
            raise ValueError(f"expected the arrays {expected}, got {arrays}")
        if previous is not None and packet.frame <= previous.frame:
            raise ValueError(f"its frame must be above {previous.frame}, got {packet.frame}")
        if not is_residual:
            first_id = 0 if previous is None else previous.first_id + max(previous.next_id, 1)
            return _decoded_keyframe(packet, first_id)
        if previous is None or not np.array_equal(packet.arrays["parent"], previous.digest):
            state = "a state" if previous is None else f"the state after frame {previous.frame}"
            raise ValueError(
                f"it does not continue {state}; a packet is missing, start from a keyframe"
            )
        return _decoded_residual(previous, packet)
    except ValueError as error:
        raise ValueError(f"{where}: {error}.") from None


def _decoded_keyframe(packet: Packet, first_id: int) -> CodedFrame:
    limits = {"N": 2**32 - 1, "degree": 3, "optional": KNOWN_OPTIONAL, "next_id": LIMIT - 1}
    N, degree, optional, next_id = _head(packet, limits)
    code = packet.arrays["code"]
    _check_words(code, N, N, num_integers(degree, optional))
    reader = ColumnReader(code)
    ids = np.cumsum(reader.take(N) + 1) - 1
    grid = _taken_grid(reader, N, degree, optional)
    if np.any(np.diff(ids, prepend=-1) < 1) or (N and ids[-1] >= next_id):
        raise ValueError("its ids do not ascend")
    return CodedFrame(
        packet.frame, ids.astype(np.uint32), grid.gaussians(), grid, next_id, first_id=first_id
    )


def _decoded_residual(previous: CodedFrame, packet: Packet) -> CodedFrame:
    limits = {"births": LIMIT - 1 - previous.next_id, "quantizer_step": _MAX_QUANTIZER_STEP}
    births, quantizer_step = _head(packet, limits)
    code = packet.arrays["code"]
    grid = previous.grid
    reader = ColumnReader(code)
    values, dead = take_change(reader, grid, quantizer_step)
    survivors = np.flatnonzero(~dead)
    total = len(survivors) + births
    _check_words(code, births, total, grid.num_integers)
    new = replace(grid, values=values).select(survivors)
    motion = np.zeros((total, 3), np.float32)
    previous_means = np.asarray(previous.gaussians.means)[survivors]
    motion[: len(survivors)] = new.real("means").astype(np.float32) - previous_means
    if births:
        new = new.concatenate(_taken_grid(reader, births, grid.degree, grid.optional))
    new_ids = previous.next_id + np.arange(births, dtype=np.uint32)
    return replace(
        previous,
        frame=packet.frame,
        ids=np.concatenate([previous.ids[survivors], new_ids]),
        gaussians=new.gaussians(motion),
        grid=new,
        next_id=previous.next_id + births,
    )


def _taken_grid(reader: ColumnReader, N: int, degree: int, optional: int) -> Grid:
    first = 1 + num_exponents(optional)  # column of the values
    shifts = reader.take(num_integers(degree, optional))
    largest = _taken_columns(reader, N, shifts[:1], 0, 3).astype(np.uint8)
    exponents = _taken_columns(reader, N, shifts[1:first], -128, 127).astype(np.int8)
    values = _taken_columns(reader, N, shifts[first:], -LIMIT, LIMIT - 1)
    return Grid(values, exponents, largest[:, 0], degree, optional)


def _taken_columns(
    reader: ColumnReader, N: int, shifts: np.ndarray, low: int, high: int
) -> np.ndarray:
    """Return columns of shifted integers in low..high, int32 [N, number of shifts]."""
    columns = np.empty((N, len(shifts)), np.int32)
    for column, shift in zip(columns.T, shifts, strict=True):
        column[:] = bounded(reader.take(N) + shift, low, high)
    return columns


def coded_frames(packets: Iterable[Packet]) -> Iterator[CodedFrame]:
    """Decode packets in order and yield the state after each frame."""
    coded = None
    for packet in packets:
        if coded is None or (packet.kind, packet.frame) != (PacketKind.KEYFRAME, coded.frame):
            coded = decode(coded, packet)
            yield coded  # a re-emitted keyframe is for readers that start there


def _grid_columns(grid: Grid) -> Iterator[np.ndarray]:
    """Yield the columns of new Gaussians, as `_taken_grid` reads them."""
    columns = np.concatenate(
        [grid.largest_components[:, None], grid.exponents, grid.values], axis=1, dtype=np.int64
    )
    middle = np.zeros(columns.shape[1], np.int64)
    if len(columns):
        middle = np.sort(columns, axis=0)[len(columns) // 2]
        middle[np.abs(columns - middle).max(0) >= LIMIT] = 0
    yield middle
    # Small integers have a token of their own, large ones one per octave.
    yield from (columns - middle).T


def _words(columns: Iterable[np.ndarray]) -> np.ndarray:
    writer = ColumnWriter()
    for column in columns:
        writer.put(column)
    return writer.words()


def _code(coder: Coder, quantizer_step: int, birth_grid: Grid) -> np.ndarray:
    """Return the words of the changes with a quantizer step, and of the births."""
    r = coder.rounded(quantizer_step)
    births = len(birth_grid)
    words = _words(chain(coder.columns(r), _grid_columns(birth_grid) if births else ()))
    total = len(coder.survivors) + births
    return _padded(words, births, total, birth_grid.num_integers)


def _head(packet: Packet, limits: dict[str, int]) -> list[int]:
    """Return the numbers in the head of a packet, each of which has a limit."""
    head = packet.arrays["head"].tolist()
    if len(head) != len(limits) or np.any(np.greater(head, [*limits.values()])):
        raise ValueError(
            f"its head must have numbers of at most {limits}, got {head}; read it with the release "
            "that wrote it"
        )
    return head


def _padded(words: np.ndarray, births: int, total: int, integers: int) -> np.ndarray:
    return np.pad(words, (0, max(0, _least_words(births, total, integers) - len(words))))


def _check_words(code: np.ndarray, births: int, total: int, integers: int) -> None:
    least = _least_words(births, total, integers)
    if len(code) < least:
        raise ValueError(f"{births} births take at least {least} words of code, got {len(code)}")


def _least_words(births: int, total: int, integers: int) -> int:
    """Return the number of words that a packet has at least if it adds some Gaussians to a state
    with a new total, and each has so many integers.
    """
    return -(-births * (integers if total * integers > _FREE_INTEGERS else 1) // _PER_WORD)
