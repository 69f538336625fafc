"""Frames in the stream: bit-exact states, stable numbers, errors within their bounds, damage that is named."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterable
from dataclasses import replace
from hashlib import blake2b
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
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
    seek,
)
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from tests.codec import plain_decoder

CAMERAS = [Camera.look_at((x, 0, -4), (0, 0, 0), (0, -1, 0), 50, 160, 120, f"cam{x}") for x in (-1, 1)]


def cloud(N: int = 60, degree: int = 1, confidence: bool = True, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-1, 1, (N, 3)),
        log_scales=rng.normal(-3, 0.5, (N, 3)),
        quats=rng.normal(size=(N, 4)),
        logit_opacities=rng.normal(1, 2, N),
        sh_coeffs=rng.normal(0, 0.5, (N, (degree + 1) ** 2, 3)),
        logit_confidence=rng.normal(0, 2, N) if confidence else None,
    )


def jittered(gaussians: Gaussians, rng: np.random.Generator, share: float = 0.4) -> Gaussians:
    """Move some of the Gaussians, in all attributes."""
    raw = {name: value for name, value in gaussians.numpy().items() if name not in ("motion", "offset")}
    who = rng.random(len(gaussians)) < share
    change = {n: 0.05 * rng.normal(size=v.shape) * who.reshape(-1, *[1] * (v.ndim - 1)) for n, v in raw.items()}
    return Gaussians(**{name: value + change[name] for name, value in raw.items()})


def run(
    frames: int, config: CodecConfig | None = None, seed: int = 0, degree: int = 1
) -> tuple[list[Packet], list[CodedFrame]]:
    """Encode a cloud in which Gaussians move, die and are born in every frame."""
    rng = np.random.default_rng(0)
    packets = [keyframe_packet(cloud(degree=degree), 0, CAMERAS, config)]
    states = [decode(None, packets[0])]
    for frame in range(1, frames):
        state = states[-1]
        alive = np.flatnonzero(rng.random(len(state)) > 0.03)
        births = int(rng.integers(0, 5))
        moved = jittered(state.gaussians, rng).select(alive)
        now = Gaussians.concatenate([moved, cloud(births, degree, seed=frame)]) if births else moved
        if config is not None and config.offset:
            now = replace(now, offset=np.random.default_rng(frame).normal(0, 0.02, (len(now), 3)))
        source = np.concatenate([alive, np.full(births, -1)])
        packets.append(residual_packet(state, now, source, CAMERAS, config))
        states.append(decode(state, packets[-1]))
    return packets, states


def write(path: Path, packets: list[Packet], states: list[CodedFrame], every: int = 4) -> None:
    with StreamWriter(path, CAMERAS, 25) as writer:
        for packet, state in zip(packets, states, strict=True):
            writer.write(packet)
            if state.frame and state.frame % every == 0:
                writer.write(reemitted_keyframe(state))


def assert_same(got: CodedFrame, expected: CodedFrame) -> None:
    assert (got.frame, got.next_id) == (expected.frame, expected.next_id)
    assert np.array_equal(got.digest, expected.digest)
    found = got.gaussians.numpy()
    for name, value in expected.gaussians.numpy().items():
        assert np.array_equal(found[name], value), name


@pytest.mark.parametrize("config", [None, CodecConfig(offset=True)], ids=["", "offset"])
def test_a_decoder_from_the_specification_gets_the_same_bits(tmp_path: Path, config: CodecConfig | None) -> None:
    packets, states = run(6, config)
    write(tmp_path / "s", packets, states, every=3)
    plain = list(plain_decoder.states((tmp_path / "s").read_bytes()))
    assert [frame for frame, _ in plain] == [state.frame for state in states]
    for (_, found), state in zip(plain, states, strict=True):
        assert np.array_equal(found["ids"], state.ids)
        expected = state.gaussians.numpy()
        assert plain_decoder.numbers(found).keys() == expected.keys() - {"motion"}
        for name, value in plain_decoder.numbers(found).items():
            assert np.array_equal(value, expected[name]), name


def test_errors_stay_within_what_is_tolerated() -> None:
    """A new Gaussian is off by half a step of its birth at most, a moved one by a step, its colour by half."""
    config = CodecConfig(birth_precision=2)
    before = cloud(400)
    state = decode(None, keyframe_packet(before, 0, CAMERAS, config))
    after = jittered(before, np.random.default_rng(1))
    moved = decode(state, residual_packet(state, after, None, CAMERAS, config))
    for true, found, error, shade in ((before, state, 0.5, 0.5), (after, moved, 2.0, 1.0)):
        for camera in CAMERAS:
            view = camera.viewmat
            a, b = (g.numpy()["means"].astype(float) @ view[:3, :3].T + view[:3, 3] for g in (true, found.gaussians))
            # Three coordinates add up at most.
            off = camera.K[0, 0] * np.abs(a - b)[:, :2] / a[:, 2:]
            assert off.max() < error * config.error_px * np.sqrt(3)
        sh = np.abs(true.numpy()["sh_coeffs"] - found.gaussians.numpy()["sh_coeffs"])
        assert 0.2821 * sh[:, 0].max() < 1.001 * shade * config.error_color
        assert sh[:, 1:].max() < 1.001 * error * config.error_color
        opacity = np.abs(np.asarray(true.opacities) - np.asarray(found.gaussians.opacities))
        assert opacity.max() < 1.001 * error * config.error_opacity
        q, p = true.numpy()["quats"], found.gaussians.numpy()["quats"]
        cosine = np.abs((q * p).sum(1)) / np.linalg.norm(q, axis=1)
        # The steps are meant for some 5 px: far below a tenth of a pixel at the ends of an axis.
        assert np.rad2deg(2 * np.arccos(np.minimum(cosine, 1))).max() < 8 * error
        assert opacity.max() > 0.7 * error * config.error_opacity, "the bound is near"


def test_more_quality_takes_more_bytes_and_errs_less() -> None:
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
def test_a_frame_keeps_to_its_target_and_comes_near_it(target: int) -> None:
    state = decode(None, keyframe_packet(cloud(1500), 0, CAMERAS))
    after = jittered(state.gaussians, np.random.default_rng(1), share=1)
    packet = residual_packet(state, after, None, CAMERAS, CodecConfig(target_size=target))
    # The coarseness goes in steps of 2^(1/4), up to a fifth of the bytes where few numbers are left.
    assert 0.75 * target < packet.arrays["code"].nbytes <= target
    assert len(decode(state, packet)) == 1500


def test_nothing_moves_nothing_is_written() -> None:
    state = decode(None, keyframe_packet(cloud(5000), 0, CAMERAS))
    packet = residual_packet(state, state.gaussians)
    assert len(encode_packet(packet)) < 200
    np.testing.assert_array_equal(decode(state, packet).grid.values, state.grid.values)


def test_only_what_changes_by_a_step_is_written_and_colours_by_half() -> None:
    config = CodecConfig(birth_precision=1)
    state = decode(None, keyframe_packet(cloud(), 0, CAMERAS, config))
    raw = {name: value.astype(np.float64) for name, value in state.gaussians.numpy().items()}
    for who, steps in ((7, 10.0), (8, 1.0), (9, 0.98)):
        raw["means"][who] += steps * state.grid.steps("position")[who]
    for who, steps in ((17, 0.51), (18, 0.49)):
        raw["sh_coeffs"][who, 0] += steps * state.grid.steps("color")[who]
    found = decode(state, residual_packet(state, Gaussians(**raw), None, CAMERAS, config))
    assert np.flatnonzero((found.grid.values != state.grid.values).any(1)).tolist() == [7, 8, 17]
    assert np.flatnonzero(found.gaussians.numpy()["motion"].any(1)).tolist() == [7, 8]


def test_offsets_are_told_of_those_that_move_and_change_nothing_else() -> None:
    plain, before = run(4)
    packets, states = run(4, CodecConfig(offset=True))
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
    # A moved centre's step is four times that of its birth.
    error = np.abs(found["offset"] - after.numpy()["offset"])[moved] / (4 * state.grid.steps("position")[moved])
    assert 0.45 < error.max() <= 0.5 + 1e-4
    assert not found["offset"][~moved].any()


def test_offsets_count_towards_the_target() -> None:
    state = decode(None, keyframe_packet(cloud(1500), 0, CAMERAS))
    rng = np.random.default_rng(1)
    after = replace(jittered(state.gaussians, rng, share=1), offset=rng.normal(0, 0.02, (1500, 3)))
    arrays = residual_packet(state, after, None, CAMERAS, CodecConfig(target_size=8000, offset=True)).arrays
    assert arrays["offset"].nbytes > 400
    assert 0.75 * 8000 < arrays["code"].nbytes + arrays["offset"].nbytes <= 8000


def test_a_decoded_state_leads_to_itself() -> None:
    """Whoever encodes a stream once more, at the same steps, loses nothing more."""
    _, states = run(5)
    for before, after in pairwise(states):
        source = np.searchsorted(before.ids, after.ids)
        kept = np.flatnonzero(after.ids < before.next_id)  # those born would choose their steps anew
        found = decode(before, residual_packet(before, after.gaussians.select(kept), source[kept], CAMERAS))
        assert np.array_equal(found.grid.values, after.grid.values[kept])


def test_numbers_follow_a_gaussian_from_birth_to_death() -> None:
    first = cloud(6)
    state = decode(None, keyframe_packet(first, 0, CAMERAS))
    marked = Gaussians.concatenate([state.gaussians.select(np.array([0, 2, 5])), one(7.0)])
    state = decode(state, residual_packet(state, marked, np.array([0, 2, 5, -1]), CAMERAS))
    assert state.ids.tolist() == [0, 2, 5, 6]
    again = Gaussians.concatenate([state.gaussians.select(np.array([1, 2])), one(8.0), one(9.0)])
    state = decode(state, residual_packet(state, again, np.array([1, 2, -1, -1]), CAMERAS))
    assert (state.ids.tolist(), state.next_id) == ([2, 5, 7, 8], 9)
    np.testing.assert_allclose(state.gaussians.numpy()["means"][2:, 0], [8, 9], atol=0.01)
    assert not state.gaussians.numpy()["motion"][2:].any(), "who was born comes from nowhere"
    assert decode(None, reemitted_keyframe(state)).ids.tolist() == [2, 5, 7, 8]


def one(x: float) -> Gaussians:
    single = decode(None, keyframe_packet(cloud(1), 0)).gaussians
    return replace(single, means=[[x, 0, 0]])


@pytest.mark.parametrize(("degree", "confidence"), [(0, False), (0, True), (2, False), (3, True)])
def test_every_kind_of_gaussian(degree: int, confidence: bool) -> None:
    state = decode(None, keyframe_packet(cloud(20, degree, confidence), 3, CAMERAS))
    now = jittered(state.gaussians, np.random.default_rng(0))
    found = decode(state, residual_packet(state, now, None, CAMERAS))
    assert found.frame == 4
    assert found.gaussians.sh_degree == degree
    assert (found.gaussians.logit_confidence is not None) == confidence
    np.testing.assert_allclose(found.gaussians.numpy()["sh_coeffs"], now.numpy()["sh_coeffs"], atol=0.02)


def test_a_turn_of_any_angle_is_followed() -> None:
    """The component that is left out was the largest at birth; later it may vanish."""
    angles = np.linspace(0, 2 * np.pi, 40)
    one_axis = cloud(1)
    state = decode(None, keyframe_packet(replace(one_axis, quats=[[1, 0, 0, 0]]), 0, CAMERAS))
    for angle in angles:
        q = np.array([np.cos(angle / 2), 0.6 * np.sin(angle / 2), 0, 0.8 * np.sin(angle / 2)])
        packet = residual_packet(state, replace(state.gaussians, quats=q[None]), None, CAMERAS)
        state = decode(state, packet)
        assert abs(state.gaussians.numpy()["quats"][0] @ q) > np.cos(np.deg2rad(2))


def test_the_extremes_are_coded_as_exactly_as_float32_is() -> None:
    """Right before a lens steps are tiny, and what is large, far away or bright would need integers without end."""
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
        usual = 2 * np.abs(now[16:] - before[16:]).max()  # others are that exact; twice, as steps are by octaves
        assert np.all(np.abs(now - before) <= np.maximum(2.0**-23 * largest, usual)), name

    # Who was born near and small and flies off stops where its integers end.
    gone = replace(first.gaussians, means=first.gaussians.means + np.float32(1e30))
    for config in (CodecConfig(), CodecConfig(birth_precision=1), CodecConfig(target_size=1)):
        second = decode(first, residual_packet(first, gone, cameras=CAMERAS, config=config))
        assert np.asarray(second.gaussians.means).min() > 100
        assert np.array_equal(decode(None, reemitted_keyframe(second)).digest, second.digest)


def test_seeking_equals_playing_on_an_index_or_without(tmp_path: Path) -> None:
    packets, states = run(14)
    path = tmp_path / "s"
    write(path, packets, states)
    whole = path.read_bytes()
    for data in (whole, whole[: -(20 + 16 + 16 * (14 + 3))]):
        path.write_bytes(data)
        reader = StreamReader(path)
        assert len(reader.index()) == 14 + 3
        for state in states:
            assert_same(seek(reader, state.frame), state)
        assert len(list(reader.near(9))) == 14 + 3 - 10  # from the keyframe of frame 8 on
    with pytest.raises(ValueError, match="expected a frame of the stream, got 14"):
        seek(StreamReader(path), 14)


def pipe() -> tuple[BinaryIO, BinaryIO]:
    """Return the ends to read from and to write to."""
    read, write_end = os.pipe()
    return open(read, "rb"), open(write_end, "wb", buffering=0)


def tcp() -> tuple[BinaryIO, BinaryIO]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        sender = socket.create_connection(server.getsockname())
        receiver, _ = server.accept()
    with sender, receiver:  # the files keep them open
        return receiver.makefile("rb"), sender.makefile("wb", buffering=0)


@pytest.mark.parametrize("channel", [pipe, tcp])
def test_a_stream_is_received_frame_by_frame_while_it_is_written(channel) -> None:
    packets, states = run(5)
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
                assert arrived.acquire(timeout=20), "a frame is there as soon as it was written"
        assert not sink.closed
    receiver.join(20)
    for found, state in zip(got, states, strict=True):
        assert_same(found, state)


def test_a_connection_that_is_lost_leaves_whole_frames_and_a_sentence() -> None:
    packets, states = run(3)
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


def test_a_pipe_cannot_be_turned_back() -> None:
    data = io.BytesIO()
    with StreamWriter(data, CAMERAS, 25):
        pass
    data.seek(0)
    reader = StreamReader(data)
    with pytest.raises(ValueError, match="expected a file to seek in, got a pipe"):
        next(reader.near(1))
    with pytest.raises(ValueError, match="expected a file that is read twice, got a pipe"):
        reader.whole()


def history(states: Iterable[CodedFrame]) -> str:
    """Return a digest of all that a decoder ever had."""
    digest = blake2b()
    for state in states:
        for array in (state.digest, state.ids, *state.gaussians.numpy().values()):
            digest.update(np.ascontiguousarray(array))
    return digest.hexdigest()


def test_300_frames_give_the_encoders_states_on_one_thread_and_on_many(tmp_path: Path) -> None:
    packets, states = run(300, degree=0)
    write(tmp_path / "s", packets, states, every=50)
    program = f"""
import drjit as dr
import mitsuba as mi; mi.set_variant("llvm_ad_rgb")
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from tests.codec.test_packets import history
dr.set_thread_count(1)
print(history(coded_frames(StreamReader({str(tmp_path / "s")!r}))))
"""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | single)
    expected = history(states)
    assert result.stdout.strip() == expected
    assert history(coded_frames(StreamReader(tmp_path / "s"))) == expected
    assert_same(seek(StreamReader(tmp_path / "s"), 299), states[-1])


def test_a_missing_packet_is_named() -> None:
    packets, states = run(4)
    with pytest.raises(ValueError, match="packet of frame 3: it does not continue the state after frame 1"):
        decode(states[1], packets[3])
    with pytest.raises(ValueError, match="packet of frame 1: a residual needs the frame before it"):
        decode(None, packets[1])


def with_head(packet: Packet, *head: int) -> Packet:
    return Packet(packet.kind, packet.frame, {**packet.arrays, "head": np.array(head, np.uint32)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda key, _: with_head(key, 2**32 - 1, 1, 1, 60), "does not fit its"),
        (lambda key, _: with_head(key, 60, 4, 1, 60), "does not fit its"),
        (lambda key, _: with_head(key, 60, 1, 1, 5), "its ids do not ascend"),
        (lambda key, _: with_head(key, 60), "its head must have 4 numbers"),
        (lambda _, residual: with_head(residual, 2**31, 8), "does not fit its"),
        (lambda _, residual: with_head(residual, 0, 81), "does not fit its"),
        (lambda key, _: Packet(key.kind, 0, {"head": key.arrays["head"]}), "expected the arrays"),
        (lambda key, _: Packet(key.kind, 0, {**key.arrays, "offset": key.arrays["code"]}), "expected the arrays"),
        (
            lambda _, residual: Packet(residual.kind, 1, {**residual.arrays, "offset": np.full(60, 2**32 - 1, "u4")}),
            "its code is broken",
        ),
    ],
)
def test_packets_that_contradict_themselves_are_refused(change, message: str) -> None:
    packets, states = run(2)
    with pytest.raises(ValueError, match=message):
        decode(states[0], change(*packets))


def test_scrambled_code_is_refused_or_gives_a_state_that_the_next_packet_refuses() -> None:
    packets, states = run(3)
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
        (lambda s: CodecConfig(quality=0), "`quality` must be positive"),
        (lambda s: CodecConfig(target_size=-1), "`target_size` must not be negative"),
    ],
)
def test_bad_input_gets_a_sentence(call, message: str) -> None:
    state = decode(None, keyframe_packet(cloud(3), 0))
    with pytest.raises(ValueError, match=message):
        call(state)
