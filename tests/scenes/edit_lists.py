"""Clips that are cut by an edit list, as programs do that do not encode them again."""

import struct

PER_SECOND = 1000
"""Units of the lengths in an edit list; FFmpeg writes milliseconds."""


def show_parts(path, parts):
    """Let an .mp4 or .mov of `write_timed_video` show only parts of itself in succession, given by
    their starts and lengths, s.

    A part with a negative start is a pause.
    """
    data = path.read_bytes()
    scale = _number(data, data.index(b"mdhd") + 16)
    # Time of the first frame in the track: it has later frames before it.
    first = _number(data, data.index(b"elst") + 16)
    entries = b"".join(
        struct.pack(
            ">IiI",
            round(PER_SECOND * length),
            -1 if start < 0 else first + round(scale * start),
            0x10000,
        )
        for start, length in parts
    )
    path.write_bytes(with_list(data, b"elst", len(parts), entries, (b"moov", b"trak", b"edts")))
    return path


def with_list(data, name, count, entries, parents):
    """Return an .mp4 with other entries in the box of a list, which changes the sizes of its
    parents.
    """
    start = data.index(name) - 4
    size = _number(data, start)
    box = struct.pack(">I4sII", 16 + len(entries), name, 0, count) + entries
    grown = bytearray(data[:start] + box + data[start + size :])
    for parent in parents:
        at = grown.index(parent) - 4
        grown[at : at + 4] = struct.pack(">I", _number(grown, at) + len(box) - size)
    return bytes(grown)


def _number(data, at):
    return struct.unpack(">I", data[at : at + 4])[0]
