"""A balancing robot's log: its odometry has columns that never change, its one command no name."""

import numpy as np

from grounded_trials.logs.inspection.inspect_guess import guess_mapping
from grounded_trials.logs.inspection.inspect_log import inspect_log
from ros_bags import START, T, bag, header, odometry, vector

TOPICS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/cmd_torque": "geometry_msgs/msg/Vector3Stamped",
}


def balancer_bag(folder, second=0.0):
    """Six seconds; `second`: of another number in its command's message."""
    messages = []
    for k in range(600):
        t, s = START + k * 10**7, 0.01 * k
        th, w = 0.1 * np.sin(2 * s), 0.2 * np.cos(2 * s)
        x, v = 0.5 * np.sin(s), 0.5 * np.cos(s)
        none = np.zeros(9)
        imu = T["sensor_msgs/msg/Imu"](
            header=header(t),
            orientation=T["geometry_msgs/msg/Quaternion"](
                x=0.0, y=np.sin(th / 2), z=0.0, w=np.cos(th / 2)
            ),
            orientation_covariance=none,
            angular_velocity=vector("Vector3", 0.0, w, 0.0),
            angular_velocity_covariance=none,
            linear_acceleration=vector("Vector3", 0.0, 0.0, 9.81),
            linear_acceleration_covariance=none,
        )
        sent = vector("Vector3", np.sin(3 * s), second * np.cos(5 * s), 0.0)
        command = T["geometry_msgs/msg/Vector3Stamped"](header=header(t), vector=sent)
        messages.append(("/odom", t, odometry(t, x, 0.0, 0.0, v, 0.0)))
        messages += [("/imu/data", t, imu), ("/cmd_torque", t, command)]
    return bag(folder, TOPICS, messages)


def test_what_never_changes_loses_though_its_message_has_other_states(tmp_path):
    units = {"x": "m", "th": "rad", "v": "m/s", "torque": "N m"}
    report = inspect_log(balancer_bag(tmp_path / "bag"))
    (_, th, _), _ = guess_mapping(report, ["x", "th", "v"], ["torque"], units)
    assert th.path == "/imu/data.orientation.@rpy.pitch" and not th.sure
    assert "/odom.pose.pose.orientation.@rpy.pitch" in th.others
    (y,), _ = guess_mapping(report, ["y"], ["torque"], {"y": "m"})
    assert y.path == "/odom.pose.pose.position.y"  # nothing else is called so: it stands still
