"""Bytes of log files as arrays: MCAP, ROS bags, tables, and the schemas that describe them.

Knows nothing of grounded but its error type. Read `mcap_walk.py` (a file's records in order,
checksums checked; `mcap_records.py`: what each holds) and `messages.py` (what a message is to a
path, and JSON) first. `schemas.py` and `idl_schema.py` turn definitions into types; `cdr.py` and
`protobuf.py` decode many messages at once, eight times as fast as a library does one by one;
`message_path.py` and `path_walk.py` pick numbers out of them. `mcap_writer.py` writes,
`mcap_whole.py` a whole candidate at once.

`bags.py` (.db3, .bag) and `tables.py` (.csv, .npz, .ulg) give the records of files that are not
MCAP. `name_endings.py` knows the units that names end with.
"""
