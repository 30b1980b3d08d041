"""Log file formats: MCAP, ROS bags and tables to arrays, and the schemas that describe them.

Depends on grounded only for its error type. Read `mcap_walk.py` first (the records of a file in
order, with checksums verified; their contents in `mcap_records.py`), then `messages.py` (types and
nodes that message paths walk, and JSON). `schemas.py` turns definitions into types. `cdr.py`
decodes many messages at once, eight times as fast as a library does one by one; to protobuf's
library, in C, `protobuf.py` leaves them. `message_path.py` and `path_walk.py` extract numbers.
`mcap_writer.py` writes message by message, `mcap_whole.py` a whole candidate at once.

`bags.py` (.db3, .bag) and `tables.py` (.csv, .npz, .ulg) convert other files to the same records.
"""
