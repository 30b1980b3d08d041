"""Fly a MuJoCo drone by hand or by an exported candidate, and log it as mavros does.

    python -m benchmarks.foreign.drone hand FOLDER
    python -m benchmarks.foreign.drone fly c0001.npz FOLDER

The drone has an inner attitude loop, motors with a lag, and what `WITHHELD` says, none of which the
skeleton of `grounded init --from FOLDER` has. The bag holds /mavros/local_position/odom, whose
velocity is in the drone's own axes, and /mavros/setpoint_raw/attitude.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from grounded.onboard import load

XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="drone" pos="0 0 2"><freejoint/>
<inertial pos="0.004 -0.002 0" mass="1.31" diaginertia="0.0123 0.0131 0.0224"/>
<geom type="box" size=".12 .12 .03" density="0" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""
MASS, INERTIA = 1.31, np.array([0.0123, 0.0131, 0.0224])  # kg, kg m^2
WITHHELD = {
    "drag": 0.35,  # 1/s, beside 0.02 N s^2/m^2
    "wind": np.array([1.2, -0.5, 0.0]),  # m/s
    "delay": 0.036,  # s, of the radio
    "lag": 0.03,  # s, of each motor, inside the attitude loop
    "trim": np.array([0.021, -0.012, 0.0]),  # rad, of the attitude's zero
    "thrust": np.array([24.6 * 0.35, 24.6 * 0.65]),  # N, times u and u^2: it hovers at u = 0.667
}
RATE, STEP = 50, 0.002  # Hz of log and commands; s
SENSORS = {"position": (0.004, 0.004, 0.006), "velocity": 0.015, "attitude": 0.0015}
EPOCH = 1_795_600_000 * 10**9  # ns
ODOMETRY, ATTITUDE = "nav_msgs/msg/Odometry", "mavros_msgs/msg/AttitudeTarget"
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Quaternion orientation\n"
        "geometry_msgs/Vector3 body_rate\nfloat32 thrust",
        ATTITUDE,
    )
)
T = STORE.types
Command = Any  # (4,) roll, pitch, yaw [rad], thrust [1]
Pilot = Callable[[float, np.ndarray, np.ndarray, np.ndarray], Command]


def angles(q: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw [rad] of a quaternion (w, x, y, z)."""
    w, x, y, z = q
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)), yaw])


def quaternion(rpy: np.ndarray) -> Any:
    """Return the message of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy / 2), np.sin(rpy / 2)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return T["geometry_msgs/msg/Quaternion"](*map(float, (x, y, z, w)))


class Drone:
    """The drone; `send` a command, then `advance`."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.torque, self.thrust = np.zeros(3), MASS * 9.81
        self.command = np.array([0.0, 0.0, 0.0, 0.667])
        self.waiting: list[tuple[float, np.ndarray]] = []

    def send(self, command: Command) -> None:
        self.waiting.append((self.data.time + WITHHELD["delay"], np.asarray(command, float)))

    def advance(self, seconds: float) -> None:
        data, part = self.data, STEP / WITHHELD["lag"]
        for _ in range(round(seconds / STEP)):
            while self.waiting and self.waiting[0][0] <= data.time + 1e-9:
                self.command = self.waiting.pop(0)[1]
            off = self.command[:3] + WITHHELD["trim"] - angles(data.qpos[3:7])
            off[2] = np.arctan2(np.sin(off[2]), np.cos(off[2]))
            rate = np.array([9.0, 9.0, 3.0]) * off
            wanted = INERTIA * np.array([22.0, 22.0, 12.0]) * (rate - data.qvel[3:6])
            u = self.command[3]
            self.torque += part * (wanted - self.torque)
            self.thrust += part * (WITHHELD["thrust"] @ [u, u * u] - self.thrust)
            turned, air = self.rotation(), data.qvel[:3] - WITHHELD["wind"]
            drag = (WITHHELD["drag"] * MASS + 0.02 * np.linalg.norm(air)) * air
            data.xfrc_applied[1, :3] = turned @ [0.0, 0.0, self.thrust] - drag
            data.xfrc_applied[1, 3:] = turned @ self.torque
            mujoco.mj_step(self.model, data)

    def rotation(self) -> np.ndarray:
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, self.data.qpos[3:7])
        return turned.reshape(3, 3)


class Log:
    """A bag of what the drone's sensors say and what it is told."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        self.writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self.writer.open()
        topics = {
            "/mavros/local_position/odom": ODOMETRY,
            "/mavros/setpoint_raw/attitude": ATTITUDE,
        }
        self.open = {
            kind: self.writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in topics.items()
        }
        self.rng = rng

    def header(self, t: float) -> Any:
        at = EPOCH + round(t * 1e9)
        stamp = T["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
        return T["std_msgs/msg/Header"](stamp=stamp, frame_id="map")

    def write(self, t: float, kind: str, message: Any) -> None:
        late = int(self.rng.uniform(5e5, 4e6))  # ns, of the recorder
        raw = STORE.serialize_cdr(message, kind)
        self.writer.write(self.open[kind], EPOCH + round(t * 1e9) + late, raw)

    def sensed(self, t: float, drone: Drone) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Write an Odometry; return position, velocity in the world, and attitude as sensed."""
        normal, data = self.rng.normal, drone.data
        at = data.qpos[:3] + normal(0, SENSORS["position"])
        v = data.qvel[:3] + normal(0, SENSORS["velocity"], 3)
        rpy = angles(data.qpos[3:7]) + normal(0, SENSORS["attitude"], 3)
        vector, own = T["geometry_msgs/msg/Vector3"], drone.rotation().T @ v
        pose = T["geometry_msgs/msg/Pose"](
            T["geometry_msgs/msg/Point"](*map(float, at)), quaternion(rpy)
        )
        twist = T["geometry_msgs/msg/Twist"](
            vector(*map(float, own)), vector(*map(float, data.qvel[3:6]))
        )
        none = np.zeros(36)
        message = T[ODOMETRY](
            self.header(t),
            "base_link",
            T["geometry_msgs/msg/PoseWithCovariance"](pose, none),
            T["geometry_msgs/msg/TwistWithCovariance"](twist, none),
        )
        self.write(t, ODOMETRY, message)
        return at, v, rpy

    def commanded(self, t: float, command: Command) -> None:
        still = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        turned = quaternion(np.asarray(command[:3]))
        message = T[ATTITUDE](self.header(t), 7, turned, still, np.float32(command[3]))
        self.write(t, ATTITUDE, message)


class ByHand:
    """A pilot who flies from point to point."""

    def __init__(self, places: Callable[[float], np.ndarray]) -> None:
        self.places, self.missed = places, np.zeros(3)

    def __call__(self, t: float, at: np.ndarray, v: np.ndarray, rpy: np.ndarray) -> Command:
        off = self.places(t) - at
        self.missed += off / RATE
        ax, ay, az = 1.6 * off - 1.9 * v + 0.5 * self.missed
        cos, sin = np.cos(rpy[2]), np.sin(rpy[2])
        tilt = np.array([sin * ax - cos * ay, cos * ax + sin * ay]) / 9.81
        up = np.clip(0.667 + 0.45 * az / 9.81, 0.2, 0.95)
        return np.array([*np.clip(tilt, -0.5, 0.5), 0.0, up])


def flown(folder: Path, pilot: Pilot, seconds: float, seed: int) -> None:
    """Fly for some seconds and write the bag."""
    drone, log = Drone(), Log(folder, np.random.default_rng(seed))
    for k in range(round(seconds * RATE)):
        t = k / RATE
        command = pilot(t, *log.sensed(t, drone))
        log.commanded(t + 0.0015, command)
        drone.send(command)
        drone.advance(1 / RATE)
    log.sensed(seconds, drone)
    log.writer.close()


def by_candidate(file: str, folder: Path, seed: int, before: float = 12.0) -> None:
    """Hover at the candidate's start by hand, fly the candidate, and hover where it ends."""
    runner = load(file, states=("x", "y", "z", "vx", "vy", "vz", "roll", "pitch"))
    first, last = (np.array(runner.policy.reference[k][:3]) for k in (0, -1))
    hold = ByHand(lambda t: first if t < before + 1 else last)

    def pilot(t: float, at: np.ndarray, v: np.ndarray, rpy: np.ndarray) -> Command:
        if t < before or runner.done(t - before):
            return hold(t, at, v, rpy)
        roll, pitch, thrust = runner.action(t - before, [*at, *v, *rpy[:2]])
        return np.array([roll, pitch, 0.0, thrust])

    flown(folder, pilot, before + len(runner.policy.reference) / RATE + 1.5, seed)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.foreign.drone", description=__doc__)
    parser.add_argument("what", choices=("hand", "fly"))
    parser.add_argument("paths", nargs="+", help="[candidate.npz] FOLDER")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    if asked.what == "fly":
        file, folder = asked.paths
        by_candidate(file, Path(folder), asked.seed)
        return
    draw = np.random.default_rng(asked.seed)
    points = np.column_stack([draw.uniform(-2, 2, (20, 2)), draw.uniform(1.2, 3, 20)])
    start = np.array([0.0, 0.0, 2.0])
    places = ByHand(lambda t: start if t < 3 else points[int((t - 3) / 1.7) % 20])
    flown(Path(asked.paths[0]), places, 30.0, asked.seed)


if __name__ == "__main__":
    main()
