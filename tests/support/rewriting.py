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
from grounded_trials.formats.mcap_writer import CopyWriter


def with_metadata(source: bytes, key: str, value: str | None) -> bytes:
    """Rewrite a file with one metadata entry changed and valid checksums."""
    stream = io.BytesIO()
    copy = CopyWriter(stream, Header("", "grounded"), compressed=False)
    schemas: dict[int, Schema] = {}
    numbers: dict[int, int] = {}
    for r in read_records(io.BytesIO(source), "file"):
        if isinstance(r, Metadata):
            table = {k: v for k, v in r.data.items() if k != key}
            copy.metadata(Metadata(r.name, table if value is None else {**table, key: value}))
        elif isinstance(r, Attachment):
            copy.attachment(r)
        elif isinstance(r, Schema):
            schemas[r.id] = r
        elif isinstance(r, Channel):
            numbers[r.id] = copy.channel(r, schemas[r.schema_id])
        elif isinstance(r, Messages):
            for identity in np.unique(r.channels).tolist():
                copy.messages(r.take(r.channels == identity), numbers[identity])
    copy.finish()
    return stream.getvalue()
