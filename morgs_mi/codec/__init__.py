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
from morgs_mi.codec.salvage import Gap, salvage, write_salvaged

__all__ = [
    "Gap",
    "Packet",
    "PacketKind",
    "StreamReader",
    "StreamWriter",
    "TruncatedStreamError",
    "decode_packet",
    "encode_packet",
    "salvage",
    "write_salvaged",
]
