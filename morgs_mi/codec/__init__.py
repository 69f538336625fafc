"""Residuals to bytes and back."""

from morgs_mi.codec.container import (
    Packet,
    PacketKind,
    StreamReader,
    StreamWriter,
    TruncatedStreamError,
    decode_packet,
    encode_packet,
)

__all__ = [
    "Packet",
    "PacketKind",
    "StreamReader",
    "StreamWriter",
    "TruncatedStreamError",
    "decode_packet",
    "encode_packet",
]
