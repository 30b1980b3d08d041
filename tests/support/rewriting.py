"""Rewrite grounded's files with other contents and valid checksums."""

from __future__ import annotations

import io

import numpy as np

from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    Header,
    Messages,
    Metadata,
    Schema,
)
from grounded_trials.formats.mcap_walk import read_records
from grounded_trials.formats.mcap_writer import McapWriter


def with_metadata(source: bytes, key: str, value: str | None) -> bytes:
    """Rewrite a file with one metadata entry changed and valid checksums."""
    stream = io.BytesIO()
    copy = McapWriter(stream, Header("", "grounded"))
    schemas: dict[int, Schema] = {}
    numbers: dict[int, int] = {}
    for r in read_records(source, "file"):
        if isinstance(r, Metadata):
            table = {k: v for k, v in r.data.items() if k != key}
            copy.metadata(r.name, table if value is None else {**table, key: value})
        elif isinstance(r, Attachment):
            copy.attachment(**vars(r))
        elif isinstance(r, Schema):
            schemas[r.id] = r
        elif isinstance(r, Channel):
            own = schemas[r.schema_id]
            number = copy.schema(own.name, own.encoding, own.data)
            numbers[r.id] = copy.channel(r.topic, r.encoding, number, r.metadata)
        elif isinstance(r, Messages):
            for identity in np.unique(r.channels).tolist():
                copy.messages(r.take(r.channels == identity), numbers[identity])
    copy.finish()
    return stream.getvalue()
