"""Splats that move, are born and die, seen by three cameras with z up, and their stream."""

from dataclasses import replace

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import (
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.gaussians import Gaussians
from tests.scenes.cameras import look_at_cameras

NAMES = ("left", "middle", "right")
TARGET = (0, 0, 0.2)


def rig(width=64, height=48):
    """Return three cameras side by side that look along +y."""
    origins = [(x, -4, 1) for x in (-1, 0, 1)]
    return tuple(look_at_cameras(origins, 45, width, height, NAMES, target=TARGET, up=(0, 0, 1)))


def splats(N=40, degree=1, seed=0):
    """Return random splats; the first half has a high confidence."""
    rng = np.random.default_rng(seed)
    return Gaussians.from_activated(
        means=rng.uniform(-0.8, 0.8, (N, 3)),
        scales=rng.uniform(0.05, 0.2, (N, 3)),
        quats=rng.normal(size=(N, 4)),
        opacities=rng.uniform(0.3, 0.95, N),
        sh_coeffs=0.4 * rng.normal(size=(N, (degree + 1) ** 2, 3)),
        logit_confidence=np.where(np.arange(N) < N // 2, 3.0, -3.0),
    )


def write_stream(path, frames=4, start=None, cameras=None, metadata=None, keyframe_interval=0):
    """Write a stream and return its decoded frames; 0: only the first frame has a
    keyframe.

    The first half of the splats moves from frame 1. In frame 2 one dies and two are born.
    """
    cameras = cameras or rig()
    states = []
    with StreamWriter(path, cameras, 10, metadata) as writer:
        packet = keyframe_packet(start or splats(), 0, cameras)
        for t in range(frames):
            writer.write(packet)
            states.append(decode(states[-1] if states else None, packet))
            if t and keyframe_interval and t % keyframe_interval == 0:
                writer.write(reemitted_keyframe(states[-1]))
            gaussians = states[-1].gaussians
            source = np.arange(len(states[-1]))
            moves = np.asarray(gaussians.logit_confidence) > 0
            target = replace(
                gaussians,
                means=gaussians.numpy()["means"] + 0.1 * moves[:, None] * np.float32([1, 0, 0]),
            )
            if t == 1:
                born = splats(2, gaussians.sh_degree, seed=9)
                target = Gaussians.concatenate(
                    [replace(target.select(source[1:]), motion=None, offset=None), born]
                )
                source = np.concatenate([source[1:], [-1, -1]])
            packet = residual_packet(states[-1], target, source, cameras, CodecConfig())
    return states
