"""Log file formats: MCAP, ROS bags and tables to arrays, and the schemas that describe them.

Depends on grounded only for its error type. Read `mcap_walk.py` first (the records of a file in
order, with checksums verified; their contents in `mcap_records.py`), then `messages.py` (types and
nodes that message paths walk, and JSON). `schemas.py` turns definitions into types. `cdr.py`
decodes many messages at once, eight times as fast as a library does one by one; to protobuf's
library, in C, `protobuf.py` leaves them. `message_path.py` and `path_walk.py` extract numbers.
`mcap_writer.py` writes.

`bags.py` (.db3, .bag) converts other bags to the same records. `tables.py` does so with tables, of
which each format has a reader of one shape: there, and in `text_tables.py`, `parquet.py`, `mat.py`,
`dataflash.py`.
"""
