"""An independent logger: write the packets of robot and driver into a ROS 2 bag, until SIGTERM.

    python record.py BAG

/odom is nav_msgs/Odometry, /drive geometry_msgs/TwistStamped (linear.x the speed, angular.z the
steering angle), /killed std_msgs/Bool. Stamps are the senders', log times the logger's own.
"""

import json
import math
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np
from robot import HOST, RECORDER
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types


def main():
    """Record until SIGTERM."""
    on = [True]
    signal.signal(signal.SIGTERM, lambda *_: on.clear())
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((HOST, RECORDER))
    line.settimeout(0.1)
    kinds = {
        "/odom": "nav_msgs/msg/Odometry",
        "/drive": "geometry_msgs/msg/TwistStamped",
        "/killed": "std_msgs/msg/Bool",
    }
    with Writer(Path(sys.argv[1]), version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {t: bag.add_connection(t, kind, typestore=STORE) for t, kind in kinds.items()}
        print("recording", flush=True)
        while on:
            try:
                said = json.loads(line.recv(4096))
            except (TimeoutError, ValueError):
                continue
            for topic, message in messages(said):
                data = STORE.serialize_cdr(message, kinds[topic])
                bag.write(topics[topic], time.time_ns(), data)


def messages(said):
    """Yield the ROS messages of a packet, each with its topic."""
    t = round(said["t"] * 1e9)
    stamp = T["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)
    header = T["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
    if "speed" in said:
        yield (
            "/drive",
            geometry("TwistStamped", header=header, twist=twist(said["speed"], said["steering"])),
        )
        return
    half = said["psi"] / 2
    pose = geometry(
        "Pose",
        position=geometry("Point", x=said["x"], y=said["y"], z=0.0),
        orientation=geometry("Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
    )
    yield (
        "/odom",
        T["nav_msgs/msg/Odometry"](
            header=header,
            child_frame_id="car",
            pose=geometry("PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=geometry(
                "TwistWithCovariance", twist=twist(said["v"], 0.0), covariance=np.zeros(36)
            ),
        ),
    )
    yield "/killed", T["std_msgs/msg/Bool"](data=said["killed"])


def twist(forward, turn):
    """Return a Twist: a velocity along x and a rate about z."""
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    linear = geometry("Vector3", **(zero | {"x": float(forward)}))
    return geometry(
        "Twist", linear=linear, angular=geometry("Vector3", **(zero | {"z": float(turn)}))
    )


def geometry(kind, **parts):
    """Return a message of geometry_msgs."""
    return T[f"geometry_msgs/msg/{kind}"](**parts)


if __name__ == "__main__":
    main()
