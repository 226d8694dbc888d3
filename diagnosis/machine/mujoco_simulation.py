"""A MuJoCo model with other values, simulated over records from the start that fits them.

A free run of an arm in a closed loop drifts away: its controller is not part of the model. The simulated
joints are therefore held near the measured ones by a soft spring and damper of their own (`tracking_rad_s`).
The start of a record is fitted, for every set of values anew, within what its first rows leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import CubicSpline

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import (
    DEAD_ZONE,
    ELASTIC,
    PLAIN,
    put_component,
    put_gain,
)
from diagnosis.machine.mujoco_forces import JointForces, sensed_under
from diagnosis.machine.mujoco_model import MujocoModel
from diagnosis.machine.own_plant import PlantExperiment
from diagnosis.machine.plant_effect import PlantEffect

Kept = TypeVar("Kept")

# Share by which forces change to see the motion that they make.
_FORCED = 0.05
_KEPT, _KEPT_PATHS = 8, 60
# By how much slopes of the stated model may miss what a start does in another one; starts that are simulated.
_OF_SLOPES, _RESTARTS = 0.3, 2
# Samples of a parabola whose begin is a start; it is off by more than noise from so many deviations on.
_SMOOTHED_FROM, _AS_NOISE = (4, 5, 7, 9, 12, 16, 21, 28), 2.0
# When in a step, in steps from its begin, a force meets the position and the speed that the model then has:
# Euler holds the speed of the step before, implicit ones solve for that of the next, RK4 takes means.
_MET = {
    int(mujoco.mjtIntegrator.mjINT_EULER): (0.0, -0.5),
    int(mujoco.mjtIntegrator.mjINT_RK4): (0.5, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT): (0.0, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): (0.0, 0.5),
}


@dataclass(frozen=True, eq=False)
class MujocoSimulation:
    """parameters, effects, inputs (T, U + Y) -> outputs (T, Y). settles : they are meant for `settled`;
    else every record starts as its first samples say."""

    arm: MujocoModel
    quantities: Mapping[str, PlantEffect]
    noise: Real
    settles: bool = True
    _models: dict[Any, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    _paths: dict[Any, tuple[Real, Real]] = field(default_factory=dict, repr=False)
    _starts: dict[Any, _Start] = field(default_factory=dict, repr=False)

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value that the model has, of what may be wrong."""
        return {name: one.stated for name, one in self.quantities.items() if one.stated != 0.0}

    @property
    def tolerances(self) -> dict[str, float]:
        """Parameter -> relative standard deviation, of those for which the file has a number."""
        stated = {one.name: float(one.data[0]) for one in self.arm.spec.numerics}
        names = {name: f"tolerance.{name}" for name in self.parameters}
        return {name: stated[number] for name, number in names.items() if number in stated}

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        """Quantities that the model has none of."""
        return tuple(one for one in self.quantities.values() if one.stated == 0.0)

    @property
    def inputs(self) -> tuple[str, ...]:
        """(U,) names of the actuators; in its inputs the outputs as measured follow them."""
        return self.arm.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """(Y,) names of sensors and joints."""
        return self.arm.outputs

    @property
    def units(self) -> dict[str, str]:
        """Output -> unit."""
        return self.arm.units

    def edited(self, values: Mapping[str, Any], of: Any = None) -> Any:
        """The model (MjSpec) with these values; of: as a whole, else what moves of it."""
        spec = (of or self.arm.moving).copy()
        for name, value in values.items():
            self.quantities[name].law.change(spec, *np.ravel(value).tolist())
        return spec

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        values: dict[str, Any] = {**parameters}
        values |= {name: tuple(size.values()) for name, size in effects.items()}
        changed = {k: v for k, v in values.items() if v != self.quantities[k].stated}
        model, start = self._model(changed), self._start(inputs)
        found = self._run(model, inputs, start.state if self.settles else start.guess)
        measured = inputs[:, len(self.arm.inputs) :]
        if not (self.settles and np.all(np.isfinite(found))):
            return found
        # Commands before a record, of which a lag or delay that the model lacks still feels something.
        before = inputs[0, : len(self.arm.inputs)].copy()
        if late := self._late(model[0]):
            spread = np.array([np.std(inputs[:, u]) or 1.0 for u in late])
            moved_by = [
                before + size * (np.arange(before.size) == u) for u, size in zip(late, spread, strict=True)
            ]
            runs = [self._run(model, inputs, start.state, one) for one in moved_by]
            slopes = np.array([(run - found) / size for run, size in zip(runs, spread, strict=True)])
            own = start.beside(spread, slopes).shift(measured - found)[start.state.size :]
            before[late] += own
            found = found + np.tensordot(own, slopes, 1)
        # What `settled` adds is of the stated model: simulated where it may miss most of what is left.
        moved = np.zeros(start.state.size)
        for _ in range(_RESTARTS):
            shift = start.shift(measured - found)
            left = _rms(measured - found - start.adds(shift))
            missed = _OF_SLOPES * _rms(start.adds(shift - moved)) / np.hypot(left, self.noise)
            weight = float(np.clip(np.max(missed) - 1, 0.0, 1.0))
            if weight == 0:
                break
            again = self._run(model, inputs, start.state + shift, before) - start.adds(shift)
            found, moved = found + weight * (again - found), moved + weight * (shift - moved)
        return found

    def forced(self, parameters: Mapping[str, float], inputs: Real, forces: Real) -> Real:
        """Outputs of the model under forces on the tracked joints, from the start that fits the record.

        Parameters
        ----------
        parameters : name -> value
            As of a call; those that are as stated change nothing.
        inputs : (T, U + Y)
            Commands, then outputs as measured.
        forces : (T, J)
            On the J tracked joints, held over each sample [N m of a hinge, N of a slide].

        Returns
        -------
        (T, Y) outputs; the start is not fitted anew.
        """
        changed = {k: v for k, v in parameters.items() if v != self.quantities[k].stated}
        return self._run(self._model(changed), inputs, self._start(inputs).state, forces=forces)

    def stick_figure(self, outputs: Real) -> Real | None:
        """(F, Y) -> (F, L, 2, 3) [m] ends of lines: from body to body, of a last one to its
        first site, else to its centre of mass. None where a joint is not measured."""
        model, data = self.arm.nominal, mujoco.MjData(self.arm.nominal)
        if len(self.arm.tracked) < model.njnt:
            return None
        mujoco.mj_resetData(model, data)
        bodies = [k for k in range(1, model.nbody) if model.body_weldid[k]]
        sites = {int(model.site_bodyid[s]): s for s in reversed(range(model.nsite))}
        found = []
        for row in outputs:
            for k, joint, _ in self.arm.tracked:
                data.joint(joint).qpos[0] = row[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            lines = []
            for k in bodies:
                lines.append((data.xpos[model.body_parentid[k]].copy(), data.xpos[k].copy()))
                if k not in model.body_parentid:
                    end = data.site_xpos[sites[k]] if k in sites else data.xipos[k]
                    lines.append((data.xpos[k].copy(), end.copy()))
            found.append(lines)
        return np.array(found)

    def _model(self, changed: Mapping[str, Any]) -> tuple[Any, Any]:
        return _remembered(
            self._models, tuple(changed.items()), lambda: self._compiled(self.edited(changed)), _KEPT
        )

    def _compiled(self, spec: Any) -> tuple[Any, Any]:
        omega = self.arm.tracking_rad_s
        for _, joint, inertia in self.arm.tracked:
            one = spec.add_actuator(PLAIN.default, name=f"tracking {joint}", target=joint)
            one.trntype, one.gear = mujoco.mjtTrn.mjTRN_JOINT, np.eye(6)[0]
            one.gaintype, one.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
            one.gainprm[0] = 1.0
            one.biasprm[1], one.biasprm[2] = -inertia * omega**2, -2 * inertia * omega
        model = spec.compile()
        return model, mujoco.MjData(model)

    def _late(self, model: Any) -> list[int]:
        """Actuators with a lag or delay that the stated model does not have."""
        stated = self.arm.nominal
        pairs = [(one.actuator_actadr >= 0, one.actuator_history[:, 0] > 0) for one in (model, stated)]
        return [
            u
            for u in range(len(self.arm.inputs))
            if any(now[u] > then[u] for now, then in zip(*pairs, strict=True))
        ]

    def _run(
        self,
        compiled: tuple[Any, Any],
        inputs: Real,
        start: Real,
        before: Real | None = None,
        forces: Real | None = None,
    ) -> Real:
        """start: (S,), see `_Start`. before: (U,) commands before the first row; None: as in that. forces:
        (T, J) on the tracked joints beside what holds them near the record [N m or N]; None: none."""
        arm, (model, data) = self.arm, compiled
        before = inputs[0, : len(arm.inputs)] if before is None else before
        U, T = len(arm.inputs), len(inputs)
        h = model.opt.timestep
        steps = round(arm.dt_s / h)
        dead = np.array([_number(model, f"{name}.{DEAD_ZONE}", 0.0)[0] for name in arm.inputs])
        commands, before = (u - np.clip(u, -dead, dead) for u in (inputs[:, :U], before))
        control = np.zeros((T * steps, model.nu))
        control[:, :U] = np.repeat(commands, steps, axis=0)
        self._put(model, data, start, before)
        gain, offset = self._readings(model)
        omega = arm.tracking_rad_s
        for j, (k, _, inertia) in enumerate(arm.tracked if omega else ()):
            late = float(model.sensor_delay[model.sensor(arm.outputs[k]).id])
            path, speed = self._path(inputs[:, U + k], h, late, model.opt.integrator)
            control[:, U + j] = inertia / gain[k] * (omega**2 * (path - offset[k]) + 2 * omega * speed)
        for u in range(U):
            n = model.actuator_history[u, 0]
            if n:
                mujoco.mj_initCtrlHistory(model, data, u, None, np.full((n, 1), before[u]))
        if forces is not None:
            control[:, U : U + forces.shape[1]] += np.repeat(forces, steps, axis=0)
        if model.nhistory:
            mujoco.mj_forward(model, data)
            for s in range(model.nsensor):
                n = model.sensor_history[s, 0]
                if n:
                    first = data.sensordata[model.sensor_adr[s]]
                    mujoco.mj_initSensorHistory(model, data, s, None, np.full((n, 1), first), 0.0)
        _wind(model, data, control[0])
        columns = [model.sensor(name).adr[0] for name in arm.outputs]
        return np.asarray(_sensed(model, data, control)[::steps, columns] * gain + offset)

    def _put(self, model: Any, data: Any, start: Real, before: Real) -> None:
        """A start (S,), see `_Start`, and the commands (U,) before it."""
        mujoco.mj_resetData(model, data)
        (gain, offset), arm = self._readings(model), self.arm
        for j, (k, joint, _) in enumerate(arm.tracked):
            data.joint(joint).qpos[0] = (start[j] - offset[k]) / gain[k]
            data.joint(joint).qvel[0] = start[len(arm.tracked) + j] / gain[k]
        start_filters(model, data, before)
        data.act[model.actuator_actadr[list(arm.filtered)]] = start[2 * len(arm.tracked) :]

    def began(self, model: Any, inputs: Real) -> Any:
        """MjData of a compiled model as a record begins: joints as its first samples say."""
        data = mujoco.MjData(model)
        self._put(model, data, self._start(inputs).guess, inputs[0, : len(self.arm.inputs)])
        return data

    def _readings(self, model: Any) -> tuple[Real, Real]:
        """Gain and offset of every sensor (Y,)."""
        of = {
            key: np.array([_number(model, f"{name}.{key}", usual)[0] for name in self.arm.outputs])
            for key, usual in (("gain", 1.0), ("offset", 0.0))
        }
        return of["gain"], of["offset"]

    def _path(self, y: Real, step_s: float, late_s: float, integrator: int) -> tuple[Real, Real]:
        """What was measured, and its slope, as the tracking meets them in every step (`_MET`), read `late_s`
        later."""

        def compute() -> tuple[Real, Real]:
            dt_s = self.arm.dt_s
            path = CubicSpline(dt_s * np.arange(len(y)), y)
            at = step_s * np.arange(len(y) * round(dt_s / step_s)) + late_s
            of_path, of_slope = (np.clip(at + part * step_s, 0.0, path.x[-1]) for part in _MET[integrator])
            return np.asarray(path(of_path)), np.asarray(path(of_slope, 1))

        return _remembered(self._paths, (y.tobytes(), late_s), compute)

    def _start(self, inputs: Real) -> _Start:
        """Of a record: from its first samples, moved once by what the stated model leaves from there;
        one that asks for more than rest and they leave open is wrong about something else."""

        def compute() -> _Start:
            arm, U = self.arm, len(self.arm.inputs)
            late = 0.0 if _MET[arm.nominal.opt.integrator] == (0.5, 0.5) else 0.5 * arm.nominal.opt.timestep
            begun = [_begun(inputs[:, U + k], arm.dt_s, self.noise[k], late) for k, *_ in arm.tracked]
            guess, spread = np.array(begun).reshape(-1, 2, 2).transpose(2, 1, 0).reshape(2, -1)
            for u in arm.filtered:
                guess, spread = np.append(guess, inputs[0, u]), np.append(spread, np.std(inputs[:, u]) or 1.0)
            model = self._model({})
            first = self._run(model, inputs, guess)
            runs = [self._run(model, inputs, state) for state in guess + np.diag(spread)]
            slopes = [(run - first) / size for run, size in zip(runs, spread, strict=True)]
            start = _Start(guess, guess, spread, np.array(slopes).reshape(-1, *first.shape), self.noise)
            move = start.shift(inputs[:, U:] - first)
            rests = not np.any(guess[len(arm.tracked) : 2 * len(arm.tracked)])
            return start if rests and np.any(np.abs(move) > spread) else replace(start, state=guess + move)

        return _remembered(self._starts, inputs.tobytes(), compute)

    def settled(self, inputs: Real, outputs: Real) -> Real:
        """Outputs (T, Y) as they are from the start that fits the record best; to first order in its move."""
        start = self._start(inputs)
        if not start.state.size:
            return outputs
        return np.asarray(outputs + start.adds(start.shift(inputs[:, len(self.arm.inputs) :] - outputs)))

    def commanded(self, stated: Mapping[str, float], experiments: Sequence[PlantExperiment]) -> float:
        """Share of the motion that the forces of the actuators make beside the tracking; 1 in a free run of
        motors.

        Of a motor it is what its commands make. A servo makes the motion of its command whatever the machine
        is: its force, without the damping of its own, makes what it strays from that. Of an actuator whose
        gain is no quantity: its command.
        """
        spec, free = self.edited({}), list[int]()
        for u, one in enumerate(list(spec.actuators)):
            if f"{one.name}.gain" in stated:
                own = one.biasprm[2]
                put_gain(one.name, spec, 1 + _FORCED)
                if one.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
                    put_component(one, "biasprm", 2, own)
            else:
                free.append(u)
        forced = self._compiled(spec)
        made = moved = 0.0
        for e in experiments:
            more = e.input.copy()
            more[:, free] += _FORCED * (more[:, free] - np.mean(more[:, free], axis=0))
            start = self._start(e.input).state
            by_forces = self._run(forced, more, start)
            by_forces -= self._run(self._model({}), e.input, start)
            made += float(np.sum(np.var(by_forces / _FORCED, axis=0) / np.var(e.output, axis=0)))
            moved += len(self.arm.outputs)
        return float(min(np.sqrt(made / moved), 1.0))


@dataclass(frozen=True, eq=False)
class _Start:
    """Of a record (S,): positions, then speeds, of the tracked joints as their sensors tell them; what
    filters of actuators hold.

    guess, spread : of the first samples alone. slopes : (S, T, Y) of the outputs by the state.
    """

    state: Real
    guess: Real
    spread: Real
    slopes: Real
    noise: Real

    def beside(self, spread: Real, slopes: Real) -> _Start:
        """With further states (L,) that are zero as far as anybody knows, slopes (L, T, Y)."""
        nothing = np.zeros(spread.size)
        return replace(
            self,
            state=np.append(self.state, nothing),
            guess=np.append(self.guess, nothing),
            spread=np.append(self.spread, spread),
            slopes=np.concatenate([self.slopes, slopes]),
        )

    def adds(self, shift: Real) -> Real:
        """(T, Y) of the outputs by a move of the start, in the stated model and to first order."""
        return np.asarray(np.tensordot(shift, self.slopes, 1))

    def shift(self, left: Real) -> Real:
        """(S,) by which the start moves that fits best where measured - model is left (T, Y)."""
        level = np.maximum(_rms(left), self.noise)
        A = (self.slopes / level).reshape(len(self.state), left.size)
        H = A @ A.T + np.diag(self.spread**-2.0)
        return np.asarray(
            np.linalg.solve(H, A @ (left / level).ravel() + (self.guess - self.state) / self.spread**2)
        )


def _number(model: Any, name: str, *without: float) -> Real:
    """A <numeric> of a compiled model."""
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return np.array(without) if k < 0 else np.asarray(model.numeric(k).data)


def _wind(model: Any, data: Any, command: Real) -> None:
    """Springs of drives so far that motor and link speed up together."""
    springs = [one for k in range(model.njnt) if (one := model.joint(k)).name.endswith(f" {ELASTIC}")]
    if not springs:
        return
    dofs, at = (np.array([getattr(one, key)[0] for one in springs]) for key in ("dofadr", "qposadr"))
    data.ctrl[:] = command
    mujoco.mj_forward(model, data)
    by_force = np.zeros((dofs.size, model.nv))
    mujoco.mj_solveM(model, data, by_force, np.eye(model.nv)[dofs])
    force = np.linalg.solve(by_force[:, dofs], data.qacc[dofs])
    data.qpos[at] = force / model.jnt_stiffness[[one.id for one in springs]]


def _sensed(model: Any, data: Any, control: Real) -> Real:
    """(N, U) commands of steps -> (N, S) what sensors read at their beginning."""
    joints = JointForces.of_model(model)
    if joints:
        return sensed_under(joints, model, data, control)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return np.asarray(rollout.rollout(model, data, state[None], control[None])[1][0])


def _rms(signals: Real) -> Real:
    """(T, Y) -> (Y,)"""
    return np.asarray(np.sqrt(np.mean(signals**2, axis=0)))


def _remembered(
    kept: dict[Any, Kept], key: Any, compute: Callable[[], Kept], most: int = _KEPT_PATHS
) -> Kept:
    if key not in kept:
        if len(kept) >= most:
            kept.pop(next(iter(kept)))
        kept[key] = compute()
    return kept[key]


def start_filters(model: Any, data: Any, commands: Real) -> None:
    """As if the commands had been held for long; what integrates them starts at zero."""
    for u, late in enumerate(model.actuator_actadr[: len(commands)] >= 0):
        if late and model.actuator_dyntype[u] != int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
            data.act[model.actuator_actadr[u]] = commands[u]


def _begun(q: Real, dt_s: float, noise: float, early_s: float) -> list[tuple[float, float]]:
    """Position in the first row and speed a little earlier, each with what it may be off by: of the longest
    parabola that leaves no more than noise of the first samples, and what its force may change in a row."""
    for n in (n for n in _SMOOTHED_FROM if n <= len(q)):
        time_s = dt_s * np.arange(n)
        fit, covariance = np.polyfit(time_s, q[:n], 2, cov="unscaled")
        left = float(np.sqrt(np.sum((q[:n] - np.polyval(fit, time_s)) ** 2) / (n - 3)))
        if n > _SMOOTHED_FROM[0] and left > _AS_NOISE * noise:
            break
        level = max(left, noise)
        off = _AS_NOISE * level * np.sqrt(np.diag(covariance))
        speed, uncertain = fit[1] - 2 * fit[0] * early_s, off[1] + abs(2 * fit[0]) * dt_s
        # What may have begun to move within a row has: a log that begins with its step is the usual one.
        rests = abs(speed) < uncertain
        found = [(q[0] if rests else fit[2], min(off[2], level)), (0.0 if rests else speed, uncertain)]
    return found
