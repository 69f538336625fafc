"""Gaussians <-> packets: a keyframe holds all raw attributes, a residual what is to be added to the frame before.

The encoder goes on from what the decoder will see, so the two can never drift: after writing a packet, take
`decode_gaussians` of it as the new state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.gaussians.gaussians import Gaussians

__all__ = ["decode_gaussians", "keyframe_packet", "play", "residual_packet"]

# Displacements are no state: they are recovered as the difference of two frames' centres.
_STATE = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs", "logit_confidence")


def keyframe_packet(gaussians: Gaussians, frame: int) -> Packet:
    """Return the packet that states every attribute of `gaussians` at `frame`."""
    return Packet(PacketKind.KEYFRAME, frame, _state(gaussians))


def residual_packet(previous: Gaussians, current: Gaussians, frame: int) -> Packet:
    """Return the packet that leads from `previous` to `current` (eq. 3); attributes that stay are left out.

    Raises:
        ValueError: the two have different numbers of Gaussians or different attributes.
    """
    before, after = _state(previous), _state(current)
    if before.keys() != after.keys() or len(previous) != len(current):
        raise ValueError(
            f"residual_packet(): both frames must hold the same Gaussians, got {len(previous)} with "
            f"{sorted(before)} and {len(current)} with {sorted(after)}; write a keyframe instead."
        )
    changes = {name: after[name] - before[name] for name in after}
    return Packet(PacketKind.RESIDUAL, frame, {name: change for name, change in changes.items() if change.any()})


def decode_gaussians(previous: Gaussians | None, packet: Packet) -> Gaussians:
    """Return the Gaussians of the packet's frame; `motion` [N, 3] is their displacement since the last one.

    Raises:
        ValueError: a residual without a frame before it, or arrays that do not fit that frame.
    """
    where = f"packet of frame {packet.frame}"
    if packet.kind == PacketKind.KEYFRAME:
        missing = [name for name in _STATE[:5] if name not in packet.arrays]
        if missing:
            raise ValueError(f"{where}: a keyframe must hold {', '.join(_STATE[:5])}, got none of {missing}.")
        state = {name: packet.arrays[name] for name in _STATE if name in packet.arrays}
        return Gaussians(**state, motion=np.zeros_like(state["means"]))
    if previous is None:
        raise ValueError(f"{where}: a residual needs the frame before it, got none; start from a keyframe.")
    state = _state(previous)
    for name, change in packet.arrays.items():
        if name not in state or state[name].shape != change.shape:
            found = state[name].shape if name in state else "no such attribute"
            raise ValueError(f"{where}: `{name}` {change.shape} must fit the frame before, which has {found}.")
        state[name] = state[name] + change
    return Gaussians(**state, motion=state["means"] - previous.numpy()["means"])


def play(packets: Iterable[Packet]) -> Iterator[tuple[int, Gaussians]]:
    """Decode packets in order and yield (frame, Gaussians)."""
    gaussians = None
    for packet in packets:
        gaussians = decode_gaussians(gaussians, packet)
        yield packet.frame, gaussians


def _state(gaussians: Gaussians) -> dict[str, np.ndarray]:
    columns = gaussians.numpy()
    return {name: np.ascontiguousarray(columns[name], np.float32) for name in _STATE if name in columns}
