"""Write MCAP: protobuf channels of named doubles, a table of strings, attachments.

Only this module imports the mcap package; candidates are written at once (`mcap_whole`). Files are
not compressed: trials are small, their numbers compress badly, and without compression equal input
gives equal bytes whatever the version of the compressor.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np

from grounded.frozen import Array
from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    Header,
    Messages,
    Metadata,
    Schema,
)
from grounded_trials.formats.protobuf import double_tag, doubles_tag, varint

LIBRARY = "grounded"
Rows = np.ndarray[Any, np.dtype[np.uint8]]  # encoded messages of one length (N, bytes)


class _Writer:
    """An MCAP file being written to a stream."""

    def __init__(self, stream: IO[bytes], header: Header, *, compressed: bool) -> None:
        from mcap.writer import CompressionType, Writer

        kind = CompressionType.ZSTD if compressed else CompressionType.NONE
        self._stream = stream
        self._writer = Writer(stream, compression=kind, enable_data_crcs=True)
        self._writer.start(profile=header.profile, library=header.library)

    def finish(self) -> None:
        """End the file; the stream stays open."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()


class LogWriter(_Writer):
    """Writes one file: metadata and attachments first, then messages."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(stream, Header("", LIBRARY), compressed=False)
        self._sequences: dict[int, int] = {}

    def metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Add a table of strings."""
        self._writer.add_metadata(name, dict(table))

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment."""
        self._writer.add_attachment(0, 0, name, media_type, data)

    def channel(
        self, topic: str, message: str, names: Sequence[str], *, repeated: bool = False
    ) -> int:
        """Open a protobuf channel whose message has one double (or list of doubles) per name.

        Returns:
            The id of the channel.
        """
        descriptor = file_descriptor_set(message, names, repeated=repeated)
        schema = self._writer.register_schema(f"grounded.{message}", "protobuf", descriptor)
        return self._writer.register_channel(topic, "protobuf", schema)

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        """Add a message that was sampled and logged at `time_ns`."""
        sequence = self._sequences.get(channel, 0)
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, time_ns, data, time_ns, sequence)

    def flush(self) -> None:
        """Pass everything written so far to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]


class CopyWriter(_Writer):
    """Writes records as they were read, with new ids."""

    def __init__(self, stream: IO[bytes], header: Header, *, compressed: bool) -> None:
        super().__init__(stream, header, compressed=compressed)
        self._schemas: dict[Schema, int] = {}

    def channel(self, channel: Channel, schema: Schema | None) -> int:
        """Add a channel with its schema; return the id for its messages."""
        number = 0
        if schema is not None:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            number = self._schemas[schema]
        return self._writer.register_channel(
            channel.topic, channel.encoding, number, dict(channel.metadata)
        )

    def messages(self, batch: Messages, channel: int) -> None:
        """Add the messages of a batch, all of one channel."""
        columns = (batch.starts, batch.ends, batch.log_times, batch.publish_times, batch.sequences)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for start, end, log_time, publish_time, sequence in rows:
            data = batch.buffer[start:end]
            self._writer.add_message(channel, log_time, data, publish_time % 2**64, sequence)

    def metadata(self, record: Metadata) -> None:
        """Add a table."""
        self._writer.add_metadata(record.name, record.data)

    def attachment(self, record: Attachment) -> None:
        """Add an attachment."""
        self._writer.add_attachment(
            record.create_time, record.log_time, record.name, record.media_type, record.data
        )


def file_descriptor_set(message: str, names: Sequence[str], *, repeated: bool = False) -> bytes:
    """Return a serialised FileDescriptorSet of one proto3 message of doubles, numbered from 1.

    It is written by hand, with the numbers of google/protobuf/descriptor.proto, to avoid the slow
    import of the protobuf package.
    """
    label, double = (3 if repeated else 1), 1  # LABEL_REPEATED, LABEL_OPTIONAL; TYPE_DOUBLE
    fields = [
        _bytes(1, name.encode()) + _integer(3, number) + _integer(4, label) + _integer(5, double)
        for number, name in enumerate(names, start=1)
    ]
    definition = _bytes(1, message.encode()) + b"".join(_bytes(2, field) for field in fields)
    name = f"grounded/{message}.proto".encode()
    file = _bytes(1, name) + _bytes(2, b"grounded") + _bytes(4, definition) + _bytes(12, b"proto3")
    return _bytes(1, file)


class DoublesEncoder:
    """Encodes protobuf messages of `count` doubles, numbered from 1.

    Zeros are written as well, so that all messages have the same length and -0.0 is preserved.
    """

    def __init__(self, count: int) -> None:
        tags = [double_tag(number) for number in range(1, count + 1)]
        self._form = struct.Struct("<" + "".join(f"{len(tag)}sd" for tag in tags))
        self._parts: list[bytes | float] = [0.0] * (2 * count)
        self._parts[::2] = tags

    def __call__(self, values: Array) -> bytes:
        """Return the message of these values (count,)."""
        self._parts[1::2] = values.tolist()
        return self._form.pack(*self._parts)


def encode_doubles(values: Array) -> list[bytes]:
    """Return the messages of `DoublesEncoder` for many rows, (N, count)."""
    return [row.tobytes() for row in rows_of(values)]


def rows_of(values: Array) -> Rows:
    """Return the messages of `encode_doubles` as an array (N, bytes)."""
    tags = [double_tag(number) for number in range(1, values.shape[1] + 1)]
    return _joined(list(zip(tags, values.T[:, :, None], strict=True)))


def rows_of_lists(lists: Sequence[Array]) -> Rows:
    """Return messages (N, bytes) of packed repeated doubles, numbered from 1.

    Args:
        lists: one array (N, count) per field, with a row for each message; a field with count 0
            is left out.
    """
    return _joined(
        [
            (doubles_tag(number, values.shape[1]), values)
            for number, values in enumerate(lists, start=1)
            if values.shape[1]
        ]
    )


def _joined(fields: Sequence[tuple[bytes, Array]]) -> Rows:
    """Return rows of fields, each a constant prefix followed by the row's doubles (N, ...)."""
    parts = list[Rows]()
    for prefix, values in fields:
        data = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
        parts += [np.tile(np.frombuffer(prefix, np.uint8), (len(values), 1)), data]
    return np.hstack(parts)


def _bytes(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def _integer(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)
