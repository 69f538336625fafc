"""Streams of earlier releases: this one decodes them to the same numbers, or names their version.

`streams/` has a small stream for each version that this release reads, as the release that defined
it wrote it: births, a death, offsets, confidences and a re-emitted keyframe. Never write them
again.
"""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.codec.container import VERSION
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.platform.bounded import read_json

STREAMS = Path(__file__).parent / "streams"
PROMISES = (Path(__file__).parents[2] / "docs" / "promises.md").read_text(encoding="utf-8")


def summary(path):
    """Return the number of Gaussians and hashes of the integers and of the decoded numbers of each
    frame.
    """
    return [
        {
            "frame": coded.frame,
            "gaussians": len(coded),
            "integers": coded.digest.tobytes().hex(),
            **{
                name: hashlib.sha256(np.ascontiguousarray(value, "<f4")).hexdigest()[:16]
                for name, value in sorted(coded.gaussians.numpy().items())
            },
        }
        for coded in coded_frames(StreamReader(path))
    ]


@pytest.mark.parametrize("path", sorted(STREAMS.glob("*.morgs")), ids=lambda path: path.stem)
def test_old_streams__decode_to_the_same_numbers(path):
    expected = read_json(path.with_suffix(".json"))
    # The learned part of the motion is no longer read.
    for row in expected:
        row.pop("offset", None)
    assert summary(path) == expected
    assert (
        StreamReader(path).seek(expected[-1]["frame"]).digest.tobytes().hex()
        == expected[-1]["integers"]
    )


def test_old_streams__are_those_that_the_page_of_promises_lists():
    listed = re.findall(r"^\| (\d+) \| (yes|no) \|", PROMISES, re.MULTILINE)
    assert {int(version) for version, read in listed if read == "yes"} == {
        int(path.stem.removeprefix("version")) for path in STREAMS.glob("*.morgs")
    }
    assert max(int(version) for version, _ in listed) == VERSION


@pytest.mark.parametrize("version", [1, VERSION + 1])
def test_old_streams__of_other_versions_are_named(tmp_path, version):
    data = bytearray((STREAMS / "version2.morgs").read_bytes())
    data[8:12] = version.to_bytes(4, "little")
    (tmp_path / "other.morgs").write_bytes(data)
    with pytest.raises(
        ValueError,
        match=rf"and version {VERSION}, got b'MORGS-MI\\x0{version}.*read it with the release",
    ):
        StreamReader(tmp_path / "other.morgs")
