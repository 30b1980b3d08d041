"""Write ROS 2 bags of foreign robots (car, rover, arm, crane) with rosbags."""

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_HUMBLE)
OTHERS = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\n"
    "float32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\n"
    "ackermann_msgs/AckermannDrive drive",
    "mavros_msgs/msg/AttitudeTarget": "std_msgs/Header header\nuint8 type_mask\n"
    "geometry_msgs/Quaternion orientation\ngeometry_msgs/Vector3 body_rate\nfloat32 thrust",
    "crane_msgs/msg/SwingState": "std_msgs/Header header\nfloat64 angle\nfloat64 rate",
    "crane_msgs/msg/MotorVoltage": "std_msgs/Header header\nfloat64 voltage",
}
for name, text in OTHERS.items():
    STORE.register(get_types_from_msg(text, name))
T = STORE.types
DT, START = 0.01, 1_760_000_000_000_000_000


def header(t):
    stamp = T["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def vector(kind, x, y, z):
    return T[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)


def twist(ahead, turn):
    linear, angular = vector("Vector3", ahead, 0.0, 0.0), vector("Vector3", 0.0, 0.0, turn)
    return T["geometry_msgs/msg/Twist"](linear=linear, angular=angular)


def odometry(t, x, y, psi, v, rate):
    turn = T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(psi / 2), w=np.cos(psi / 2))
    pose = T["geometry_msgs/msg/Pose"](position=vector("Point", x, y, 0.0), orientation=turn)
    return T["nav_msgs/msg/Odometry"](
        header=header(t),
        child_frame_id="base",
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](
            twist=twist(v, rate), covariance=np.zeros(36)
        ),
    )


def drive(t, steering, speed):
    small = {n: np.float32(0) for n in ("steering_angle_velocity", "acceleration", "jerk")}
    command = T["ackermann_msgs/msg/AckermannDrive"](
        steering_angle=np.float32(steering), speed=np.float32(speed), **small
    )
    return T["ackermann_msgs/msg/AckermannDriveStamped"](header=header(t), drive=command)


def joints(t, names, q, w, tau):
    return T["sensor_msgs/msg/JointState"](
        header=header(t), name=names, position=q.copy(), velocity=w.copy(), effort=tau.copy()
    )


def bag(folder, topics, messages):
    with Writer(folder, version=9) as writer:
        open_ = {t: writer.add_connection(t, kind, typestore=STORE) for t, kind in topics.items()}
        for topic, t, message in messages:
            writer.write(open_[topic], t, STORE.serialize_cdr(message, topics[topic]))
    return folder


def car_bag(folder):
    """Write a bag of a car with a wheelbase of 0.32 m, driven in curves for 8 s."""
    topics = {
        "/odom": "nav_msgs/msg/Odometry",
        "/drive": "ackermann_msgs/msg/AckermannDriveStamped",
        "/joint_states": "sensor_msgs/msg/JointState",
    }
    messages, v, x, y, psi = [], 0.0, 0.0, 0.0, 0.0
    for k in range(800):
        t, steering, speed = START + k * 10**7, 0.3 * np.sin(0.01 * k), 1 + 0.5 * np.sin(0.02 * k)
        rate = v * np.tan(steering) / 0.32
        if k % 5 == 0:
            messages.append(("/drive", t, drive(t, steering, speed)))
        messages.append(("/odom", t, odometry(t, x, y, psi, v, rate)))
        wheels = np.array([20 * x, 20 * x])
        messages.append(("/joint_states", t, joints(t, ["left", "right"], wheels, wheels, wheels)))
        v, psi = v + DT * (0.9 * speed - v) / 0.35, psi + DT * rate
        x, y = x + DT * v * np.cos(psi), y + DT * v * np.sin(psi)
    return bag(folder, topics, messages)


def rover_bag(folder):
    """Write a bag of a two-wheeled robot whose commands begin a little before its odometry."""
    topics = {
        "/cmd_vel": "geometry_msgs/msg/Twist",
        "/odom": "nav_msgs/msg/Odometry",
        "/joint_states": "sensor_msgs/msg/JointState",
    }
    messages, v, w, x, y, psi = [], 0.0, 0.0, 0.0, 0.0, 0.0
    names = ["wheel_left_joint", "wheel_right_joint"]
    for k in range(1000):
        t, ahead, turn = START + k * 10**7, 0.6 * np.sin(0.01 * k) ** 2, 0.8 * np.sin(0.013 * k)
        if k % 5 == 0:
            messages.append(("/cmd_vel", t, twist(float(ahead), float(turn))))
        if k > 0:
            messages.append(("/odom", t, odometry(t, x, y, psi, v, w)))
            sides = np.array([v - 0.26 * w, v + 0.26 * w]) / 0.1
            turned = np.array([x, x]) / 0.1
            messages.append(("/joint_states", t, joints(t, names, turned, sides, 0 * sides)))
        v, w = v + DT * (ahead - v) / 0.2, w + DT * (turn - w) / 0.15
        psi += DT * w
        x, y = x + DT * v * np.cos(psi), y + DT * v * np.sin(psi)
    return bag(folder, topics, messages)


def boat_bag(folder):
    """Write a bag of a boat with two thrusters, whose commands are numbers on two topics."""
    topics = {"/odom": "nav_msgs/msg/Odometry"}
    topics |= dict.fromkeys(("/thruster_left", "/thruster_right"), "std_msgs/msg/Float32")
    messages, psi, x, y = [], 0.0, 0.0, 0.0
    number = T["std_msgs/msg/Float32"]
    for k in range(300):
        t, rate = START + k * 50_000_000, 0.3 * np.sin(0.02 * k)
        u, v = 0.8 + 0.2 * np.sin(0.05 * k), -0.3 * rate
        moving = odometry(t, x, y, psi, u, rate)
        moving.twist.twist.linear.y = v
        messages.append(("/odom", t, moving))
        for topic, way in (("/thruster_left", -1), ("/thruster_right", 1)):
            sent = 0.5 + 0.2 * np.sin(0.05 * k + 0.6) + way * 0.2 * np.sin(0.02 * k + 0.3)
            messages.append((topic, t, number(data=np.float32(sent))))
        psi += 0.05 * rate
        x += 0.05 * (u * np.cos(psi) - v * np.sin(psi))
        y += 0.05 * (u * np.sin(psi) + v * np.cos(psi))
    return bag(folder, topics, messages)


def turned(roll, pitch, yaw):
    """Return the quaternion (x, y, z, w) of Rz(yaw) Ry(pitch) Rx(roll), and that matrix."""
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    q = map(float, rotation.as_quat())
    return T["geometry_msgs/msg/Quaternion"](*q), rotation.as_matrix()


def drone_bag(folder, turning=0.0):
    """Write a bag of a drone as mavros does: the velocity of its odometry is in its own axes."""
    topics = {
        "/mavros/local_position/odom": "nav_msgs/msg/Odometry",
        "/mavros/setpoint_raw/attitude": "mavros_msgs/msg/AttitudeTarget",
    }
    messages, rng = [], np.random.default_rng(0)
    at, v, angles = np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.4])
    for k in range(700):
        t = START + k * 2 * 10**7
        if k % 25 == 0:
            tilt, thrust = rng.uniform(-0.3, 0.3, 2), 0.5 + rng.uniform(-0.03, 0.03)
        sent = np.array([*tilt, 1.4 + turning * np.sin(0.01 * k)])
        q, rotation = turned(*angles)
        own = rotation.T @ v
        message = odometry(t, 0.0, 0.0, 0.0, 0.0, 0.0)
        message.pose.pose.position = vector("Point", *map(float, at))
        message.pose.pose.orientation = q
        message.twist.twist.linear = vector("Vector3", *map(float, own))
        messages.append(("/mavros/local_position/odom", t, message))
        command = T["mavros_msgs/msg/AttitudeTarget"](
            header=header(t),
            type_mask=7,
            orientation=turned(*sent)[0],
            body_rate=vector("Vector3", 0.0, 0.0, 0.0),
            thrust=np.float32(thrust),
        )
        messages.append(("/mavros/setpoint_raw/attitude", t, command))
        angles = angles + 0.02 * (sent - angles) / 0.15
        push = rotation @ np.array([0.0, 0.0, 9.81 * thrust / 0.5]) - [0.0, 0.0, 9.81]
        v = v + 0.02 * (push - 0.2 * v)
        at = at + 0.02 * v
    return bag(folder, topics, messages)


def arm_bag(folder, scale=1.0):
    topics = {"/joint_states": "sensor_msgs/msg/JointState"}
    messages, q, w = [], np.zeros(2), np.zeros(2)
    for k in range(600):
        t, tau = START + k * 10**7, np.array([0.5 * np.sin(0.02 * k), 0.3 * np.cos(0.03 * k)])
        names = ["shoulder_joint", "elbow_joint"]
        messages.append(("/joint_states", t, joints(t, names, scale * q, w, tau)))
        w = w + DT * (tau - 0.2 * w) / np.array([0.3, 0.1])
        q = q + DT * w
    return bag(folder, topics, messages)


def commanded_arm_bag(folder, measured_torques=False):
    """Write a bag of a vertical arm: JointState in alphabetical order, commands without names."""
    rng, h = np.random.default_rng(0), 0.002
    topics = {
        "/joint_states": "sensor_msgs/msg/JointState",
        "/effort_controller/commands": "std_msgs/msg/Float64MultiArray",
    }
    q, w, goal, near, u = np.zeros((5, 2))
    layout, none = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), np.zeros(0)
    messages = []
    for k in range(10_000):
        t = START + k * 2 * 10**6
        measured = q + 5e-4 * rng.normal(size=2), w + 0.01 * rng.normal(size=2)
        if k % 500 == 0:
            goal = rng.uniform(-0.9, 1.1, 2)
        if k % 5 == 0:
            names = ["elbow_joint", "shoulder_joint"]
            both = [one[::-1] for one in measured]
            torques = (np.array(u) + 0.05 * rng.normal(size=2))[::-1] if measured_torques else none
            messages.append(("/joint_states", t, joints(t, names, *both, torques)))
        if k % 10 == 0:
            near = near + 0.05 * (goal - near)
            u = [16, 4] * (near - measured[0]) - [2.5, 0.35] * measured[1]
            message = T["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(u))
            messages.append(("/effort_controller/commands", t + 10**6, message))
        w = w + h * _arm_acceleration(q, w, u)
        q = q + h * w
    return bag(folder, topics, messages)


def _arm_acceleration(q, w, u):
    """Return accelerations of two links (0.35 and 0.3 m, 2 and 1.2 kg) with viscous friction."""
    h, own = 0.0546 * np.cos(q[1]), 0.0303
    turning = 0.0546 * np.sin(q[1])
    fall = 1.53 * np.sin(q[0] + q[1])
    mass = np.array([[0.2202 + own + 2 * h, own + h], [own + h, own]])
    push = turning * (2 * w[0] * w[1] + w[1] ** 2) - fall - 7.26 * np.sin(q[0]) - 0.35 * w[0]
    pull = -turning * w[0] ** 2 - fall - 0.12 * w[1]
    return np.linalg.solve(mass, u + np.array([push, pull]))


def crane_bag(folder, joint="trolley"):
    """A gantry crane driven by hand for 16 s; `joint`: its name."""
    swing, volt = "crane_msgs/msg/SwingState", "crane_msgs/msg/MotorVoltage"
    topics = {
        "/joint_states": "sensor_msgs/msg/JointState",
        "/sway/state": swing,
        "/motor/command": volt,
    }
    messages, x, v, th, w, u = [], 0.0, 0.0, 0.0, 0.0, 0.0
    rng = np.random.default_rng(1)
    for k in range(1600):
        t = START + k * 10**7
        if k % 4 == 0:
            u = float(np.round(4 * np.sin(0.011 * k) * np.cos(0.0037 * k) - 1.5 * x, 2))
            messages.append(("/motor/command", t, T[volt](header=header(t), voltage=u)))
        if k % 2 == 0:
            angle, rate = th + 1e-3 * rng.normal(), w + 8e-3 * rng.normal()
            messages.append(("/sway/state", t, T[swing](header=header(t), angle=angle, rate=rate)))
        q, qd = np.array([x + 2e-4 * rng.normal()]), np.array([v + 4e-3 * rng.normal()])
        messages.append(("/joint_states", t, joints(t, [joint], q, qd, np.zeros(0))))
        for _ in range(5):
            push = 5.4 * u - 4.0 * v - 3.0 * np.tanh(v / 0.02)
            swings = 2.0 * np.sin(th) * (0.85 * w**2 + 9.81 * np.cos(th))
            a = (push + swings) / (6.0 + 2.0 * np.sin(th) ** 2)
            x, v = x + DT / 5 * v, v + DT / 5 * a
            th, w = th + DT / 5 * w, w - DT / 5 * (a * np.cos(th) + 9.81 * np.sin(th)) / 0.85
    return bag(folder, topics, messages)
