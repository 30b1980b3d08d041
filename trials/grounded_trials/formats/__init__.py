"""Log file formats: MCAP, ROS bags and tables to arrays.

Depends on grounded only for its error type. Read `mcap_walk.py` first (the records of a file in
order, with checksums verified; their contents in `mcap_records.py`), then `messages.py` (messages
of any encoding as Python objects; `cdr.py` reads many at once). `message_path.py` and
`path_walk.py` extract numbers. `mcap_writer.py` writes; `protobuf.py` has the messages of our own
files.

`bags.py` (.db3, .bag) converts other bags to the same records. `tables.py` does so with tables, of
which each format has a reader of one shape: there, and in `text_tables.py`, `parquet.py` (with
`lerobot.py`), `mat.py`, `dataflash.py`.
"""
