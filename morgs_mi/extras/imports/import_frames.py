"""Frames of other tools as a stream: one file with Gaussians per frame, without a capture.

Files do not name their Gaussians, so identities follow from the order of the rows. If a frame has
as many as the frame before, and nearly every row resembles the same row there more than the next
one, the rows are taken for the same Gaussians. Otherwise rows may have been removed and added: each
row is matched with the most similar one of the frame before, and the longest sequence of matches in
the order of both frames survives. If that is most of the Gaussians, the frame becomes a residual,
and the survivors keep their ids; otherwise it becomes a keyframe with a new set of Gaussians.

The header of a stream has at least one camera, on whose screen the codec measures its errors and
with which players begin. An imported stream has a ring of them, which sees the Gaussians of several
frames.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import Packet, PacketKind, StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, residual_packet
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.listing import existing_file, listed
from morgs_mi.io.numbering import natural_key
from morgs_mi.io.splats import CONVERT, SUFFIXES, read_splats, suffix_of
from morgs_mi.platform.checks import check_number, errors_at, require
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.files import STREAM, atomic_path
from morgs_mi.platform.progress import StepReport, unreported
from morgs_mi.playback.default_rig import BOX, DEFAULT_RIG, Axes, default_rig, scene_box
from morgs_mi.runs.fit_files import due_keyframe

_FRAMES_IN_VIEW = 3  # first, middle and last
# With rows of other Gaussians the share is about a half; with the same ones, only near-duplicates
# reduce it.
_LEAST_SHARE = 0.95
# Share of the smaller frame that survives at least. Of n matches in random order, about 2 sqrt(n)
# are a sequence.
_LEAST_SURVIVORS = 0.8


@dataclass(frozen=True)
class Imported:
    """Result of an import."""

    path: Path  #: The stream.
    num_frames: int  #: Number of its frames.
    num_keyframes: int  #: Number of the frames that start a new set of Gaussians.
    num_bytes: int  #: Size of the stream.


def import_frames(
    sources: Sequence[str | Path],
    out: str | Path,
    fps: float = 30.0,
    config: CodecConfig | None = None,
    axes: Axes = "y-down",
    progress: StepReport = unreported,
    most_invalid: float = 0.0,
) -> Imported:
    """Write files with Gaussians, one per frame, as a stream, and return a summary; the stream is
    written atomically.

    One frame is in memory at a time. Motion is the displacement since the frame before, zero in
    keyframes; confidence and offset are not stored.

    Args:
        sources: one folder, or the files in the order of the frames, see `find_frames`.
        out: new file with a name that ends in ``.morgs``, or a folder for ``stream.morgs``; folders
            are created.
        fps: frames per second.
        config: precision of the stream.
        axes: direction that is up.
        progress: called with (frames done, number of frames).
        most_invalid: share of a frame's Gaussians with invalid numbers that are left out with a
            warning; 0: none.

    Raises:
        FileNotFoundError: a file or the folder is missing.
        FileExistsError: the stream exists.
        ValueError: there are no frames, one is broken, or `fps` is out of range.
        OSError: the stream cannot be written.
    """
    check_number("import_frames()", "fps", fps, "[1e-6, 1e6]")
    config = config_or_default("import_frames()", config, CodecConfig())
    paths = find_frames(sources)
    path = Path(out) if Path(out).suffix.lower() == ".morgs" else Path(out) / STREAM
    if path.exists():
        raise FileExistsError(
            f"{path}: expected a new stream, got a file that exists; remove it, or name another."
        )
    in_view = np.unique(np.linspace(0, len(paths) - 1, _FRAMES_IN_VIEW).astype(int))
    frames_in_view = [read_splats(paths[t], most_invalid) for t in in_view]
    with errors_at(paths[0].parent):
        box = scene_box(frames_in_view)
        cameras = default_rig(frames_in_view, box, axes)
    del frames_in_view
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "num_frames": len(paths),
        DEFAULT_RIG: True,
        BOX: box.tolist(),
        "config": {"codec": asdict(config)},
    }
    frames = (read_splats(source, most_invalid) for source in paths)
    keyframes = 0
    with (
        atomic_path(path, "import_frames()") as partial,
        StreamWriter(partial, cameras, fps, metadata) as writer,
    ):
        for done, packets in enumerate(_packets_of_frames(frames, cameras, config), 1):
            keyframes += packets[0].kind == PacketKind.KEYFRAME
            for packet in packets:
                writer.write(packet)
            progress(done, len(paths))
    return Imported(path, len(paths), keyframes, path.stat().st_size)


def _packets_of_frames(
    frames: Iterable[Gaussians], cameras: Sequence[Camera], config: CodecConfig
) -> Iterator[list[Packet]]:
    """Yield the packet of each frame, and after it the keyframe that is due, if any."""
    state = None
    order = np.zeros(0, np.int64)  # of the frame's Gaussians in the state
    for frame, gaussians in enumerate(frames):
        rows = (
            None
            if state is None
            else matched_rows(state.gaussians.select(np.argsort(order)), gaussians)
        )
        if state is None or rows is None:
            order = np.arange(len(gaussians))
            packet = keyframe_packet(gaussians, frame, cameras, config)
            state = decode(state, packet)
            yield [packet]
            continue
        # Rows in the state, -1 for births, and the new order there, in which births are last.
        rows = np.where(rows < 0, -1, np.argsort(order)[rows])
        order = np.argsort(np.where(rows < 0, len(order), rows), kind="stable")
        packet = residual_packet(state, gaussians.select(order), rows[order], cameras, config)
        state = decode(state, packet)
        yield [packet, *due_keyframe(state, config.keyframe_interval)]


def find_frames(sources: Sequence[str | Path]) -> list[Path]:
    """Return the files of the frames in their order.

    Args:
        sources: one folder, whose files with the suffixes of `SUFFIXES` are ordered by the numbers
            in their names; or files, which stay in the given order.

    Raises:
        FileNotFoundError: the folder or a file is missing.
        ValueError: there are no such files, or they have several formats.
    """
    paths = [Path(source) for source in sources]
    place = paths[0] if paths else "import_frames()"
    if len(paths) == 1 and paths[0].is_dir():
        files = sorted(listed(paths[0]), key=lambda path: natural_key(path.name))
        paths = [path for path in files if suffix_of(path)]
    for path in paths:
        existing_file(path, f"one folder of frames, or files ({', '.join(SUFFIXES)})")
    kinds = f"files whose names end in {', '.join(SUFFIXES)}"
    require(paths, place, f"expected a folder with {kinds}", "none", CONVERT)
    first = {suffix_of(path): path for path in reversed(paths)}
    if None in first:
        raise ValueError(f"{first[None]}: expected one folder, or {kinds}, got another; {CONVERT}.")
    require(
        len(first) == 1,
        place,
        "expected frames of one format",
        " and ".join(path.name for path in first.values()),
        "name the files of one of them",
    )
    return paths


def matched_rows(before: Gaussians, now: Gaussians) -> np.ndarray | None:
    """Return the row in the frame before of each Gaussian, -1 for births; None if the frames have
    other Gaussians.

    Args:
        before: N Gaussians.
        now: M Gaussians.

    Returns:
        int64 [M]: ascending apart from the births.
    """
    fewer = min(len(before), len(now))
    if before.sh_degree != now.sh_degree or not fewer:
        return None
    # In units of their spread in the frame before, without those that are equal there.
    old = _features(before)
    spread = old.std(axis=0)
    old = old[:, spread > 0] / spread[spread > 0]
    new = _features(now)[:, spread > 0] / spread[spread > 0]
    if len(old) == len(new):
        distances = np.square(new - old).sum(axis=1)
        distances_to_next = np.square(new - np.roll(old, -1, axis=0)).sum(axis=1)
        if np.mean(distances <= distances_to_next) >= _LEAST_SHARE:
            return np.arange(len(now))
    if not old.shape[1] or not np.isfinite(new).all():  # they cannot be compared
        return None
    # The search takes forever among many that are equal.
    distinct, first = np.unique(old, axis=0, return_index=True)
    nearest = first[KDTree(distinct).query(new)[1]]
    survivors = _increasing(nearest)
    if len(survivors) < _LEAST_SURVIVORS * fewer:
        return None
    # Between two survivors with as many rows between them in both frames, those are the same ones,
    # too; the others are births.
    rows = np.full(len(now), -1)
    rows[survivors] = nearest[survivors]
    pairs = np.stack([survivors, nearest[survivors]], axis=1)
    ends = np.concatenate([[[-1, -1]], pairs, [[len(now), len(before)]]])
    gap, gap_before = np.diff(ends, axis=0).T
    for k in np.flatnonzero((gap == gap_before) & (gap > 1)):
        row, row_before = ends[k] + 1
        rows[row : row + gap[k] - 1] = np.arange(row_before, row_before + gap[k] - 1)
    return rows


def _increasing(numbers: np.ndarray) -> np.ndarray:
    """Return the indices of a longest strictly increasing subsequence of integers [n]."""
    ends: list[int] = []  # least last number of a subsequence of each length
    lasts: list[int] = []  # its index
    previous = np.full(len(numbers), -1)
    for index, number in enumerate(numbers.tolist()):
        length = bisect_left(ends, number)
        previous[index] = lasts[length - 1] if length else -1
        ends[length : length + 1] = [number]
        lasts[length : length + 1] = [index]
    indices = np.empty(len(lasts), np.int64)
    index = lasts[-1] if lasts else -1
    for place in reversed(range(len(lasts))):
        indices[place] = index
        index = previous[index]
    return indices


def _features(gaussians: Gaussians) -> np.ndarray:
    """Return the numbers by which rows are compared, float64 [N, 10]."""
    raw = gaussians.numpy()
    # Opacities of 0 and 1 have logits far from all others.
    opacities = np.clip(raw["logit_opacities"], -5, 5)[:, None]
    return np.concatenate(
        [raw["means"], raw["log_scales"], opacities, raw["sh_coeffs"][:, 0]],
        axis=1,
        dtype=np.float64,
    )
