"""A Model from an MJCF or URDF file, stepped by MuJoCo.

    from grounded.adapters import mujoco
    model = mujoco.model("arm.xml", params=("forearm.mass", "elbow.damping"))

| in the file            | in the model                                                           |
|------------------------|------------------------------------------------------------------------|
| hinge, slide `elbow`   | states `elbow`, `elbow_vel`; a hinge without limits is an angle        |
| ball joint `wrist`     | `wrist_rx _ry _rz`: rotation vector from the file's pose, in the       |
|                        | frame of that pose; `wrist_wx _wy _wz`: angular velocity, body frame   |
| free joint `torso`     | `torso_x _y _z`, `torso_rx ...`, `torso_vx ...`, `torso_wx ...`        |
| actuator activation    | `motor_act`                                                            |
| actuator `motor`       | input `motor` (`motor_ctrl` if a state has that name); in N m or N if  |
|                        | the control is the force itself: gear and gain 1                       |
| joint torque           | input `elbow_torque`, `slider_force`                                   |
| parameter "pole.mass"  | `pole_mass`; of a body without mass, that of a payload at its centre   |

Velocities are MuJoCo's qvel. A step depends only on the state: the constraint solver starts without
a warm start at every control step, so equal samples give bit-identical results, alone or in a
batch. A sample that MuJoCo finds unstable becomes NaN.
"""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.adapters.files import load, located
from grounded.adapters.mujoco_names import (
    BALL,
    FREE,
    SLIDE,
    Controls,
    Setting,
    controls_of,
    joint_name,
    kept_states,
    limits_of,
    ranges_of,
    setting_of,
    states_of,
    unmoved_joints,
)
from grounded.adapters.stepper import Stepper, model_of
from grounded.adapters.tangent import Coordinates
from grounded.checks import refused, wrong
from grounded.compile.run.interpreted import stencil
from grounded.engine import cores
from grounded.errors import needs
from grounded.frozen import Array
from grounded.model import Model

SHIFT = 1e-6  # relative step of the forward differences, as in mjd_transitionFD
CHUNK = 4096  # samples stepped in one call
EXACT = 1e-6  # relative tolerance for a control step that is a multiple of the simulation's step
# relative change of the simulation's step that may be made to fit the control step
TIMESTEP_FIT = 1e-3
MOST_THREADS, SHARED = 8, 64  # most threads; samples from which on threads are used
MOST_COPIES = 20  # most copies of the model with other parameters at a time
PRIVATE = ("_lock", "_data", "_base", "_copies", "_pools")  # attributes private to a process
HUGE = 1e9  # MuJoCo treats 1e10 as unstable: it warns and stops


def model(
    xml: Any,
    *,
    params: Sequence[str] | Mapping[str, float | tuple[float, ...]] = (),
    inputs: str | Sequence[str] = "auto",
    without: str | Sequence[str] = (),
    timestep: float | None = None,
    name: str = "",
) -> Model:
    """Return the Model of an MJCF or URDF file.

    Args:
        xml: path of the file, MJCF text, or an MjModel. In a model.py, a relative path is looked up
            beside that file, then in the current folder.
        params: parameters that can be set, fitted or diagnosed, as "element.field": `mass` of a
            body (its inertia scales with it); `damping`, `frictionloss`, `armature`, `stiffness` of
            a joint; `gear`, `kp`, `kv`, `gain`, `tau` of an actuator; `friction` of a geom. In a
            sequence of names, all are uncertain with a lower bound of zero. In a mapping, a number
            is a constant, (low, high) are the bounds of an uncertain parameter, and
            (value, low, high) also sets its value. Other values are taken from the file.
        inputs: "actuators", "torques" (generalised forces on all hinges and slides), the names of
            joints driven by a torque, or "auto": actuators if there are any, else torques.
        without: joints that stay where the file's pose has them and are no states; "unmoved": those
            that no actuator can move, such as a goal marker's, as nothing connects them to
            one and their geoms touch nothing. Without actuators, torques drive all joints.
        timestep: simulation step [s] in place of the file's; dt must be a whole multiple of it to
            within 0.1 %, and the rest is distributed over its steps.
        name: name of the model; by default the file's.

    Raises:
        GroundedError: if mujoco is not installed or can't load the file, for unknown names, and for
            simulator state beyond qpos, qvel and act (plugins).

    Delays of actuators are no part of the model: `model.step.latency` has them for [task] latency.
    """
    mj = needs("mujoco")
    compiled = load(xml)
    if timestep is not None:
        compiled.opt.timestep = timestep
    coordinates = _coordinates(compiled)
    every = states_of(compiled)
    controls = controls_of(compiled, inputs, every)
    left_out = unmoved_joints(compiled) if isinstance(without, str) else tuple(without)
    kept = kept_states(compiled, left_out)
    states = {name: unit for (name, unit), keep in zip(every.items(), kept, strict=True) if keep}
    named = params if isinstance(params, Mapping) else dict.fromkeys(params, None)
    settings = [setting_of(mj, compiled, spec) for spec in named]
    values = {s.name: s.param(given) for s, given in zip(settings, named.values(), strict=True)}
    stepper = MujocoStepper(compiled, coordinates, states, kept, controls, settings)
    stepper.without = left_out
    on_disk = isinstance(xml, Path) or (isinstance(xml, str) and not xml.lstrip().startswith("<"))
    stepper.source = located(xml).resolve() if on_disk else None
    free = [
        joint_name(compiled, j)
        for j in range(compiled.njnt)
        if compiled.jnt_type[j] > SLIDE and not compiled.jnt_limited[j]
    ]
    angles = [name for name in free if name in states]
    return model_of(
        stepper,
        states=states,
        inputs=dict(zip(stepper.inputs, controls.units, strict=True)),
        params=values,
        angles=tuple(angles),
        name=name or compiled.names.split(b"\0", 1)[0].decode() or "mujoco",
    )


def limits(xml: str | Path, inputs: str | Sequence[str] = "auto") -> dict[str, tuple[float, float]]:
    """Return the limits of the inputs for [limits]: ctrlrange, or a joint's actuatorfrcrange.

    Args:
        xml: path of the file, or MJCF text.
        inputs: as for `model`.

    Returns:
        (low, high) by name of every input that has limits.
    """
    compiled = load(xml)
    return limits_of(compiled, controls_of(compiled, inputs, states_of(compiled)))


class MujocoStepper(Stepper):
    """Computes control steps of MuJoCo for many samples at a time."""

    source: Path | None = None  # the file that it was loaded from
    without: tuple[str, ...] = ()  # joints of the file that are no states
    differenced = True  # its derivatives are differences of `advance`

    def __init__(
        self,
        compiled: Any,
        coordinates: Coordinates,
        states: Iterable[str],
        kept: NDArray[np.bool_],  # of the file's states, those of the model
        controls: Controls,
        settings: Sequence[Setting],
    ) -> None:
        super().__init__(states, controls.names, [s.name for s in settings])
        mj = needs("mujoco")
        self._kept = np.flatnonzero(kept)
        pose = coordinates.from_qpos(coordinates.reference[None], np.zeros((1, compiled.nv)))[0]
        self._still = np.append(pose, np.zeros(compiled.nv + compiled.na))
        self.coordinates, self.controls, self.settings = coordinates, controls, tuple(settings)
        self.threads = min(cores(), MOST_THREADS)
        self._model = copy.deepcopy(compiled)
        late = getattr(self._model, "actuator_delay", np.zeros(compiled.nu))
        self.latency = dict[str, float]()  # [s] of the inputs that the file delays
        if not controls.torques:
            each = zip(controls.names, late[list(controls.columns)].tolist(), strict=True)
            self.latency = {name: by for name, by in each if by > 0}
        late[:] = 0.0
        self._own = float(compiled.opt.timestep)
        self._model.opt.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET.value
        both = (*self.states, *self.inputs)
        spans = [self.limits.get(name, (-np.inf, np.inf)) for name in both]
        self._spans = np.array(spans).T  # (2, n + m), the lowest and the highest
        self._prepare()

    @property
    def timestep(self) -> float:
        """The simulation's step [s]; a control step is a whole multiple of it."""
        return self._own

    def compiled(self, p: Array) -> Any:
        """Return a copy of the model with parameters p (k,)."""
        found = copy.deepcopy(self._model)
        self._write(found, p)
        return found

    def _prepare(self) -> None:
        mj, compiled = needs("mujoco"), self._model
        self._lock = threading.Lock()
        self._data = [mj.MjData(compiled) for _ in range(self.threads)]
        self._copies: dict[bytes, Any] = {}
        self._pools: dict[tuple[int, int], Any] = {}
        whole = mj.mjtState.mjSTATE_FULLPHYSICS.value
        self._base = np.zeros(mj.mj_stateSize(compiled, whole))
        mj.mj_getState(compiled, self._data[0], self._base, whole)
        late = getattr(mj.mjtState, "mjSTATE_HISTORY", None)  # of delays, which are taken off
        past = 0 if late is None else mj.mj_stateSize(compiled, late.value)
        if len(self._base) != 1 + compiled.nq + compiled.nv + compiled.na + past:
            sizes = {"theirs": str(len(self._base)), "own": "that of qpos, qvel and act"}
            raise refused("given.fit", "MuJoCo model", what="state", **sizes)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in PRIVATE}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """See `limits`."""
        return limits_of(self._model, self.controls)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges (low, high) by name, of hinges and slides that the file limits."""
        found = ranges_of(self._model)
        return {name: span for name, span in found.items() if name in self.states}

    @property
    def masses(self) -> dict[str, float]:
        """Masses [kg] by the names of the file's bodies."""
        bodies = map(self._model.body, range(1, self._model.nbody))
        return {body.name: float(body.mass[0]) for body in bodies if body.name}

    @property
    def body(self) -> MujocoBody:
        """The body to draw in pictures."""
        return MujocoBody(self)

    def whole(self, x: Array) -> Array:
        """Return all states of the file, (N, nv + nv + na), for those of the model, (N, n)."""
        whole = np.tile(self._still, (len(x), 1))
        whole[:, self._kept] = x
        return whole

    def advance(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """Return the next states (N, n); NaN for unstable samples."""
        return self._advanced(x, u, p[None], np.zeros(len(x), int), dt)

    def rows(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """Return the next states (N, n) of samples with their own parameters p (N, k)."""
        each, which = np.unique(p, axis=0, return_inverse=True)
        return self._advanced(x, u, each, which.reshape(-1), dt)

    def _advanced(
        self, x: Array, u: Array, each: Array, which: NDArray[np.intp], dt: float
    ) -> Array:
        """Step samples, each with one of several sets of parameters.

        Each set gets a copy of the model, and all of them are stepped in few batches.
        """
        (steps, h), after = self._substeps(dt), np.empty_like(x)
        with self._lock, _quiet():
            for first in range(0, len(each), MOST_COPIES):
                copies = [self._copy(one) for one in each[first : first + MOST_COPIES]]
                for model in copies:
                    model.opt.timestep = h
                own = np.flatnonzero((which >= first) & (which < first + MOST_COPIES))
                for at in range(0, len(own), CHUNK):
                    some = own[at : at + CHUNK]
                    models = (
                        copies[0] if len(copies) == 1 else [copies[which[i] - first] for i in some]
                    )
                    after[some] = self._step(x[some], u[some], steps, models)
        return after

    def _copy(self, p: Array) -> Any:
        """Return the model with parameters p (k,); the most recent copies are cached."""
        found = self._copies.pop(p.tobytes(), None)
        if found is None:
            found = self.compiled(p)
        self._copies[p.tobytes()] = found
        for old in list(self._copies)[: -2 * MOST_COPIES]:
            del self._copies[old]
        return found

    def derivatives(self, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
        """Return f_x and f_u by forward differences: n + m + 1 steps per sample, in one batch.

        At the upper end of a control's range, where MuJoCo clamps, they are taken backwards.
        """
        (N, n), d = x.shape, x.shape[1] + u.shape[1]
        both = np.hstack([x, u])
        down, up = stencil(both, SHIFT * np.maximum(1.0, np.abs(both)), *self._spans)
        points = np.tile(both, (d + 1, 1, 1))
        i = np.arange(d)
        points[i + 1, :, i] = np.where(2 * (up - both) < both - down, down, up).T
        width = points[i + 1, :, i] - points[0, :, i]  # the difference after rounding (d, N)
        flat = points.reshape(-1, d)
        y = self.advance(flat[:, :n], flat[:, n:], p, dt).reshape(d + 1, N, n)
        J = ((y[1:] - y[0]) / width[:, :, None]).transpose(1, 2, 0)
        return np.ascontiguousarray(J[:, :, :n]), np.ascontiguousarray(J[:, :, n:])

    def inverse(self, x: Array, after: Array, p: Array, dt: float) -> Array | None:
        """Return the inputs (N, m) of MuJoCo's inverse dynamics, inside their limits.

        They give the mean acceleration of the control step at its start; between the torques that
        are asked for and the inputs is a linear map, which is read off two evaluations. None for
        actuators with a state, and where torques do not follow their controls linearly.
        """
        if self._model.na:
            return None
        nv, mj = self._model.nv, needs("mujoco")
        x, after = self.whole(x), self.whole(after)
        rate = (after[:, nv:] - x[:, nv:]) / dt
        found = np.empty((len(x), len(self.inputs)))
        with self._lock, _quiet():
            model, data = self._copy(p), mj.MjData(self._model)
            for k, qpos in enumerate(self.coordinates.to_qpos(x[:, :nv])):
                data.qpos[:], data.qvel[:], data.qacc[:] = qpos, x[k, nv:], rate[k]
                mj.mj_inverse(model, data)
                asked = data.qfrc_inverse.copy()
                u = self._controls_for(model, data, asked)
                if u is None:
                    return None
                found[k] = u
        return found

    def _controls_for(self, model: Any, data: Any, asked: Array) -> Array | None:
        """Return controls (m,) for the torques nearest to those asked (nv,); None if not linear."""
        columns = list(self.controls.columns)
        if self.controls.torques:
            return np.array(np.clip(asked[columns], *self._spans[:, -len(columns) :]))
        mj = needs("mujoco")

        def torques(u: Array) -> Array:
            data.ctrl[columns] = u
            mj.mj_fwdActuation(model, data)
            return np.array(data.qfrc_actuator)

        m = len(columns)
        own = torques(np.zeros(m))
        sent = self._spans[:, -m:]
        unit = np.where(np.isfinite(sent[1]) & (sent[1] > 0), sent[1], 1.0)
        by = np.column_stack([torques(row) - own for row in np.diag(unit)]) / unit
        u = np.linalg.lstsq(by, asked - own, rcond=None)[0]
        inside = np.array(np.clip(u, *sent))
        linear = np.allclose(torques(inside), own + by @ inside, rtol=1e-3, atol=1e-9)
        return inside if linear else None

    def _substeps(self, dt: float) -> tuple[int, float]:
        """Return number and length [s] of a control step's steps, fitted to time stamps."""
        h = self._own  # a control step is a whole multiple of it
        steps = round(dt / h)
        off = abs(steps * h - dt)
        if steps < 1 or off > TIMESTEP_FIT * dt:
            like = f"{dt / max(1, steps):.12g}"
            raise wrong("timestep", h, must="divisor", like=like, of=f"{dt:g} s")
        return steps, h if off <= EXACT * dt else dt / steps

    def _write(self, model: Any, p: Array) -> None:
        for setting, value in zip(self.settings, p, strict=True):
            setting.write(model, float(value))
        needs("mujoco").mj_setConst(model, self._data[0])

    def _pool(self, threads: int) -> Any:
        """Return MuJoCo's thread pool, cached: creating one takes as long as a batch."""
        key = (os.getpid(), threads)  # a forked process does not inherit threads
        if key not in self._pools:
            pool = needs("mujoco.rollout").Rollout
            self._pools[key] = pool(nthread=threads if threads > 1 else 0)
        return self._pools[key]

    def _step(self, x: Array, u: Array, steps: int, models: Any) -> Array:
        """Run simulation steps; `models` is one model, or a list with one for each sample."""
        mj, compiled, nv = needs("mujoco"), self._model, self._model.nv
        x = self.whole(x)
        given = np.hstack([x, u])
        wild = ~(np.abs(given) < HUGE).all(axis=1, keepdims=True)
        x, u = np.where(wild, 0.0, x), np.where(wild, 0.0, u)
        state = np.tile(self._base, (len(x), 1))
        ends = np.cumsum([1, compiled.nq, nv + compiled.na])
        state[:, 1 : ends[1]] = self.coordinates.to_qpos(x[:, :nv])
        state[:, ends[1] : ends[2]] = x[:, nv:]
        wide = np.zeros((len(x), 1, nv if self.controls.torques else compiled.nu))
        wide[:, 0, list(self.controls.columns)] = u
        kind = (
            mj.mjtState.mjSTATE_QFRC_APPLIED if self.controls.torques else mj.mjtState.mjSTATE_CTRL
        )
        threads = self.threads if len(x) >= SHARED else 1
        rolled, _ = self._pool(threads).rollout(
            models, self._data[:threads], state, wide, control_spec=kind, nstep=steps
        )
        last = rolled[:, -1]
        pose = self.coordinates.from_qpos(last[:, 1 : ends[1]], x[:, :nv])
        moved = np.hstack([pose, last[:, ends[1] : ends[2]]])
        h = (models[0] if isinstance(models, list) else models).opt.timestep
        stopped = last[:, :1] < (steps - 0.5) * h  # MuJoCo stopped an unstable sample
        wild = wild | stopped | ~(np.abs(moved) < HUGE).all(axis=1, keepdims=True)
        return np.where(wild, np.nan, moved)[:, self._kept]


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress MuJoCo's warnings, which would write MUJOCO_LOG.TXT to the current folder."""
    mj = needs("mujoco")
    heard = mj.get_mju_user_warning()
    mj.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mj.set_mju_user_warning(heard)


def _coordinates(compiled: Any) -> Coordinates:
    plain: list[int] = []
    columns: list[int] = []
    quaternions: list[int] = []
    rotations: list[int] = []
    for j in range(compiled.njnt):
        place, column = int(compiled.jnt_qposadr[j]), int(compiled.jnt_dofadr[j])
        kind = compiled.jnt_type[j]
        straight = {FREE: 3, BALL: 0}.get(int(kind), 1)
        plain += range(place, place + straight)
        columns += range(column, column + straight)
        if kind in (FREE, BALL):
            quaternions.append(place + straight)
            rotations.append(column + straight)
    return Coordinates(
        np.array(plain, dtype=np.int64),
        np.array(columns, dtype=np.int64),
        tuple(quaternions),
        tuple(rotations),
        np.array(compiled.qpos0),
    )


class MujocoBody:
    """The body of a model, drawn in recordings: its joints, moved by MuJoCo's kinematics."""

    unit = "m"

    def __init__(self, stepper: MujocoStepper) -> None:
        mj = needs("mujoco")
        self._stepper, self._model = stepper, copy.deepcopy(stepper._model)
        self._data, self._kinematics = mj.MjData(self._model), mj.mj_kinematics
        self._parents = np.array(self._model.body_parentid)
        massive = np.flatnonzero(self._model.body_mass > 0)
        self._watched = int(massive.max(initial=0))

    def sticks(self, states: Array) -> Array:
        """Return lines from each body's frame to its parent's, and to its centre of mass.

        Args:
            states: (T, n).

        Returns:
            Ends of the lines (T, S, 2, 3); NaN where a joint is unknown.
        """
        origins, centres = self._places(states)
        inner = np.flatnonzero(self._parents > 0)  # what hangs on the world has no line to it
        bones = np.stack([origins[:, self._parents[inner]], origins[:, inner]], axis=2)
        return np.hstack([bones, np.stack([origins, centres], axis=2)[:, 1:]])

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the last body's centre of mass; NaN if a joint is unknown."""
        return self._places(states)[1][:, self._watched]

    def _places(self, states: Array) -> tuple[Array, Array]:
        """Return the origins and the centres of mass of all bodies, (T, bodies, 3) each."""
        origins = np.full((len(states), self._model.nbody, 3), np.nan)
        centres = origins.copy()
        positions = self._stepper.whole(np.asarray(states, float))[:, : self._model.nv]
        for t in np.flatnonzero(np.isfinite(positions).all(axis=1)):
            self._data.qpos[:] = self._stepper.coordinates.to_qpos(positions[t : t + 1])[0]
            self._kinematics(self._model, self._data)
            origins[t], centres[t] = self._data.xpos, self._data.xipos
        return origins, centres
