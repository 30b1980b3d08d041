"""Bytes of log files as arrays: MCAP, CDR, protobuf, JSON, and the schemas that describe them.

Knows nothing of grounded but its error type. Read `mcap_walk.py` (records of a file, checksums
checked) and `messages.py` (what a message is to a path) first; `cdr.py`, `protobuf.py`,
`json_messages.py` decode many messages at once, `message_path.py` and `path_walk.py` pick numbers
out of them.
"""
