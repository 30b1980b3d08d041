"""PX4 logs: topics with a stamp and arrays of floats, as the format's description has them."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

Topics = Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]]


def ulog(path: Path, topics: Topics) -> Path:
    """Write topics: times [us] (N,), and fields (N,) or (N, k)."""

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    head = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    parts: list[bytes] = []  # the data section: all definitions come before it
    rows: list[tuple[int, bytes]] = []
    for number, (name, (t, fields)) in enumerate(topics.items()):
        wide = {key: np.reshape(a, (len(t), -1)) for key, a in fields.items()}
        counts = {k: f"[{a.shape[1]}]" * (fields[k].ndim > 1) for k, a in wide.items()}
        kinds = ";".join(f"float{count} {key}" for key, count in counts.items())
        head += [message("F", f"{name}:uint64_t timestamp;{kinds};".encode())]
        parts += [message("A", struct.pack("<BH", 0, number) + name.encode())]
        numbers = np.concatenate(list(wide.values()), axis=1).astype("<f4")
        rows += [
            (int(at), struct.pack("<HQ", number, int(at)) + row.tobytes())
            for at, row in zip(t, numbers, strict=True)
        ]
    parts += [message("D", body) for _, body in sorted(rows)]
    path.write_bytes(b"".join([*head, *parts]))
    return path
