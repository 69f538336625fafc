"""`morgs-mi salvage`."""

from __future__ import annotations

from pathlib import Path

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import play, reemitted_keyframe
from morgs_mi.codec.reader import StreamReader
from tests.cli.commands import assert_refused
from tests.scenes.changing_splats import write_stream
from tests.scenes.noise_capture import rig


def test_salvage__writes_the_intact_frames_and_lists_the_lost_ones(tmp_path: Path, run) -> None:
    path, new = tmp_path / "stream.morgs", tmp_path / "new.morgs"
    states = write_stream(path, 5)
    packets = list(StreamReader(path))
    with StreamWriter(path, rig(), 25, {"num_frames": 5}) as writer:
        for packet in packets:
            writer.write(packet)
    index, data = StreamReader(path).index(), bytearray(path.read_bytes())
    data[index[2][2] + 40] ^= 1
    path.write_bytes(data)
    status, output, _ = run("salvage", tmp_path, new)
    assert status == 0
    damaged, after, *_, result, lost = output.splitlines()
    assert damaged == f"{path}: bytes {index[2][2]} to {index[3][2]}: the bytes are damaged."
    assert f"bytes {index[3][2]} to {index[4][2]}: intact packet 3, frame 3: it does not continue" in after
    assert result == f"{new}: 2 frames, 0 to 1."
    assert lost.startswith("3 frames cannot be played, 2 to 4: their packets are damaged, missing, or continue one")
    assert [frame for frame, _ in play(StreamReader(new))] == [0, 1]

    # Playback continues at the keyframes after the missing frames.
    with StreamWriter(path, rig(), 25, {"num_frames": 6}) as writer:
        for state in (states[0], states[3], states[4]):
            writer.write(reemitted_keyframe(state))
    status, output, _ = run("salvage", tmp_path, new)
    assert (status, output.splitlines()[0]) == (0, f"{new}: 3 frames, 0, 3 to 4.")
    assert "3 frames cannot be played, 1 to 2, 5: " in output

    # Metadata may have any type and size.
    for total, named in ((10**18, f", 5 to {10**18 - 1}: "), ("many", ", 1 to 2: "), (2, ", 1 to 2: ")):
        with StreamWriter(path, rig(), 25, {"num_frames": total}) as writer:
            for state in (states[0], states[3], states[4]):
                writer.write(reemitted_keyframe(state))
        status, output, _ = run("salvage", tmp_path, new)
        assert status == 0
        assert named in output

    assert_refused(run("salvage", tmp_path, path), "expected a new file, got the damaged stream itself")
