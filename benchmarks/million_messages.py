"""Time the reading of a million nav_msgs/Odometry messages.

Run by hand: python benchmarks/million_messages.py [COUNT].
"""

from __future__ import annotations

import struct
import sys
import tempfile
from pathlib import Path

from helpers import fastest
from mcap.writer import CompressionType, Writer

from grounded_trials.formats.bags import standard_types
from grounded_trials.logs.signals import SignalSpec, read_signals

KIND = "nav_msgs/msg/Odometry"
PATHS = {
    "x": "/odom.pose.pose.position.x",
    "y": "/odom.pose.pose.position.y",
    "yaw": "/odom.pose.pose.orientation.@rpy.yaw",
    "v": "/odom.twist.twist.linear.x",
}


def write(path: Path, count: int, *, chunked: bool) -> None:
    """Write an Odometry message a millisecond, with a stamp and two frame names."""
    rest = struct.pack("<85d", *range(85))
    kind = CompressionType.ZSTD if chunked else CompressionType.NONE
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind, use_chunking=chunked)
        writer.start("ros2")
        definition, _ = standard_types().generate_msgdef(KIND, 2)
        schema = writer.register_schema(KIND, "ros2msg", definition.encode())
        channel = writer.register_channel("/odom", "cdr", schema)
        for i in range(count):
            stamp = struct.pack("<II", i // 1000, i % 1000 * 10**6)
            names = struct.pack("<I5s3xI10s6x", 5, b"odom", 10, b"base_link")
            writer.add_message(channel, i * 10**6, b"\0\1\0\0" + stamp + names + rest, i * 10**6)
        writer.finish()


def main() -> None:
    """Print a line for each reader."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    with tempfile.TemporaryDirectory() as folder:
        for chunked in (True, False):
            path = Path(folder, "log.mcap")
            write(path, count, chunked=chunked)
            specs = {name: SignalSpec(text) for name, text in PATHS.items()}
            took = fastest(lambda path=path, specs=specs: read_signals(path, specs), 1)  # type: ignore[misc]
            size = path.stat().st_size / 1e6
            how = "zstd chunks" if chunked else "no chunks"
            print(f"{count} messages, {how}, {size:.0f} MB: 4 signals in {took:.2f} s")


if __name__ == "__main__":
    main()
