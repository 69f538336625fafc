"""Residuals to bytes and back."""

from morgs_mi.codec.container import (
    Packet,
    PacketKind,
    StreamWriter,
    TruncatedStreamError,
    decode_packet,
    encode_packet,
)
from morgs_mi.codec.reader import StreamReader

__all__ = [
    "Packet",
    "PacketKind",
    "StreamReader",
    "StreamWriter",
    "TruncatedStreamError",
    "decode_packet",
    "encode_packet",
]
