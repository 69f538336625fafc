"""A reference decoder written from docs/stream-format.md alone: slow, simple, and without the
package's code.
"""

import hashlib
import itertools
import json
import math
import struct
import zlib

import numpy as np

F = (1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429)
U64 = 2**64


class RangeCode:
    def __init__(self, words):
        self.words = [int(w) for w in words]
        self.low = 0
        self.range = U64 - 1
        self.at = 2
        self.point = self.word(0) << 32 | self.word(1)

    def word(self, i):
        return self.words[i] if i < len(self.words) else 0

    def symbol(self, lefts):
        """Decode one symbol; `lefts` are the left ends of the intervals and 2^24."""
        scale = self.range >> 24
        t = ((self.point - self.low) % U64) // scale
        assert t < 2**24, "the code is broken"
        i = int(np.searchsorted(lefts, t, side="right")) - 1
        self.low = (self.low + scale * int(lefts[i])) % U64
        self.range = scale * int(lefts[i + 1] - lefts[i])
        if self.range < 2**32:
            self.low = (self.low << 32) % U64
            self.range = self.range << 32
            self.point = (self.point << 32) % U64 | self.word(self.at)
            self.at += 1
        return i

    def bits(self, b):
        return self.symbol(np.arange(2**b + 1, dtype=np.int64) << (24 - b))

    def column(self, n):
        weights = [max(1, 256 // (i + 1) ** 2) for i in range(85)]
        tokens = []
        end = 16
        while len(tokens) < n:
            sums = np.concatenate([[0], np.cumsum(weights)[:-1]]).astype(np.float64)
            s = (2**24 - 85) / float(sum(weights))
            lefts = np.append(np.floor(s * sums).astype(np.int64) + np.arange(85), 2**24)
            block = [self.symbol(lefts) for _ in range(min(end, n) - len(tokens))]
            for token in block:
                weights[token] += 32
            tokens = tokens + block
            end = 2 * end
        ks = [(token + 1) // 2 - 12 if token > 30 else 0 for token in tokens]
        rest = [self.bits(min(k, 16)) if k else 0 for k in ks]
        rest = [
            low | self.bits(k - 16) << 16 if k > 16 else low
            for low, k in zip(rest, ks, strict=True)
        ]
        sizes = [2**k + r if k else (t + 1) // 2 for t, k, r in zip(tokens, ks, rest, strict=True)]
        return np.array(
            [v if t % 2 else -v for t, v in zip(tokens, sizes, strict=True)], dtype=np.int64
        )


def packets(data):
    assert data[:12] == b"MORGS-MI" + struct.pack("<I", 2)
    at = 12
    while at < len(data):
        kind, frame, length, crc = struct.unpack_from("<IIQI", data, at)
        payload = data[at + 20 : at + 20 + length]
        assert zlib.crc32(data[at : at + 16] + payload) == crc
        yield kind, frame, payload
        at += 20 + length


def arrays(payload):
    (size,) = struct.unpack_from("<I", payload)
    at = 4 + size
    values = {}
    for name, dtype, shape in json.loads(payload[4:at]):
        count = math.prod(shape)
        values[name] = np.frombuffer(payload, np.dtype(dtype).newbyteorder("<"), count, at).reshape(
            shape
        )
        at += values[name].nbytes
    assert at == len(payload)
    return values


def born(code, N, degree, confidence):
    C = 10 + 3 * (degree + 1) ** 2 + confidence
    middle = code.column(9 + confidence + C)
    columns = np.stack([code.column(N) + shift for shift in middle], axis=1)
    return columns[:, 0], columns[:, 1 : 9 + confidence], columns[:, 9 + confidence :]


def groups(state):
    ends = [0, 3, 6, 9, 10, 13, 10 + 3 * (state["degree"] + 1) ** 2]
    ends.append(ends[-1] + state["confidence"])
    return [range(a, b) for a, b in itertools.pairwise(ends)]


def keyframe(payload):
    values = arrays(payload)
    N, degree, confidence, next_id = (int(x) for x in values["head"])
    assert confidence <= 1, "unknown optional attributes"
    code = RangeCode(values["code"])
    ids = np.cumsum(code.column(N) + 1) - 1
    state = {"ids": ids, "degree": degree, "confidence": confidence, "next_id": next_id}
    state["largest_components"], state["exponents"], state["values"] = born(
        code, N, degree, confidence
    )
    return state


def digest(state):
    arrays = [
        state["ids"].astype("<u4"),
        state["largest_components"].astype("u1"),
        state["exponents"].astype("i1"),
    ]
    arrays += [state["values"].astype("<i4"), np.array([state["next_id"], state["degree"]], "<u4")]
    return hashlib.blake2b(b"".join(array.tobytes() for array in arrays), digest_size=8).digest()


def residual(state, payload):
    changes = arrays(payload)
    assert changes["parent"].tobytes() == digest(state)
    births, quantizer_step = (int(x) for x in changes["head"])
    code = RangeCode(changes["code"])
    values = state["values"].copy()
    dead = np.zeros(len(state["ids"]), bool)
    moving = values[:, -1] > 0 if state["confidence"] else np.zeros(len(values), bool)
    for members in (np.flatnonzero(~moving), np.flatnonzero(moving)):
        geometry = code.column(len(members))
        appearance = np.zeros(len(members), np.int64)
        appearance[geometry == 0] = code.column(int((geometry == 0).sum()))
        other = (geometry > 0) & (geometry < 8)
        appearance[other] = code.column(int(other.sum()))
        dead[members] = geometry == 8
        for g, columns in enumerate(groups(state)):
            flags = (geometry % 8) >> g & 1 if g < 3 else appearance >> (g - 3) & 1
            changed = members[flags == 1]
            for column in columns:
                r = code.column(len(changed))
                values[changed, column] += np.rint(
                    r * F[quantizer_step % 4] * 2.0 ** (quantizer_step // 4)
                ).astype(np.int64)
    new = {
        **state,
        **{name: state[name][~dead] for name in ("ids", "largest_components", "exponents")},
        "values": values[~dead],
    }
    if births:
        added = born(code, births, state["degree"], state["confidence"])
        for name, array in zip(("largest_components", "exponents", "values"), added, strict=True):
            new[name] = np.concatenate([new[name], array])
        new["ids"] = np.concatenate([new["ids"], state["next_id"] + np.arange(births)])
        new["next_id"] = state["next_id"] + births
    return new


def numbers(state):
    """Return the attributes of a state, by the names of the package."""
    e = state["exponents"].astype(int)
    steps = np.array(F)[e % 4] * 2.0 ** (e // 4)
    # Number of columns that have each of the exponents.
    widths = [3, 1, 1, 1, 3, 1, 3, 3 * ((state["degree"] + 1) ** 2 - 1), state["confidence"]]
    real = state["values"] * np.repeat(steps, widths[: e.shape[1]], axis=1)
    u, v, w = real[:, 6:9].T
    lengths = np.sqrt(((1 + u * u) + v * v) + w * w)
    quats = np.array(
        [
            np.insert(others / length, largest, 1 / length)
            for others, length, largest in zip(
                real[:, 6:9], lengths, state["largest_components"], strict=True
            )
        ]
    )
    end = 10 + 3 * (state["degree"] + 1) ** 2
    values = {
        "means": real[:, :3],
        "log_scales": real[:, 3:6],
        "quats": quats,
        "logit_opacities": real[:, 9],
    }
    values["sh_coeffs"] = real[:, 10:end].reshape(len(real), -1, 3)
    if state["confidence"]:
        values["logit_confidence"] = real[:, end]
    return {name: value.astype(np.float32) for name, value in values.items()}


def states(data):
    """Yield (frame, state) of a whole stream, once for each frame."""
    state = None
    last = None
    for kind, frame, payload in packets(data):
        if kind in (1, 2) and frame != last:
            state = keyframe(payload) if kind == 1 else residual(state, payload)
            last = frame
            yield frame, state
