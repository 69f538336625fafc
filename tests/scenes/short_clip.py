"""A short stream of a few Gaussians that are born and die, with the places of its packets, for
damage and forgery.
"""

from __future__ import annotations

import io
import struct
import zlib
from typing import NamedTuple

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import PAYLOAD, StreamWriter
from morgs_mi.codec.packets import (
    CodedFrame,
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.gaussians import Gaussians
from tests.scenes.coded_clip import CAMERAS, cloud, jittered

FRAMES = 8
EVERY = 3
METADATA = {
    "num_frames": FRAMES,
    "config": {"render": {"eps2d": 0.3, "block_width": None}, "motion": {"learn_confidence": True}},
    "reading": {"trim": False, "offset": {"cam00": 1}},
    "downscale": 1,
    "test_view": 0,
    "train_views": [0],
    "capture": "capture",
}


class Piece(NamedTuple):
    """Byte range of the file: the preamble (kind -1) or a packet."""

    kind: int
    frame: int
    start: int
    stop: int


class Clip(NamedTuple):
    data: bytes
    pieces: list[Piece]
    states: dict[int, CodedFrame]


def short_clip():
    """Return a stream in which every frame has a birth and a death, with a keyframe after every
    third frame.
    """
    file = io.BytesIO()
    rng = np.random.default_rng(0)
    config = CodecConfig(quality=0.3)
    with StreamWriter(file, CAMERAS[:1], 25, METADATA) as writer:
        packet = keyframe_packet(cloud(6, 0), 0, CAMERAS, config)
        states = [decode(None, packet)]
        writer.write(packet)
        for frame in range(1, FRAMES):
            old_state = states[-1]
            alive = np.arange(1, len(old_state))
            target = Gaussians.concatenate(
                [jittered(old_state.gaussians, rng).select(alive), cloud(1, 0, seed=frame)]
            )
            packet = residual_packet(old_state, target, np.r_[alive, -1], CAMERAS, config)
            states.append(decode(old_state, packet))
            writer.write(packet)
            if frame % EVERY == 0:
                writer.write(reemitted_keyframe(states[-1]))
    data = file.getvalue()
    return Clip(data, pieces_of(data), {state.frame: state for state in states})


def pieces_of(data):
    """Return the places of the preamble and the packets of a stream."""
    pieces = [Piece(-1, 0, 0, 12)]
    while (at := pieces[-1].stop) < len(data):
        kind, frame, length = struct.unpack_from("<IIQ", data, at)
        pieces.append(Piece(kind, frame, at, at + PAYLOAD + length))
    return pieces


def sealed(payload, kind=2, frame=0):
    """Return a packet with the right length and the right CRC."""
    head = struct.pack("<IIQ", kind, frame, len(payload))
    return head + struct.pack("<I", zlib.crc32(head + payload)) + payload
