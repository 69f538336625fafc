"""Frames in the stream: bit-exact states, stable ids, bounded errors, and messages that locate damage."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.container import Packet, PacketKind, StreamWriter, TruncatedStreamError, encode_packet
from morgs_mi.codec.packets import (
    CodedFrame,
    coded_frames,
    decode,
    frames_with_lasting_ids,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
    seek,
)
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians
from tests.assertions import assert_close
from tests.codec import plain_decoder
from tests.scenes.coded_clip import CAMERAS, cloud, encoded_clip, history, jittered, write


def assert_same(got: CodedFrame, expected: CodedFrame) -> None:
    assert (got.frame, got.next_id) == (expected.frame, expected.next_id)
    assert np.array_equal(got.digest, expected.digest)
    found = got.gaussians.numpy()
    for name, value in expected.gaussians.numpy().items():
        assert np.array_equal(found[name], value), name


@pytest.mark.parametrize("config", [None, CodecConfig(offset=True)], ids=["", "offset"])
def test_decode__equals_a_decoder_from_the_specification(tmp_path: Path, config: CodecConfig | None) -> None:
    packets, states = encoded_clip(6, config)
    write(tmp_path / "s", packets, states, every=3)
    plain = list(plain_decoder.states((tmp_path / "s").read_bytes()))
    assert [frame for frame, _ in plain] == [state.frame for state in states]
    for (_, found), state in zip(plain, states, strict=True):
        assert np.array_equal(found["ids"], state.ids)
        expected = state.gaussians.numpy()
        assert plain_decoder.numbers(found).keys() == expected.keys() - {"motion"}
        for name, value in plain_decoder.numbers(found).items():
            assert np.array_equal(value, expected[name]), name


def test_residual_packet__errors_stay_within_the_tolerance() -> None:
    """The error is at most half a step for a new Gaussian, a step for a moved one, half a step for its base colour."""
    config = CodecConfig(birth_precision=2)
    before = cloud(400)
    state = decode(None, keyframe_packet(before, 0, CAMERAS, config))
    after = jittered(before, np.random.default_rng(1))
    moved = decode(state, residual_packet(state, after, None, CAMERAS, config))
    for true, found, error, color_error in ((before, state, 0.5, 0.5), (after, moved, 2.0, 1.0)):
        for camera in CAMERAS:
            view = camera.viewmat
            a, b = (g.numpy()["means"].astype(float) @ view[:3, :3].T + view[:3, 3] for g in (true, found.gaussians))
            # At most, the errors of three coordinates add up.
            pixels = camera.K[0, 0] * np.abs(a - b)[:, :2] / a[:, 2:]
            assert pixels.max() < error * config.error_px * np.sqrt(3)
        sh = np.abs(true.numpy()["sh_coeffs"] - found.gaussians.numpy()["sh_coeffs"])
        assert 0.2821 * sh[:, 0].max() < 1.001 * color_error * config.error_color
        assert sh[:, 1:].max() < 1.001 * error * config.error_color
        opacity = np.abs(np.asarray(true.opacities) - np.asarray(found.gaussians.opacities))
        assert opacity.max() < 1.001 * error * config.error_opacity
        q, p = true.numpy()["quats"], found.gaussians.numpy()["quats"]
        cosine = np.abs((q * p).sum(1)) / np.linalg.norm(q, axis=1)
        # The steps are chosen for about 5 px: far below a tenth of a pixel at the ends of an axis.
        assert np.rad2deg(2 * np.arccos(np.minimum(cosine, 1))).max() < 8 * error
        assert opacity.max() > 0.7 * error * config.error_opacity, "the bound is near"


def test_codec_config__more_quality_takes_more_bytes_and_has_smaller_errors() -> None:
    before = cloud(400)
    after = jittered(before, np.random.default_rng(1))
    sizes, errors = [], []
    for quality in (0.25, 1, 4, 1000):
        config = CodecConfig(quality=quality)
        state = decode(None, keyframe_packet(before, 0, CAMERAS, config))
        packet = residual_packet(state, after, None, CAMERAS, config)
        sizes.append(len(encode_packet(packet)))
        errors.append(np.abs(decode(state, packet).gaussians.numpy()["means"] - after.numpy()["means"]).max())
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)
    # A thousandth of 0.04 px of 0.03 units.
    assert errors[-1] < 2e-6


@pytest.mark.parametrize("target", [2000, 4000, 8000])
def test_residual_packet__stays_below_its_target_size_and_comes_near_it(target: int) -> None:
    state = decode(None, keyframe_packet(cloud(1500), 0, CAMERAS))
    after = jittered(state.gaussians, np.random.default_rng(1), share=1)
    packet = residual_packet(state, after, None, CAMERAS, CodecConfig(target_size=target))
    # The coarseness has steps of 2^(1/4), up to a fifth of the bytes where few numbers are left.
    assert 0.75 * target < packet.arrays["code"].nbytes <= target
    assert len(decode(state, packet)) == 1500


def test_residual_packet__of_a_static_frame_is_nearly_empty() -> None:
    state = decode(None, keyframe_packet(cloud(5000), 0, CAMERAS))
    packet = residual_packet(state, state.gaussians)
    assert len(encode_packet(packet)) < 200
    np.testing.assert_array_equal(decode(state, packet).grid.values, state.grid.values)


def test_residual_packet__stores_changes_of_a_step_and_colours_of_half_a_step() -> None:
    config = CodecConfig(birth_precision=1)
    state = decode(None, keyframe_packet(cloud(), 0, CAMERAS, config))
    raw = {name: value.astype(np.float64) for name, value in state.gaussians.numpy().items()}
    for i, steps in ((7, 10.0), (8, 1.0), (9, 0.98)):
        raw["means"][i] += steps * state.grid.steps("means")[i]
    for i, steps in ((17, 0.51), (18, 0.49)):
        raw["sh_coeffs"][i, 0] += steps * state.grid.steps("sh_dc")[i]
    found = decode(state, residual_packet(state, Gaussians(**raw), None, CAMERAS, config))
    assert np.flatnonzero((found.grid.values != state.grid.values).any(1)).tolist() == [7, 8, 17]
    assert np.flatnonzero(found.gaussians.numpy()["motion"].any(1)).tolist() == [7, 8]


def test_residual_packet__stores_offsets_of_moving_gaussians_and_changes_nothing_else() -> None:
    plain, before = encoded_clip(4)
    packets, states = encoded_clip(4, CodecConfig(offset=True))
    assert [state.gaussians.offset is None for state in states] == [True, False, False, False]
    assert all(state.gaussians.offset is None for state in before)
    for without, packet in zip(plain, packets, strict=True):
        assert {"offset"} >= packet.arrays.keys() - without.arrays.keys()
        for name, array in without.arrays.items():
            assert np.array_equal(packet.arrays[name], array)
    rng, state = np.random.default_rng(3), states[-1]
    after = replace(jittered(state.gaussians, rng), offset=rng.normal(0, 0.02, (len(state), 3)))
    found = decode(state, residual_packet(state, after, None, CAMERAS, CodecConfig(offset=True))).gaussians.numpy()
    moved = found["motion"].any(1)
    assert 0.2 < moved.mean() < 0.6
    # The step of a moved mean is four times that of its birth.
    error = np.abs(found["offset"] - after.numpy()["offset"])[moved] / (4 * state.grid.steps("means")[moved])
    assert 0.45 < error.max() <= 0.5 + 1e-4
    assert not found["offset"][~moved].any()


def test_residual_packet__counts_offsets_towards_the_target_size() -> None:
    state = decode(None, keyframe_packet(cloud(1500), 0, CAMERAS))
    rng = np.random.default_rng(1)
    after = replace(jittered(state.gaussians, rng, share=1), offset=rng.normal(0, 0.02, (1500, 3)))
    arrays = residual_packet(state, after, None, CAMERAS, CodecConfig(target_size=8000, offset=True)).arrays
    assert arrays["offset"].nbytes > 400
    assert 0.75 * 8000 < arrays["code"].nbytes + arrays["offset"].nbytes <= 8000


def test_residual_packet__of_a_decoded_state_reproduces_it() -> None:
    """Encoding a stream again, with the same steps, loses nothing more."""
    _, states = encoded_clip(5)
    for before, after in pairwise(states):
        source = np.searchsorted(before.ids, after.ids)
        survivors = np.flatnonzero(after.ids < before.next_id)  # births would choose new steps
        found = decode(before, residual_packet(before, after.gaussians.select(survivors), source[survivors], CAMERAS))
        assert np.array_equal(found.grid.values, after.grid.values[survivors])


def test_decode__ids_follow_a_gaussian_from_birth_to_death() -> None:
    first = cloud(6)
    state = decode(None, keyframe_packet(first, 0, CAMERAS))
    marked = Gaussians.concatenate([state.gaussians.select(np.array([0, 2, 5])), single_at(7.0)])
    state = decode(state, residual_packet(state, marked, np.array([0, 2, 5, -1]), CAMERAS))
    assert state.ids.tolist() == [0, 2, 5, 6]
    again = Gaussians.concatenate([state.gaussians.select(np.array([1, 2])), single_at(8.0), single_at(9.0)])
    state = decode(state, residual_packet(state, again, np.array([1, 2, -1, -1]), CAMERAS))
    assert (state.ids.tolist(), state.next_id) == ([2, 5, 7, 8], 9)
    assert_close(state.gaussians.numpy()["means"][2:, 0], [8, 9], atol=0.01)
    assert not state.gaussians.numpy()["motion"][2:].any(), "a birth has no motion"
    assert decode(None, reemitted_keyframe(state)).ids.tolist() == [2, 5, 7, 8]


def single_at(x: float) -> Gaussians:
    single = decode(None, keyframe_packet(cloud(1), 0)).gaussians
    return replace(single, means=[[x, 0, 0]])


@pytest.mark.parametrize(("degree", "confidence"), [(0, False), (0, True), (2, False), (3, True)])
def test_decode__round_trips_every_degree_with_and_without_confidence(degree: int, confidence: bool) -> None:
    state = decode(None, keyframe_packet(cloud(20, degree, confidence), 3, CAMERAS))
    now = jittered(state.gaussians, np.random.default_rng(0))
    found = decode(state, residual_packet(state, now, None, CAMERAS))
    assert found.frame == 4
    assert found.gaussians.sh_degree == degree
    assert (found.gaussians.logit_confidence is not None) == confidence
    assert_close(found.gaussians.numpy()["sh_coeffs"], now.numpy()["sh_coeffs"], atol=0.02)


def test_residual_packet__removes_all_gaussians() -> None:
    state = decode(None, keyframe_packet(cloud(5), 0, CAMERAS))
    now = decode(state, residual_packet(state, single_at(7.0), np.array([-1]), CAMERAS))
    assert (now.ids.tolist(), now.next_id) == ([5], 6)


def test_grid__stores_the_attribute_of_a_new_row_of_the_table() -> None:
    """One more row with an `error` and a field of that name; streams without the attribute stay the same."""
    command = [sys.executable, "-m", "tests.codec.new_row"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == history(encoded_clip(4)[1])


def test_residual_packet__follows_a_turn_of_any_angle() -> None:
    """The component that is not stored was the largest at birth; later it may vanish."""
    angles = np.linspace(0, 2 * np.pi, 40)
    one_axis = cloud(1)
    state = decode(None, keyframe_packet(replace(one_axis, quats=[[1, 0, 0, 0]]), 0, CAMERAS))
    for angle in angles:
        q = np.array([np.cos(angle / 2), 0.6 * np.sin(angle / 2), 0, 0.8 * np.sin(angle / 2)])
        packet = residual_packet(state, replace(state.gaussians, quats=q[None]), None, CAMERAS)
        state = decode(state, packet)
        assert abs(state.gaussians.numpy()["quats"][0] @ q) > np.cos(np.deg2rad(2))


def test_keyframe_packet__codes_extremes_as_exactly_as_float32() -> None:
    """Close to a lens steps are tiny, and large, distant or bright Gaussians would need unbounded integers."""
    raw = cloud(40).numpy()
    raw["means"][:8] = CAMERAS[0].position + 1.001 * CAMERAS[0].near * CAMERAS[0].viewmat[2, :3]
    raw["log_scales"][:4] = 12, -30, 0
    raw["means"][8:12] = -1e9
    raw["sh_coeffs"][12:16] = -1e8
    extreme = Gaussians(**raw)
    first = decode(None, keyframe_packet(extreme, 0, CAMERAS))
    for name in ("means", "log_scales", "sh_coeffs"):
        before, now = (np.asarray(getattr(g, name)).astype(np.float64) for g in (extreme, first.gaussians))
        largest = np.abs(before).reshape(40, -1).max(1).reshape(40, *[1] * (before.ndim - 1))
        usual = 2 * np.abs(now[16:] - before[16:]).max()  # of the other Gaussians; twice, because steps come in octaves
        assert np.all(np.abs(now - before) <= np.maximum(2.0**-23 * largest, usual)), name

    # A Gaussian that is born close and small and flies off stops at the limit of its integers.
    gone = replace(first.gaussians, means=first.gaussians.means + np.float32(1e30))
    for config in (CodecConfig(), CodecConfig(birth_precision=1), CodecConfig(target_size=1)):
        second = decode(first, residual_packet(first, gone, cameras=CAMERAS, config=config))
        assert np.asarray(second.gaussians.means).min() > 100
        assert np.array_equal(decode(None, reemitted_keyframe(second)).digest, second.digest)


def test_seek__equals_playing_with_and_without_an_index(tmp_path: Path) -> None:
    packets, states = encoded_clip(14)
    path = tmp_path / "s"
    write(path, packets, states)
    whole = path.read_bytes()
    for data in (whole, whole[: -(20 + 16 + 16 * (14 + 3))]):
        path.write_bytes(data)
        reader = StreamReader(path)
        assert len(reader.index()) == 14 + 3
        for state in states:
            assert_same(seek(reader, state.frame), state)
        assert len(list(reader.near(9))) == 14 + 3 - 10  # starting at the keyframe of frame 8
    with pytest.raises(ValueError, match="expected a frame of the stream, got 14"):
        seek(StreamReader(path), 14)


def pipe() -> tuple[BinaryIO, BinaryIO]:
    """Return the ends for reading and for writing."""
    read, write_end = os.pipe()
    return open(read, "rb"), open(write_end, "wb", buffering=0)


def tcp() -> tuple[BinaryIO, BinaryIO]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        sender = socket.create_connection(server.getsockname())
        receiver, _ = server.accept()
    with sender, receiver:  # the files keep them open
        return receiver.makefile("rb"), sender.makefile("wb", buffering=0)


@pytest.mark.parametrize("channel", [pipe, tcp])
def test_stream_reader__receives_frames_while_they_are_written(channel) -> None:
    packets, states = encoded_clip(5)
    source, sink = channel()
    got: list[CodedFrame] = []
    arrived = threading.Semaphore(0)

    def receive() -> None:
        with source:
            for state in coded_frames(StreamReader(source)):
                got.append(state)
                arrived.release()

    receiver = threading.Thread(target=receive)
    receiver.start()
    with sink:
        with StreamWriter(sink, CAMERAS, 25) as writer:
            for packet in packets:
                writer.write(packet)
                assert arrived.acquire(timeout=20), "a frame arrives as soon as it was written"
        assert not sink.closed
    receiver.join(20)
    for found, state in zip(got, states, strict=True):
        assert_same(found, state)


def test_stream_reader__reports_a_lost_connection_after_complete_frames() -> None:
    packets, states = encoded_clip(3)
    source, sink = tcp()
    with sink:
        writer = StreamWriter(sink, CAMERAS, 25)
        writer.write(packets[0])
        sink.write(encode_packet(packets[1])[:-1])
    got = []
    with (
        source,
        pytest.raises(TruncatedStreamError, match=r"packet 2 at byte .*: truncated or still written; 2 packets"),
    ):
        got.extend(coded_frames(StreamReader(source)))
    assert_same(got[0], states[0])
    assert len(got) == 1


def test_stream_reader__refuses_to_seek_in_a_pipe() -> None:
    data = io.BytesIO()
    with StreamWriter(data, CAMERAS, 25):
        pass
    data.seek(0)
    reader = StreamReader(data)
    with pytest.raises(ValueError, match="expected a file to seek in, got a pipe"):
        next(reader.near(1))
    with pytest.raises(ValueError, match="expected a file that is read twice, got a pipe"):
        reader.check()


@pytest.mark.parametrize("frames", [60, pytest.param(300, marks=pytest.mark.slow)])
def test_coded_frames__equal_the_encoders_states_on_one_thread_and_on_many(tmp_path: Path, frames: int) -> None:
    packets, states = encoded_clip(frames, degree=0)
    write(tmp_path / "s", packets, states, every=50)
    program = f"""
import drjit as dr
import mitsuba as mi; mi.set_variant("llvm_ad_rgb")
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from tests.scenes.coded_clip import history
dr.set_thread_count(1)
print(history(coded_frames(StreamReader({str(tmp_path / "s")!r}))))
"""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | single)
    expected = history(states)
    assert result.stdout.strip() == expected
    assert history(coded_frames(StreamReader(tmp_path / "s"))) == expected
    assert_same(seek(StreamReader(tmp_path / "s"), frames - 1), states[-1])


def test_decode__names_a_missing_packet() -> None:
    packets, states = encoded_clip(4)
    with pytest.raises(ValueError, match="packet of frame 3: it does not continue the state after frame 1"):
        decode(states[1], packets[3])
    with pytest.raises(ValueError, match="packet of frame 1: a residual needs the frame before it"):
        decode(None, packets[1])


def with_head(packet: Packet, *head: int) -> Packet:
    return with_array(packet, "head", np.array(head, np.uint32))


def with_array(packet: Packet, name: str, array: np.ndarray) -> Packet:
    return Packet(packet.kind, packet.frame, {**packet.arrays, name: array})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda key, _: with_head(key, 2**32 - 1, 1, 1, 60), r"take at least \d+ words of code, got"),
        (lambda key, _: with_head(key, 60, 4, 1, 60), "its degree must be at most 3, got 4"),
        (lambda key, _: with_head(key, 60, 1, 5, 60), "must have no bits beyond 0b1, got 0b101 with the unknown 0b100"),
        (lambda key, _: with_head(key, 60, 1, 1, 5), "its ids do not ascend"),
        (lambda key, _: with_head(key, 60, 1, 1, 2**30), "its next id must be at most 1073741823, got 1073741824"),
        (lambda key, _: with_head(key, 60), "its head must have 4 numbers"),
        (lambda _, residual: with_head(residual, 2**29, 8), r"take at least \d+ words of code, got"),
        (lambda _, residual: with_head(residual, 2**31, 8), "its next id must be at most 1073741823"),
        (lambda _, residual: with_head(residual, 0, 81), "its coarseness must be at most 80, got 81"),
        (lambda key, _: Packet(key.kind, 0, {"head": key.arrays["head"]}), "expected the arrays"),
        (lambda key, _: with_array(key, "offset", key.arrays["code"]), "expected the arrays"),
        (lambda key, _: with_array(key, "head", np.full(4, np.inf, np.float32)), r"`head` must be uint32 \[n\], got f"),
        (lambda key, _: with_array(key, "code", np.zeros(99, np.float32)), r"`code` must be uint32 \[n\], got float32"),
        (lambda key, _: with_array(key, "code", key.arrays["code"][None]), r"`code` must be uint32 \[n\], got uint32"),
        (lambda _, residual: with_array(residual, "parent", np.zeros(8, np.uint32)), r"`parent` must be uint8 \[n\]"),
        (lambda _, residual: with_array(residual, "offset", np.zeros(8, np.uint8)), r"`offset` must be uint32 \[n\]"),
        (lambda _, residual: with_array(residual, "offset", np.full(60, 2**32 - 1, "u4")), "its code is broken"),
        (lambda _, residual: replace(residual, frame=0), "its frame must be above 0, that of the state before, got 0"),
    ],
)
def test_decode__refuses_packets_that_contradict_themselves(change, message: str) -> None:
    packets, states = encoded_clip(2)
    packet = change(*packets)
    with pytest.raises(ValueError, match=message):
        decode(states[0] if packet.kind == PacketKind.RESIDUAL else None, packet)


def test_coded_frames__name_file_packet_and_byte(tmp_path: Path) -> None:
    packets, states = encoded_clip(4)
    write(tmp_path / "s", [packets[0], packets[2], packets[3]], [states[0], states[2], states[3]])
    at = StreamReader(tmp_path / "s").index()[1][2]
    with pytest.raises(ValueError, match=f"s: packet 2 at byte {at}: it does not continue the state after frame 0; "):
        list(coded_frames(StreamReader(tmp_path / "s")))


def test_coded_frames__refuse_frames_that_do_not_ascend(tmp_path: Path) -> None:
    packets, states = encoded_clip(4)
    write(tmp_path / "s", [*packets, packets[0]], [*states, states[0]])
    with pytest.raises(ValueError, match=r"s: packet 5 at byte \d+: its frame must be above 3, .* got 0"):
        list(coded_frames(StreamReader(tmp_path / "s")))


def test_decode__refuses_scrambled_code_or_the_packet_after_it() -> None:
    packets, states = encoded_clip(3)
    rng = np.random.default_rng(0)
    for _ in range(60):
        code = packets[1].arrays["code"].copy()
        code[rng.integers(len(code))] ^= np.uint32(1 << rng.integers(32))
        damaged = Packet(PacketKind.RESIDUAL, 1, {**packets[1].arrays, "code": code})
        with pytest.raises(ValueError, match="packet of frame"):
            decode(decode(states[0], damaged), packets[2])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: keyframe_packet(replace(cloud(3), means=np.full((3, 3), np.nan)), 0), "`means` must be finite"),
        (lambda s: residual_packet(s, cloud(4)), "`source` must be"),
        (lambda s: residual_packet(s, cloud(3), np.array([0, -1, 1])), "`source` must be"),
        (lambda s: residual_packet(s, cloud(3), np.array([1, 0, -1])), "`source` must be"),
        (lambda s: residual_packet(s, cloud(3), np.array([0, 1, 9])), "`source` must be"),
        (lambda s: residual_packet(s, cloud(3, degree=0)), "must have SH of degree 1"),
        (
            lambda s: residual_packet(s, cloud(3, confidence=False)),
            r"\['logit_confidence'\] .* got .* \[\];",
        ),
        (lambda s: CodecConfig(quality=0), "`quality` must be positive"),
        (lambda s: CodecConfig(target_size=-1), "`target_size` must not be negative"),
    ],
)
def test_packets__refuse_bad_input(call, message: str) -> None:
    state = decode(None, keyframe_packet(cloud(3), 0))
    with pytest.raises(ValueError, match=message):
        call(state)


def test_frames_with_lasting_ids__shifts_the_ids_of_a_new_set_of_gaussians() -> None:
    """A re-emitted keyframe repeats a set; a keyframe of the next frame starts another one with ids from 0."""
    first = keyframe_packet(cloud(3), 0)
    state = decode(None, first)
    packets = [first, reemitted_keyframe(state), residual_packet(state, cloud(3)), keyframe_packet(cloud(2), 2)]
    found = [(coded.frame, ids.tolist()) for ids, coded in frames_with_lasting_ids(packets)]
    assert found == [(0, [0, 1, 2]), (1, [0, 1, 2]), (2, [3, 4])]
