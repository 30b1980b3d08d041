"""Finding records again after damage: the next place from which the chain of them holds.

Nothing marks the start of a record, but each says where the next one starts. A place is believed
when it begins a chunk whose inner lengths fit each other, or the first of several records in a
row, or the last ones of the file.
"""

from __future__ import annotations

from struct import Struct
from typing import BinaryIO

import numpy as np

from grounded_trials.mcap_records import CHUNK, DATA_END, MESSAGE, MESSAGE_HEADER
from grounded_trials.mcap_walk import MAGIC, RECORD_LIMIT

_HEAD = Struct("<BQ")
_BLOCK = 2**20
CHAIN = 3  # records in a row that make a place believed


def read_at(stream: BinaryIO, offset: int, count: int) -> bytes:
    """Bytes of a file, fewer at its end."""
    stream.seek(offset)
    return stream.read(count)


def plausible(stream: BinaryIO, size: int, offset: int) -> int | None:
    """Where the record at `offset` ends, if one may be there."""
    head = read_at(stream, offset, 9)
    if len(head) < 9:
        return None
    opcode, length = _HEAD.unpack(head)
    end = offset + 9 + int(length)
    if opcode == 0 or opcode > DATA_END or length > RECORD_LIMIT or end > size:
        return None
    if opcode == MESSAGE and length < MESSAGE_HEADER:
        return None
    if opcode == CHUNK and not is_chunk(read_at(stream, offset + 9, 64), int(length)):
        return None
    return end


def is_chunk(start: bytes, length: int) -> bool:
    """Whether the content of a chunk of this length may start so: its inner lengths fit."""
    if len(start) < 40:
        return False
    name = int.from_bytes(start[28:32], "little")
    if name > 8 or start[32 : 32 + name] not in (b"", b"zstd", b"lz4"):
        return False
    return int.from_bytes(start[32 + name : 40 + name], "little") == length - 40 - name


def next_chain(stream: BinaryIO, size: int, start: int) -> int | None:
    """The first offset from `start` on where records follow each other again; None: nowhere."""
    for block in range(start, size, _BLOCK):
        data = np.frombuffer(read_at(stream, block, _BLOCK + 8), dtype=np.uint8)
        if len(data) < 9:
            return None
        opcodes = data[: len(data) - 8]
        maybe = (opcodes > 0) & (opcodes <= DATA_END)
        for i in range(5, 9):  # lengths are below 2^32
            maybe &= data[i : len(data) - 8 + i] == 0
        for i in np.flatnonzero(maybe[:_BLOCK]).tolist():
            if _is_chain(stream, size, block + i):
                return int(block + i)
    return None


def _is_chain(stream: BinaryIO, size: int, offset: int) -> bool:
    if read_at(stream, offset, 1) == bytes([CHUNK]):
        return plausible(stream, size, offset) is not None
    for _ in range(CHAIN):
        end = plausible(stream, size, offset)
        if end is None:
            return False
        if end == size - len(MAGIC) and read_at(stream, end, len(MAGIC)) == MAGIC:
            return True
        offset = end
    return True
