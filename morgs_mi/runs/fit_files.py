"""The files of a fit: its stream, its report, and what an interrupted fit continues from.

A fit may be killed at any instruction. The stream then holds complete packets and perhaps a part of
the next one. A frame's row is written to the report before its packets are written to the stream,
so every packet has a row. Nothing else is stored, because the state of the loop follows from the
stream and the recording (see `StreamState`).

A fit into a folder that has a stream writes hidden files beside it until its first frame is there.
They then replace the earlier stream, its description and its report together.

A stream is made to be shared, so its header has no paths. The path of the capture is in the
`capture.json` beside it.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.fingerprint import fingerprint
from morgs_mi.capture.outputs import check_output
from morgs_mi.codec.container import (
    Packet,
    PacketKind,
    StreamWriter,
    TruncatedStreamError,
    header_json,
)
from morgs_mi.codec.packets import CodedFrame, decode, reemitted_keyframe
from morgs_mi.codec.reader import Entry, StreamReader
from morgs_mi.core.color_space import TRANSFER
from morgs_mi.core.rig import choose_key_views
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import Exposure
from morgs_mi.platform.bounded import JsonObject, read_json
from morgs_mi.platform.files import (
    CAPTURE,
    PROVISIONAL,
    REPORT,
    STREAM,
    atomic_path,
    is_same_file,
    write_json,
)

_LOG = logging.getLogger(__name__)

FILES = (STREAM, CAPTURE, REPORT)
"""Names of the files that a fit writes into its folder."""


class FitFiles(NamedTuple):
    """Stream and report of a fit, and the description of its capture; None: there is none, as in a
    chunk.
    """

    stream: Path
    report: Path
    description: Path | None = None

    @property
    def provisional(self) -> Path:
        """Stream of a provisional first frame."""
        return self.stream.with_name(PROVISIONAL)

    @property
    def next(self) -> FitFiles:
        """Hidden files that are to replace these."""
        return FitFiles(
            *(path.with_name(f".next-{path.name}") for path in self if path is not None)
        )

    @classmethod
    def of(cls, out: Path) -> FitFiles:
        """Return the files of a fit in the folder `out`."""
        return cls(*(out / name for name in (STREAM, REPORT, CAPTURE)))

    def settle(self) -> None:
        """Finish a replacement that was cut off, or remove the `next` files of one that had not
        begun.

        The stream is replaced first and removed last, which distinguishes the two.

        Raises:
            OSError: a file cannot be renamed.
        """
        has_begun = not self.next.stream.exists()
        paths = [path for path in self if path is not None]
        for path, successor in reversed([*zip(paths, self.next, strict=False)]):
            assert successor is not None
            if has_begun and successor.exists():
                successor.replace(path)
            successor.unlink(missing_ok=True)


def check_outputs(out: Path) -> None:
    """Check that a fit may write its files into a folder; see `check_output`."""
    for name in FILES:
        check_output(out / name)


@dataclass(eq=False)
class ProvisionalFrame:
    """Provisional first frame beside a stream, which viewers show until the stream has its first
    frame.
    """

    path: Path  #: File of the frame; one of an earlier fit is removed.
    capture: Capture  #: Cameras and frame rate of the stream's header.
    metadata: JsonObject  #: Other entries of the header, from `stream_metadata`.
    is_shown: bool = True  #: False after it could not be written.

    def __post_init__(self) -> None:
        self.path.unlink(missing_ok=True)

    def show(self, keyframe: Packet, progress: Mapping[str, float | None] | None = None) -> None:
        """Write a keyframe, with the progress of its fit in the header's metadata.

        If it cannot be written, e.g. because the disk has room for the result alone, a warning is
        logged, and it and later ones are skipped.
        """
        if not self.is_shown:
            return
        metadata = {**self.metadata, "provisional": progress}
        try:
            with (
                atomic_path(self.path, "ProvisionalFrame.show()") as partial,
                StreamWriter(partial, self.capture.cameras, self.capture.fps, metadata) as writer,
            ):
                writer.write(keyframe)
        except OSError:
            self.is_shown = False
            _LOG.warning(
                "%s: a provisional first frame cannot be written, perhaps for lack of room; the "
                "fit goes on without it",
                self.path,
            )


class Recording:
    """Stream and report of a fit, to which frames are added; a context manager.

    The files of an earlier fit stay until the first frame replaces them.

    Args:
        files: the stream, the report and the description of the capture.
        capture: cameras and frame rate of the stream's header.
        metadata: other entries of the header, from `stream_metadata`.
        earlier: an interrupted fit to continue; None to begin.

    Attributes:
        reports: of the frames.

    Raises:
        OSError: a file cannot be written.
    """

    def __init__(
        self,
        files: FitFiles,
        capture: Capture,
        metadata: JsonObject,
        earlier: Interrupted | None = None,
    ) -> None:
        self._files = files
        self._metadata = metadata
        self._interval: int = metadata["config"]["codec"]["keyframe_interval"]
        self.reports: list[FrameReport] = []
        files.settle()
        self._written_files = files.next if earlier is None and files.stream.exists() else files
        if earlier is None:
            stream = self._written_files.stream
            self._writer = StreamWriter(stream, capture.cameras, capture.fps, metadata)
        else:
            self.reports += earlier.reports
            self._writer = StreamWriter.continued(files.stream, earlier.index, earlier.end)
            if earlier.index[-1][0] == PacketKind.RESIDUAL:
                for packet in due_keyframe(earlier.coded, self._interval):
                    self._writer.write(packet)
        self._written = os.stat(self._written_files.stream)
        if self._written_files.description is not None:
            description = capture.metadata()
            with suppress(OSError, ValueError, TypeError):
                description |= read_json(self._written_files.description) if earlier else {}
            description["capture"] = str(Path(capture.path).resolve())
            write_json(self._written_files.description, description)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._writer.close()
        self._files.provisional.unlink(missing_ok=True)
        self._files.settle()
        if kind is None:
            self._check_in_place()

    def push(
        self, packet: Packet, report: FrameReport, coded: CodedFrame | None, **entries: Any
    ) -> None:
        """Add a frame, and the keyframe that is due after it.

        Args:
            packet: of the frame.
            report: of the frame.
            coded: state of a decoder after it.
            entries: further entries of the report.

        Raises:
            OSError: the disk is full or not writable, or the stream was removed, moved or replaced;
                the stream is complete up to the last frame.
        """
        self.extend([packet, *due_keyframe(coded, self._interval)], [report], **entries)

    def extend(
        self, packets: Iterable[Packet], reports: Iterable[FrameReport], **entries: Any
    ) -> None:
        """Add frames with all their packets; see `push`."""
        self._check_in_place()
        reports = [*self.reports, *reports]
        # The disk may have room for only one of the two first frames.
        self._files.provisional.unlink(missing_ok=True)
        write_json(
            self._written_files.report,
            {**self._metadata, "frames": [asdict(report) for report in reports], **entries},
        )
        for packet in packets:
            self._writer.write(packet)
        self.reports = reports
        if self._written_files is not self._files:
            # `settle` finishes what a kill leaves undone.
            self._files.next.stream.replace(self._files.stream)
            self._files.settle()
            self._written_files = self._files

    def _check_in_place(self) -> None:
        """Raise `FileNotFoundError` if the stream has been removed, moved or replaced."""
        path = self._written_files.stream
        if not is_same_file(path, self._written):
            kind = "another file" if path.exists() else "none"
            raise FileNotFoundError(
                f"{path}: expected the stream that is being written, found {kind}; resume it there."
            )


@dataclass(frozen=True, eq=False)
class Interrupted:
    """An interrupted fit, up to its last complete packet."""

    stream: StreamReader  #: Its stream.
    index: Sequence[Entry]  #: The complete packets.
    end: int  #: Offset of the end of the last one.
    coded: CodedFrame  #: State after it.
    restart: tuple[bytes, ...]  #: Encoded packets that lead a decoder to that state.
    reports: list[FrameReport]  #: Of the frames.


def interrupted_fit(
    files: FitFiles,
    capture: Capture,
    metadata: JsonObject,
    first: int = 0,
) -> Interrupted | None:
    """Return an interrupted fit, None if it has no complete packet yet, or none that it can
    continue from.

    Args:
        files: its stream and its report.
        capture: what is fitted.
        metadata: header that the fit would write.
        first: frame of the first row of the report: 0, or the start of a chunk.

    Raises:
        ValueError: the stream or the report is damaged, or belongs to another capture or other
            settings.
    """
    files.settle()
    try:
        stream = StreamReader(files.stream)
    except (FileNotFoundError, TruncatedStreamError):
        return None
    check_same_fit(stream, capture, metadata)
    index, end = stream.check()
    # After the first frame of a chunk alone, a fit would continue without its displacements.
    if not index or (first and index[-1][1] == first):
        return None
    frame = index[-1][1]
    coded = None
    previous_state = None
    last = None
    with suppress(TruncatedStreamError):
        for packet in takewhile(lambda packet: packet.frame <= frame, stream.near(frame)):
            if coded is None or packet.frame > coded.frame:
                previous_state = coded
                coded = decode(coded, packet)
                last = packet
    assert coded is not None
    assert last is not None
    reports = read_reports(files.report, range(first, frame + 1))
    return Interrupted(stream, index, end, coded, restart_of(previous_state, last), reports)


def restart_of(previous_state: CodedFrame | None, last: Packet) -> tuple[bytes, ...]:
    """Return encoded packets that lead a decoder to the state after a frame.

    Args:
        previous_state: state before the frame; None if its packet is a keyframe.
        last: packet of the frame.
    """
    return (
        (last.encoded,)
        if previous_state is None
        else (reemitted_keyframe(previous_state).encoded, last.encoded)
    )


def check_same_fit(stream: StreamReader, capture: Capture, metadata: JsonObject) -> None:
    """Check that a stream to resume has the header that a fit would write.

    Raises:
        ValueError: it belongs to another capture or other settings.
    """
    # Refined cameras differ from the calibrated ones, which are part of the fingerprint then.
    refined = metadata["config"]["fit"]["refine_cameras"] != "off"
    cameras = stream.cameras if refined else capture.cameras
    # Streams of earlier versions have paths in their headers.
    excluded_names = ("capture", "distortions")
    old_metadata = {
        name: value for name, value in stream.metadata.items() if name not in excluded_names
    }
    old = json.loads(header_json(stream.cameras, stream.fps, old_metadata))
    if difference := _difference(old, json.loads(header_json(cameras, capture.fps, metadata))):
        name, old_value, new_value = difference
        raise ValueError(
            f"{stream.path}: expected to resume a fit with {name} = {shortened(old_value)}, got "
            f"{shortened(new_value)}; give the same, or start again without --resume."
        )


def stream_metadata(capture: Capture, first: PartialFrame, config: StreamConfig) -> JsonObject:
    """Return the entries of the stream's header about the fit; they must agree for a fit to be
    resumed.
    """
    train = capture.train_views
    key_views = choose_key_views(capture.views.train.cameras, config.motion.key_views)
    motion = replace(
        config.motion,
        flow_method=_without_folder(config.motion.flow_method),
        mask_method=_without_folder(config.motion.mask_method),
    )
    metadata = {
        "fingerprint": fingerprint(capture, first.images, config.fit.refine_cameras != "off"),
        "downscale": capture.downscale,
        "test_view": list(capture.test_views),
        "reading": asdict(capture.reading),
        "train_views": list(train),
        "num_frames": capture.num_frames,
        "key_views": [train[v] for v in key_views],
        # Without empty lists, such as terms that no module registers.
        "config": asdict(
            replace(config, motion=motion),
            dict_factory=lambda items: {k: value for k, value in items if value != ()},
        ),
        "versions": {"mitsuba": mi.__version__},
        "variant": mi.variant(),
    }
    if any(capture.origin):
        metadata["origin"] = list(capture.origin)
    if capture.display_exposure is not None:
        metadata["transfer"] = {"name": TRANSFER, "display_exposure": capture.display_exposure}
    return metadata


def _without_folder(method: str) -> str:
    """Return a method such as ``onnx:FILE`` with the name of its file alone."""
    kind, colon, files = method.partition(":")
    return kind + colon + ",".join(Path(file).name for file in files.split(","))


def _difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return (name, old, new) of the first entry in which two JSON values differ, None if they are
    equal.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        pairs = (
            _difference(old.get(key), new.get(key), f"{name}.{key}".lstrip("."))
            for key in {**old, **new}
        )
        return next(filter(None, pairs), None)
    return None if old == new else (name, old, new)


def read_reports(path: Path, frames: range) -> list[FrameReport]:
    """Return the reports of the first frames of a file, which are `frames`."""
    document = read_json(path) if path.exists() else {}
    reports = []
    try:
        for row in document["frames"][: len(frames)]:
            values = {
                "seconds": float(row["seconds"]),
                "status": "" + row["status"],  # a TypeError unless it is a string
                "psnr": float(np.float64(row.get("psnr"))),
                "missing_views": tuple(row["missing_views"]),
                "fingerprints": tuple(row.get("fingerprints", ())),
                "exposures": tuple(
                    Exposure(tuple(entry["gain"]), tuple(entry["bias"]))
                    for entry in row.get("exposures", ())
                ),
            }
            reports.append(FrameReport(**{**row, **values}))
        if [report.frame for report in reports] != list(frames):
            raise ValueError(f"{len(reports)} rows")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{path}: expected the report of {len(frames)} frames, got none or a broken one "
            f"({error}); start again without --resume."
        ) from None
    return reports


def due_keyframe(coded: CodedFrame | None, interval: int) -> list[Packet]:
    """Return the state as a keyframe where one is due."""
    if coded is None or not interval or not coded.frame or coded.frame % interval:
        return []
    return [reemitted_keyframe(coded)]
