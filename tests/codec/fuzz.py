"""Program that reads a number of damaged and forged streams, or until a time is over, with little
memory and little time for each.

`python -m tests.codec.fuzz CASES SECONDS [FUZZER ...]` prints the number of streams as JSON; CASES
may be inf. It needs a process of its own: a limit on the address space may end any thread of any
library, at once and without an exception (glibc exits with status 127 where it has no memory for
the thread-local data of a library).
"""

import faulthandler
import json
import re
import resource
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import morgs_mi  # noqa: F401  (finds a usable LLVM before the variant is set)
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.playback.player import has_confidence
from morgs_mi.playback.stream_header import num_frames, open_stream_capture, render_config
from tests.codec.forge import (
    damaged,
    with_forged_bytes,
    with_forged_header,
    with_forged_packets,
)
from tests.scenes.short_clip import FRAMES, short_clip

# What a stream of a few kB may take: far less than a damaged length or count may request. A thread
# of a library that starts meanwhile reserves 64 MiB for its heap and 8 MiB for its stack (glibc).
MEMORY_BYTES = 200 * 10**6
THREAD_BYTES = 72 * 2**20
THREADS = 4
CASE_SECONDS = 30
PLACE = re.compile(
    r"packet \d+ at byte \d+: |packet 0: metadata: `|expected a stream that starts with|"
    r"expected the path of its capture"
)


def check_named(path, error):
    """Check that an error names the file."""
    assert str(error).startswith(f"{path}: "), error


def check_sentence(path, error):
    """Check that an error is a sentence that names the file and the place."""
    check_named(path, error)
    assert PLACE.search(str(error)), error


def check_damage(clip, path, rng):
    """Check that all damage is reported, and that every intact frame plays as it was."""
    data = damaged(clip, rng)
    path.write_bytes(data)
    if data != clip.data:
        check_intact_frames(clip, data, path)
        check_readers(path)


def check_intact_frames(clip, data, path):
    """Check the frames of a file that differs from the clip by damage without a right CRC."""
    intact = [
        data[piece.start : piece.stop] == clip.data[piece.start : piece.stop]
        for piece in clip.pieces
    ]
    intact = [
        same and piece.stop <= len(data) for same, piece in zip(intact, clip.pieces, strict=True)
    ]
    first = intact.index(False)  # the first damaged piece
    played, error = play(path)
    if clip.pieces[first].start == len(data) and first > 1:
        assert error is None  # the file just ends
        assert not StreamReader(path).closed()
    elif first:  # the sentence names the place, except for the preamble
        assert f"packet {max(first - 1, 0)} at byte {clip.pieces[first].start}: " in str(error)
    assert [state.frame for state in played] == sorted(
        {p.frame for p in clip.pieces[2:first] if p.kind < 3}
    )
    assert not any(differs(state, clip) for state in played)
    if not (intact[0] and intact[1]):
        return
    # A reader that skips damage plays what plays before it, and finds what is behind it by an
    # intact index.
    stream = StreamReader(path, skip_damaged=True)
    states = list(coded_frames(stream))
    frames = [state.frame for state in states]
    assert not any(differs(state, clip) for state in states)
    assert set(frames) >= {state.frame for state in played}
    if intact[-1]:
        assert frames == playable(clip, intact)
        assert stream.skipped == sorted({*range(FRAMES)} - {*frames})
        for piece in clip.pieces[first + 1 : -1]:
            behind = [
                p
                for p in clip.pieces[first:]
                if p.start >= piece.start and p.frame <= piece.frame + 1
            ]
            if (
                piece.kind == 1
                and piece.frame + 1 < FRAMES
                and all(intact[clip.pieces.index(p)] for p in behind)
            ):
                assert not differs(StreamReader(path).seek(piece.frame + 1), clip)


def playable(clip, intact):
    """Return the playable frames; their packets are intact back to a keyframe."""
    frames = []
    for piece, ok in zip(clip.pieces, intact, strict=True):
        has_base = bool(frames) and piece.frame in (frames[-1], frames[-1] + 1)
        if ok and piece.frame not in frames and (piece.kind == 1 or (piece.kind == 2 and has_base)):
            frames.append(piece.frame)
    return frames


def check_bytes(clip, path, rng):
    """Check that a forged packet affects its own frame at most: the next residual refuses another
    state.
    """
    data = with_forged_bytes(clip, rng)
    path.write_bytes(data)
    forged = {p.frame for p in clip.pieces if data[p.start : p.stop] != clip.data[p.start : p.stop]}
    assert {state.frame for state in play(path)[0] if differs(state, clip)} <= forged
    check_readers(path)


def check_forged(forge, clip, path, rng):
    """Check the readers of a forged stream."""
    path.write_bytes(forge(clip, rng))
    check_readers(path)


def check_readers(path):
    """Check that a file plays and can be sought, also without its damage, or is refused by
    sentences with the place.
    """
    played, error = play(path)
    if error is not None:
        check_sentence(path, error)
    try:
        stream = StreamReader(path)
    except ValueError:
        return
    check_seek(stream, played)
    try:
        list(coded_frames(StreamReader(path, skip_damaged=True)))
    except ValueError as refusal:
        check_sentence(path, refusal)
    for read in (
        render_config,
        has_confidence,
        num_frames,
        lambda stream: open_stream_capture(stream, None, [0]),
    ):
        try:
            read(stream)
        except ValueError as refusal:
            check_sentence(path, refusal)
        except FileNotFoundError:  # the capture
            pass


def check_seek(stream, played):
    """Check that frames that play are sought, one in the middle and the last, or are refused by
    sentences.

    A reader that starts at a keyframe has nothing to compare it with: what it finds may differ from
    what plays, or end in an error, where that keyframe is forged.
    """
    digests = {state.frame: state.digest for state in played}
    for state in (*played[len(played) // 2 : -1][:1], *played[-1:]):
        try:
            start = next(stream.states(state.frame))
            decoded_state = stream.seek(state.frame)
        except ValueError as refusal:
            check_named(stream.path, refusal)
            continue
        assert decoded_state.frame == state.frame
        if np.array_equal(start.digest, digests.get(start.frame)):
            assert np.array_equal(decoded_state.digest, state.digest), state.frame


def play(path):
    """Return the frames that a reader decodes from the start, and the error that ends it."""
    played = []
    try:
        played.extend(coded_frames(StreamReader(path)))
    except ValueError as error:
        return played, error
    return played, None


def differs(state, clip):
    expected = clip.states.get(state.frame)
    return expected is None or not np.array_equal(state.digest, expected.digest)


FUZZERS = {
    "damage": check_damage,
    "bytes": check_bytes,
    "packets": partial(check_forged, with_forged_packets),
    "header": partial(check_forged, with_forged_header),
}


def limit_memory():
    """Limit the address space to what it has now and what a case may take."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY_BYTES + THREADS * THREAD_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def run(name, clip, cases, seconds):
    """Run a fuzzer for a number of cases, at most some seconds, and return its number of streams.

    Raises:
        AssertionError: a case fails; its seed is the name of the fuzzer and the number of the case.
    """
    case = 0
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s"
        while case < cases and time.monotonic() < end:
            faulthandler.dump_traceback_later(CASE_SECONDS, exit=True)
            try:
                FUZZERS[name](clip, path, np.random.default_rng([case, *name.encode()]))
            except BaseException as error:
                raise AssertionError(f"case {case} of {name}") from error
            case += 1
            if case % 100 == 0:
                dr.flush_malloc_cache()
    faulthandler.cancel_dump_traceback_later()
    return {"streams": case}


def main(cases, seconds, *names):
    """Run fuzzers for a number of cases, at most some seconds each, and print the results."""
    mi.set_variant("llvm_ad_rgb")
    faulthandler.enable()
    clip = short_clip()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "s").write_bytes(clip.data)
        # What is loaded and cached once does not count.
        check_readers(Path(folder) / "s")
    limit_memory()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    results = {name: run(name, clip, float(cases), float(seconds)) for name in names or FUZZERS}
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory)
    print(
        json.dumps({"seconds": float(seconds), "memory_bytes": grown, "fuzzers": results}, indent=1)
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
