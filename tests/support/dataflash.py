"""ArduPilot's logs, as the autopilot writes them: FMT, UNIT, FMTU, then the messages in order."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

STRUCT = {"Q": "Q", "b": "b", "B": "B", "f": "f", "c": "h", "n": "4s", "N": "16s", "Z": "64s"}
HEAD = b"\xa3\x95"
UNITS = {"s": "s", "d": "deg", "E": "rad/s", "#": "instance", "-": ""}
# name, letters, columns, units
Kind = tuple[str, str, str, str]
OWN: list[Kind] = [
    ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", ""),
    ("UNIT", "QbZ", "TimeUS,Id,Label", "s--"),
    ("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---"),
]


def dataflash(path: Path, kinds: Sequence[Kind], messages: Sequence[tuple[str, Sequence]]) -> Path:
    """Write a log of messages (name, fields), each beginning with its time [us]."""
    kinds = [*OWN, *kinds]
    numbers = {kind[0]: 0x80 + i for i, kind in enumerate(kinds)}
    packs = {name: "<" + "".join(STRUCT[c] for c in letters) for name, letters, *_ in kinds}

    def message(name: str, *fields: object) -> bytes:
        ready = [one.encode() if isinstance(one, str) else one for one in fields]
        return HEAD + bytes([numbers[name]]) + struct.pack(packs[name], *ready)

    parts = [
        message("FMT", numbers[name], 3 + struct.calcsize(packs[name]), name, letters, columns)
        for name, letters, columns, _ in kinds
    ]
    parts += [message("UNIT", 0, ord(letter), label) for letter, label in UNITS.items()]
    parts += [message("FMTU", 0, numbers[k[0]], k[3], "F" + "-" * (len(k[3]) - 1)) for k in kinds]
    parts += [message(name, *fields) for name, fields in messages]
    path.write_bytes(b"".join(parts))
    return path
