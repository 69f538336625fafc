"""Five splats that move along x in equal steps, seen by two cameras, and their stream."""

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, residual_packet
from morgs_mi.core.camera import Camera
from tests.scenes.gaussians import isotropic

WIDTH = 40
HEIGHT = 30
DISTANCE = 4.0
STEP = 0.05
FRAMES = 3
# Both look along +z.
CAMERAS = [
    Camera.look_at((x, 0, -DISTANCE), (x, 0, 0), (0, -1, 0), 50, WIDTH, HEIGHT, f"cam{i}")
    for i, x in enumerate((0, 0.5))
]
# As exact as float32: only the code under test contributes errors.
EXACT = CodecConfig(quality=1e5)
# Pixels per frame of one step along x, in a plane that is parallel to both image planes.
PIXELS = CAMERAS[0].K[0, 0] * STEP / DISTANCE


def moved(frame, logit=0.0):
    """Return five splats in the plane z = 0 after `frame` steps along x, with a confidence unless
    `logit` is None.
    """
    rng = np.random.default_rng(0)
    means = np.float32(rng.uniform(-1, 1, (5, 3)) * (1, 1, 0) + (frame * STEP, 0, 0))
    sh = np.float32(rng.uniform(-1, 1.5, (5, 1, 3)))
    more = {} if logit is None else {"logit_confidence": np.full(5, logit, np.float32)}
    return isotropic(means, 0.2, 0.9, sh, **more)


def write_stream(path, metadata, logit=0.0, shift=0):
    """Write the stream of the splats, shifted by `shift` steps, and return its packets."""
    first = keyframe_packet(moved(shift, logit), 0, CAMERAS, EXACT)
    state = decode(None, first)
    packets = [first]
    for frame in range(1, FRAMES):
        gaussians = moved(frame + shift, logit)
        packets.append(residual_packet(state, gaussians, None, CAMERAS, EXACT))
        state = decode(state, packets[-1])
    with StreamWriter(path, CAMERAS, 25, metadata) as writer:
        for packet in packets:
            writer.write(packet)
    return packets
