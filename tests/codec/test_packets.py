"""Frames in the stream: bit-exact states, stable ids, and packets that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.packets import (
    coded_frames,
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.testing import assert_close
from tests.codec import plain_decoder
from tests.scenes.coded_clip import CAMERAS, cloud, encoded_clip, jittered, write


def test_decode__equals_a_decoder_from_the_specification(tmp_path):
    packets, states = encoded_clip(6)
    write(tmp_path / "s", packets, states, every=3)
    plain = list(plain_decoder.states((tmp_path / "s").read_bytes()))
    assert [frame for frame, _ in plain] == [state.frame for state in states]
    for (_, values), state in zip(plain, states, strict=True):
        assert np.array_equal(values["ids"], state.ids)
        expected = state.gaussians.numpy()
        assert plain_decoder.numbers(values).keys() == expected.keys() - {"motion"}
        for name, value in plain_decoder.numbers(values).items():
            assert np.array_equal(value, expected[name]), name


def test_residual_packet__of_a_static_frame_is_nearly_empty():
    state = decode(None, keyframe_packet(cloud(5000), 0, CAMERAS))
    packet = residual_packet(state, state.gaussians)
    assert len(packet.encoded) < 200
    assert_array_equal(decode(state, packet).grid.values, state.grid.values)


def test_decode__ids_follow_a_gaussian_from_birth_to_death():
    first = cloud(6)
    state = decode(None, keyframe_packet(first, 0, CAMERAS))
    first_means = state.gaussians.numpy()["means"]
    survivors = state.gaussians.select(np.array([0, 2, 5]))
    moved = replace(survivors, means=survivors.numpy()["means"] + 0.1)
    marked = Gaussians.concatenate([moved, single_at(7.0)])
    state = decode(state, residual_packet(state, marked, np.array([0, 2, 5, -1]), CAMERAS))
    assert state.ids.tolist() == [0, 2, 5, 6]
    moves = state.gaussians.numpy()["means"][:3] - first_means[[0, 2, 5]]
    assert_array_equal(state.gaussians.numpy()["motion"][:3], moves)
    again = Gaussians.concatenate(
        [state.gaussians.select(np.array([1, 2])), single_at(8.0), single_at(9.0)]
    )
    state = decode(state, residual_packet(state, again, np.array([1, 2, -1, -1]), CAMERAS))
    assert (state.ids.tolist(), state.next_id) == ([2, 5, 7, 8], 9)
    assert_close(state.gaussians.numpy()["means"][2:, 0], [8, 9], atol=0.01)
    assert not state.gaussians.numpy()["motion"][2:].any(), "a birth has no motion"
    assert decode(None, reemitted_keyframe(state)).ids.tolist() == [2, 5, 7, 8]


def single_at(x):
    single = decode(None, keyframe_packet(cloud(1), 0)).gaussians
    return replace(single, means=[[x, 0, 0]])


@pytest.mark.parametrize(("degree", "confidence"), [(0, False), (3, True)])
def test_decode__round_trips_every_degree_with_and_without_confidence(degree, confidence):
    state = decode(None, keyframe_packet(cloud(20, degree, confidence), 3, CAMERAS))
    target = jittered(state.gaussians, np.random.default_rng(0))
    result = decode(state, residual_packet(state, target, None, CAMERAS))
    assert result.frame == 4
    assert result.gaussians.sh_degree == degree
    assert (result.gaussians.logit_confidence is not None) == confidence
    assert_close(result.gaussians.numpy()["sh_coeffs"], target.numpy()["sh_coeffs"], atol=0.02)


def with_head(packet, *head):
    return with_array(packet, "head", np.array(head, np.uint32))


def with_array(packet, name, array):
    return Packet(packet.kind, packet.frame, {**packet.arrays, name: array})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda key, _: with_head(key, 2**32 - 1, 1, 1, 60),
            r"take at least \d+ words of code, got",
        ),
        (
            lambda key, _: with_head(key, 60, 1, 5, 60),
            r"'optional': 1, .* got \[60, 1, 5, 60\]; read it with the release that wrote it",
        ),
        (lambda key, _: with_head(key, 60, 1, 1, 59), "its ids do not ascend"),
        (
            lambda _, residual: with_head(residual, 2**31, 8),
            r"'births': \d+, .* got \[2147483648, 8\]",
        ),
        (
            lambda _, residual: with_head(residual, 0, 81),
            r"'quantizer_step': 80}, got \[0, 81\]",
        ),
        (
            lambda key, _: with_array(key, "code", key.arrays["code"][None]),
            r"expected the arrays .* 'code': 'uint32 \[1, \d+\]'",
        ),
        (
            lambda _, residual: replace(residual, frame=0),
            "its frame must be above 0, got 0",
        ),
    ],
)
def test_decode__refuses_packets_that_contradict_themselves(change, message):
    packets, states = encoded_clip(2)
    packet = change(*packets)
    with pytest.raises(ValueError, match=message):
        decode(states[0] if packet.kind == PacketKind.RESIDUAL else None, packet)


def test_lasting_ids__continue_after_those_of_the_set_before():
    """A re-emitted keyframe repeats a set; a keyframe of the next frame starts another one with ids
    from 0.
    """
    first = keyframe_packet(cloud(3), 0)
    state = decode(None, first)
    packets = [
        first,
        reemitted_keyframe(state),
        residual_packet(state, cloud(3)),
        keyframe_packet(cloud(2), 2),
    ]
    ids = [(coded.frame, coded.lasting_ids.tolist()) for coded in coded_frames(packets)]
    assert ids == [(0, [0, 1, 2]), (1, [0, 1, 2]), (2, [3, 4])]


def test_keyframe_packet__refuses_numbers_that_are_not_finite():
    with pytest.raises(ValueError, match="`means` must be finite"):
        keyframe_packet(replace(cloud(3), means=np.full((3, 3), np.nan)), 0)
