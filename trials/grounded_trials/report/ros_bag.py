"""Exports a trial or candidate as a ROS 2 bag of standard messages, for `ros2 bag play`, RViz etc.

Every state and input is a number on its own topic. If the model's roles name a position or joints,
the robot's pose is written too:

    /state/NAME, /input/NAME      std_msgs/Float64
    /pose, /odom, /tf             PoseStamped, Odometry, TFMessage of the body: roles position,
                                  heading or attitude, altitude, speed
    /joint_states                 JointState: states in rad and the states that are their rates
    /target                       nav_msgs/Path, once

A bag is a folder with a `.db3` or `.mcap` file and its metadata.yaml, written by rosbags.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import one_of, refused
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import rate_states
from grounded_trials.formats.bags import standard_types
from grounded_trials.report.scene import Scene, scene_of
from grounded_trials.store.store import made_folder, write_atomically
from grounded_trials.workspace.candidates.exporting import Exported, format_of
from grounded_trials.workspace.candidates.search_state import candidate_named
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unknown_candidate, unknown_trial

FRAME, BODY = "map", "robot"
BAGS = ("bag", "db3", "mcap")  # endings of a bag's folder
Message = tuple[str, str, int, Any]  # topic, type, time [ns], message


def _write_bag(
    path: Path, model: Model, dt: float, states: Array, inputs: Array, target: Array
) -> None:
    """Write a run to the new folder `path`: as MCAP if "mcap" is in its name, else as `.db3`."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    if path.exists():
        raise refused("file.exists", path)
    storage = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
    store = standard_types()
    with tempfile.TemporaryDirectory(prefix=".bag-", dir=made_folder(path.parent)) as room:
        made = Path(room) / path.name
        with Writer(made, version=9, storage_plugin=storage) as writer:
            topics: dict[str, Any] = {}
            for topic, kind, time, message in _Run(model, dt).messages(states, inputs, target):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(topics[topic], time, store.serialize_cdr(message, kind))
        shutil.move(made, path)


class _Run:
    """The messages of one run in order of time, which starts at 0."""

    def __init__(self, model: Model, dt: float) -> None:
        self.model, self.dt = model, dt
        self.kinds = standard_types().types
        scene = scene_of(model)
        self.scene: Scene | None = scene if scene.spatial else None
        self.joints = {q: w for q, w in rate_states(model).items() if model.states[q] == "rad"}

    def messages(self, states: Array, inputs: Array, target: Array) -> Iterator[Message]:
        """Yield all messages; values that are not finite are left out."""
        if self.scene is not None and len(points := self.scene.finite(target)):
            yield "/target", "nav_msgs/msg/Path", 0, self._path(points)
        turns = self.scene.rotations(states) if self.scene is not None else None
        for step, x in enumerate(states):
            time = round(step * self.dt * 1e9)
            for name, value in zip(self.model.state_names, x, strict=True):
                if np.isfinite(value):
                    yield f"/state/{name}", "std_msgs/msg/Float64", time, self._number(value)
            if step < len(inputs):
                for name, value in zip(self.model.input_names, inputs[step], strict=True):
                    yield f"/input/{name}", "std_msgs/msg/Float64", time, self._number(value)
            if self.scene is not None and turns is not None and np.isfinite(x).all():
                yield from self._body(time, x, turns[step])
            if self.joints and np.isfinite(x).all():
                yield "/joint_states", "sensor_msgs/msg/JointState", time, self._joints(time, x)

    def _number(self, value: float) -> Any:
        return self.kinds["std_msgs/msg/Float64"](data=float(value))

    def _of(self, kind: str, **parts: Any) -> Any:
        return self.kinds[f"geometry_msgs/msg/{kind}"](**parts)

    def _header(self, time: int) -> Any:
        stamp = self.kinds["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
        return self.kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME)

    def _pose(self, point: Array, turn: Array) -> Any:
        x, y, z = map(float, point)
        qx, qy, qz, qw = quaternion(turn)
        return self._of(
            "Pose",
            position=self._of("Point", x=x, y=y, z=z),
            orientation=self._of("Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def _body(self, time: int, state: Array, turn: Array) -> Iterator[Message]:
        assert self.scene is not None
        point = self.scene.points(state[None])[0]
        pose, header = self._pose(point, turn), self._header(time)
        stamped = self._of("PoseStamped", header=header, pose=pose)
        yield "/pose", "geometry_msgs/msg/PoseStamped", time, stamped
        linear, angular = self._twist(state)
        twist = self._of("Twist", linear=linear, angular=angular)
        odometry = self.kinds["nav_msgs/msg/Odometry"](
            header=header,
            child_frame_id=BODY,
            pose=self._of("PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self._of("TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        yield "/odom", "nav_msgs/msg/Odometry", time, odometry
        x, y, z = map(float, point)
        moved = self._of(
            "Transform",
            translation=self._of("Vector3", x=x, y=y, z=z),
            rotation=pose.orientation,
        )
        frame = self._of("TransformStamped", header=header, child_frame_id=BODY, transform=moved)
        frames = self.kinds["tf2_msgs/msg/TFMessage"](transforms=[frame])
        yield "/tf", "tf2_msgs/msg/TFMessage", time, frames

    def _twist(self, state: Array) -> tuple[Any, Any]:
        names, roles = self.model.state_names, self.model.roles
        speed, rate = (
            float(state[names.index(role)]) if isinstance(role, str) and role in names else 0.0
            for role in (roles.get("speed"), roles.get("heading_rate"))
        )
        linear = self._of("Vector3", x=speed, y=0.0, z=0.0)
        return linear, self._of("Vector3", x=0.0, y=0.0, z=rate)

    def _joints(self, time: int, state: Array) -> Any:
        index = self.model.state_names.index
        return self.kinds["sensor_msgs/msg/JointState"](
            header=self._header(time),
            name=list(self.joints),
            position=np.array([state[index(q)] for q in self.joints]),
            velocity=np.array([state[index(w)] for w in self.joints.values()]),
            effort=np.zeros(0),
        )

    def _path(self, points: Array) -> Any:
        still, header = np.eye(3), self._header(0)
        poses = [
            self._of("PoseStamped", header=header, pose=self._pose(point, still))
            for point in points
        ]
        return self.kinds["nav_msgs/msg/Path"](header=header, poses=poses)


def quaternion(turn: Array) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return float(x), float(y), float(z), float(w)


def export_run(
    workspace: Folder, identity: str, form: str | None, path: Path | None, *, runner: bool = False
) -> Exported:
    """Write a trial, or a candidate's predicted run, see `Workspace.export`."""
    if runner:
        raise unknown_candidate(workspace, identity)
    form = form or format_of(path, ("csv", "npz", *BAGS), "bag")
    form = "bag" if form in BAGS else form
    one_of("the format of a run", form, ("bag", "csv", "npz"))
    states, inputs, dt = _run_of(workspace, identity)
    path = path or Path(f"{identity}.{form}" if form != "bag" else f"{identity}_bag")
    model = workspace.base_model
    if form == "bag":
        _write_bag(path, model, dt, states, inputs, workspace.task.target)
        return Exported(identity, path, form)
    names = ("t", *model.state_names, *model.input_names)
    last = np.full((1, model.m), np.nan)  # the last state has no input
    rows = np.hstack([dt * np.arange(len(states))[:, None], states, np.vstack([inputs, last])])
    stream = io.BytesIO()
    if form == "npz":
        np.savez(stream, **dict(zip(names, rows.T, strict=True)))
    else:
        np.savetxt(stream, rows, fmt="%.10g", delimiter=",", header=",".join(names), comments="")
    write_atomically(path, stream.getvalue())
    return Exported(identity, path, form)


def _run_of(workspace: Folder, identity: str) -> tuple[Array, Array, float]:
    """Return states, inputs and control interval of a stored trial or a candidate's prediction."""
    for stored in workspace.trials():
        if stored.trial.id == identity:
            return stored.trial.states, stored.trial.inputs, stored.trial.dt
    if identity.startswith("t"):
        raise unknown_trial(workspace, identity)
    found, _ = workspace.candidate(candidate_named(workspace, identity))
    return found.predicted_states, found.predicted_inputs, found.policy.dt
