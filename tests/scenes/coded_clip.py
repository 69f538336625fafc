"""Random clouds with attributes that cover the range of the codec, and encoded clips of them."""

from hashlib import blake2b

import numpy as np

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import (
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
)
from morgs_mi.core.gaussians import Gaussians
from tests.scenes.cameras import look_at_cameras

CAMERAS = look_at_cameras([(x, 0, -4) for x in (-1, 1)], 50, 160, 120)


def cloud(N=60, degree=1, confidence=True, seed=0):
    """Return random Gaussians in front of `CAMERAS`."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-1, 1, (N, 3)),
        log_scales=rng.normal(-3, 0.5, (N, 3)),
        quats=rng.normal(size=(N, 4)),
        logit_opacities=rng.normal(1, 2, N),
        sh_coeffs=rng.normal(0, 0.5, (N, (degree + 1) ** 2, 3)),
        logit_confidence=rng.normal(0, 2, N) if confidence else None,
    )


def jittered(gaussians, rng, share=0.4):
    """Return the Gaussians with a share of them changed in all attributes."""
    raw = {
        name: value for name, value in gaussians.numpy().items() if name not in ("motion", "offset")
    }
    active = rng.random(len(gaussians)) < share
    change = {
        n: 0.05 * rng.normal(size=v.shape) * active.reshape(-1, *[1] * (v.ndim - 1))
        for n, v in raw.items()
    }
    return Gaussians(**{name: value + change[name] for name, value in raw.items()})


def encoded_clip(frames, config=None, degree=1):
    """Return the packets and states of a cloud in which Gaussians move, die and are born in every
    frame.
    """
    rng = np.random.default_rng(0)
    packets = [keyframe_packet(cloud(degree=degree), 0, CAMERAS, config)]
    states = [decode(None, packets[0])]
    for frame in range(1, frames):
        state = states[-1]
        alive = np.flatnonzero(rng.random(len(state)) > 0.03)
        births = int(rng.integers(0, 5))
        survivors = jittered(state.gaussians, rng).select(alive)
        target = (
            Gaussians.concatenate([survivors, cloud(births, degree, seed=frame)])
            if births
            else survivors
        )
        source = np.concatenate([alive, np.full(births, -1)])
        packets.append(residual_packet(state, target, source, CAMERAS, config))
        states.append(decode(state, packets[-1]))
    return packets, states


def write(path, packets, states, every=4):
    """Write a stream with a re-emitted keyframe after every `every`-th frame."""
    with StreamWriter(path, CAMERAS, 25) as writer:
        for packet, state in zip(packets, states, strict=True):
            writer.write(packet)
            if state.frame and state.frame % every == 0:
                writer.write(reemitted_keyframe(state))


def history(states):
    """Return a digest of all states of a decoder."""
    digest = blake2b()
    for state in states:
        for array in (state.digest, state.ids, *state.gaussians.numpy().values()):
            digest.update(np.ascontiguousarray(array))
    return digest.hexdigest()


def assert_same(got, expected):
    """Assert that two states agree to the bit."""
    assert (got.frame, got.next_id) == (expected.frame, expected.next_id)
    assert np.array_equal(got.digest, expected.digest)
    values = got.gaussians.numpy()
    for name, value in expected.gaussians.numpy().items():
        assert np.array_equal(values[name], value), name
