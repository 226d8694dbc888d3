"""A MuJoCo model with other values, simulated over records from the start that fits them.

A free run of an arm in a closed loop drifts away: its controller is not part of the model. The simulated
joints are therefore held near the measured ones by a soft spring and damper of their own (`tracking_rad_s`).
The start of a record is fitted, for every set of values anew, within what its first rows leave open.

Shapes: T rows of a record, U actuators, Y outputs, J tracked joints, F actuators with a filter, S = 2 J + F
states of a start. Inputs of a simulation are (T, U + Y): commands, then outputs as measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import CubicSpline

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import (
    DEAD_ZONE,
    ELASTIC,
    PLAIN,
    free_name,
    put_component,
    put_gain,
)
from diagnosis.machine.mujoco_forces import JointForces, ran_away, sensed_under
from diagnosis.machine.mujoco_model import MujocoModel
from diagnosis.machine.own_plant import PlantExperiment
from diagnosis.machine.plant_effect import PlantEffect

Kept = TypeVar("Kept")


class WhenMet(NamedTuple):
    """When in a step, in steps from its begin, a force meets the position and the speed of the model."""

    position: float
    speed: float


class CompiledModel(NamedTuple):
    """A model (mujoco.MjModel) and memory (mujoco.MjData) to simulate it in."""

    model: Any
    data: Any


class StartGuess(NamedTuple):
    """A number of a start as first samples tell it, and what it may be off by (standard deviation)."""

    value: float
    spread: float


# Share by which forces change to see the motion that they make: small enough for a linear response, large
# enough that rounding does not show. Chosen; ten times less or more changes the share by less than a tenth.
_FORCE_CHANGE = 0.05
# Compiled models in memory at once, some 15 MB each: a fit asks for the same one for every record in turn,
# and difference quotients for a few. Chosen.
_KEPT_MODELS = 8
# Records whose paths and starts are in memory at once; chosen, some 1 MB each at a thousand rows. More
# records are computed anew every time.
_KEPT_RECORDS = 60
# By how much, as a share, slopes of the stated model may miss what a start does in another one. Chosen:
# masses and gains that are off by their tolerances change responses by less.
_SLOPES_MISS = 0.3
# How often a start is simulated anew where slopes may miss more than what is left; each time shrinks what is
# missed to about the share above, so that two leave a tenth. Chosen.
_RESTARTS = 2
# Samples of the parabolas whose begin may be a start. Chosen: four are the fewest that leave a residual, each
# next one has a quarter to a third more.
_PARABOLA_SAMPLES = (4, 5, 7, 9, 12, 16, 21, 28)
# A parabola fits while its residual is no more than so many noise deviations; by as many deviations of its
# fit a start may be off. Chosen: the usual two standard deviations.
_NOISE_DEVIATIONS = 2.0
# Euler's integrator holds the speed of the step before, implicit ones solve for that of the next, Runge-Kutta
# takes means over the step.
_MET = {
    int(mujoco.mjtIntegrator.mjINT_EULER): WhenMet(0.0, -0.5),
    int(mujoco.mjtIntegrator.mjINT_RK4): WhenMet(0.5, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT): WhenMet(0.0, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): WhenMet(0.0, 0.5),
}


@dataclass(frozen=True, eq=False)
class RecordStart:
    """The start of a record, as the sensors tell it: positions of the J tracked joints, their speeds, then
    what the F filters of actuators hold.

    Parameters
    ----------
    state : (S,)
        From which the stated model fits the record best.
    guess, spread : (S,)
        As the first samples alone tell it, and standard deviations of that.
    slopes : (S, T, Y)
        Of the outputs of the stated model by the state.
    noise : (Y,)
        Noise standard deviations of the outputs.
    """

    state: Real
    guess: Real
    spread: Real
    slopes: Real
    noise: Real

    def beside(self, spread: Real, slopes: Real) -> RecordStart:
        """With L further states that are zero as far as anybody knows: spread (L,), slopes (L, T, Y)."""
        nothing = np.zeros(spread.size)
        return replace(
            self,
            state=np.append(self.state, nothing),
            guess=np.append(self.guess, nothing),
            spread=np.append(self.spread, spread),
            slopes=np.concatenate([self.slopes, slopes]),
        )

    def adds(self, shift: Real) -> Real:
        """(T, Y) what a shift (S,) of the start adds to the outputs of the stated model, to first order."""
        return np.asarray(np.tensordot(shift, self.slopes, 1))

    def shift(self, residual: Real) -> Real:
        """(S,) the shift of the start that fits best where measured - model is the residual (T, Y).

        Least squares of residual - slopes shift, each output over its RMS (at least its noise), with the
        guess and its spread as a prior: (A A^T + diag(spread^-2)) shift = A r + (guess - state) / spread^2.
        """
        level = np.maximum(_rms(residual), self.noise)
        A = (self.slopes / level).reshape(len(self.state), residual.size)
        H = A @ A.T + np.diag(self.spread**-2.0)
        prior = (self.guess - self.state) / self.spread**2
        return np.asarray(np.linalg.solve(H, A @ (residual / level).ravel() + prior))


@dataclass(frozen=True, eq=False)
class MujocoSimulation:
    """(parameters, effects, inputs (T, U + Y)) -> outputs (T, Y) of a model with these values.

    Parameters
    ----------
    arm : MujocoModel
    quantities : mapping
        Name -> what may be off or missing; names of parameters and effects are among them.
    noise : (Y,)
        Noise standard deviations of the outputs.
    settles : bool
        Outputs start as fits the record best to first order, which `settled` completes. Else every record
        starts as its first samples say.
    """

    arm: MujocoModel
    quantities: Mapping[str, PlantEffect]
    noise: Real
    settles: bool = True
    _models: dict[Any, CompiledModel] = field(default_factory=dict, repr=False)
    _paths: dict[Any, tuple[Real, Real]] = field(default_factory=dict, repr=False)
    _starts: dict[Any, RecordStart] = field(default_factory=dict, repr=False)

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value that the model has, of what may be wrong."""
        return {name: quantity.stated for name, quantity in self.quantities.items() if quantity.stated != 0.0}

    @property
    def tolerances(self) -> dict[str, float]:
        """Parameter -> relative standard deviation, of those for which the file has a number."""
        stated = {quantity.name: float(quantity.data[0]) for quantity in self.arm.spec.numerics}
        names = {name: f"tolerance.{name}" for name in self.parameters}
        return {name: stated[number] for name, number in names.items() if number in stated}

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        """Quantities that the model has none of."""
        return tuple(quantity for quantity in self.quantities.values() if quantity.stated == 0.0)

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
        """A copy of the model (mujoco.MjSpec) with these values.

        values : name of a quantity -> number, or numbers in the order of its parameters. of : spec that is
        copied; None: what moves of the arm (`MujocoModel.moving`). An unknown name is a KeyError.
        """
        spec = (of or self.arm.moving).copy()
        for name, value in values.items():
            self.quantities[name].law.change(spec, *np.ravel(value).tolist())
        return spec

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        """Outputs (T, Y) without noise; not finite where the trial runs away.

        parameters : name -> value. effects : name -> parameter -> value. Raises ValueError where MuJoCo does
        not compile the model with these values.
        """
        values: dict[str, Any] = {**parameters}
        for name, sizes in effects.items():
            values[name] = tuple(sizes.values())
        compiled = self._compiled_with(values)
        if not self.settles:
            guess, _ = self._guess(inputs)
            return self._run(compiled, inputs, guess)
        start = self._start(inputs)
        outputs = self._run(compiled, inputs, start.state)
        if not np.all(np.isfinite(outputs)):
            return outputs
        outputs, before = self._fitted_before(compiled, inputs, start, outputs)
        return self._restarted(compiled, inputs, start, before, outputs)

    def _fitted_before(
        self, compiled: CompiledModel, inputs: Real, start: RecordStart, outputs: Real
    ) -> tuple[Real, Real]:
        """Outputs (T, Y) under the commands before the record that fit best, and these commands (U,).

        A lag or delay that the stated model lacks still feels something of them. They are taken as constant;
        outputs : (T, Y), under those of the first row, which are all that is known of the others.
        """
        measured = inputs[:, len(self.arm.inputs) :]
        before = inputs[0, : len(self.arm.inputs)].copy()
        late = self._late(compiled.model)
        if not late:
            return outputs, before
        spread = np.array([_spread_of_command(inputs[:, u]) for u in late])
        slopes = np.zeros((len(late), *outputs.shape))
        for k, u in enumerate(late):
            moved = before.copy()
            moved[u] += spread[k]
            slopes[k] = (self._run(compiled, inputs, start.state, moved) - outputs) / spread[k]
        shift = start.beside(spread, slopes).shift(measured - outputs)
        # The states' part of the shift is left to the start itself, which follows.
        of_commands = shift[start.state.size :]
        before[late] += of_commands
        return outputs + np.tensordot(of_commands, slopes, 1), before

    def _restarted(
        self, compiled: CompiledModel, inputs: Real, start: RecordStart, before: Real, outputs: Real
    ) -> Real:
        """Outputs (T, Y) with the start simulated anew where slopes of the stated model miss too much.

        `settled` will move the start that fits best, by slopes of the stated model. Where these may miss most
        of what is then left, that move is simulated with the values at hand and only its first order is taken
        off again. Between "no" and "wholly" the outputs are a mean of both, so that they stay continuous in
        the values.
        """
        measured = inputs[:, len(self.arm.inputs) :]
        simulated_shift = np.zeros(start.state.size)
        for _ in range(_RESTARTS):
            shift = start.shift(measured - outputs)
            left = _rms(measured - outputs - start.adds(shift))
            # An unsimulated move misses this many times what it leaves, or the noise.
            missed = _SLOPES_MISS * _rms(start.adds(shift - simulated_shift)) / np.hypot(left, self.noise)
            weight = float(np.clip(np.max(missed) - 1, 0.0, 1.0))
            if weight == 0:
                break
            restarted = self._run(compiled, inputs, start.state + shift, before) - start.adds(shift)
            outputs = outputs + weight * (restarted - outputs)
            simulated_shift = simulated_shift + weight * (shift - simulated_shift)
        return outputs

    def settled(self, inputs: Real, outputs: Real) -> Real:
        """Outputs (T, Y) moved to the start that fits the record best; to first order in that move."""
        start = self._start(inputs)
        if not start.state.size:
            return outputs
        measured = inputs[:, len(self.arm.inputs) :]
        return np.asarray(outputs + start.adds(start.shift(measured - outputs)))

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
        start = self._start(inputs)
        return self._run(self._compiled_with(parameters), inputs, start.state, forces=forces)

    def stick_figure(self, outputs: Real) -> Real | None:
        """(frames, lines, 2, 3) [m] ends of the lines of an arm whose outputs are (frames, Y).

        A line leads from body to body, of a last body to its first site, else to its centre of mass. None
        where a joint is not measured: nobody knows how the arm stands.
        """
        model = self.arm.nominal
        data = mujoco.MjData(model)
        if len(self.arm.tracked) < model.njnt:
            return None
        mujoco.mj_resetData(model, data)
        bodies = [body for body in range(1, model.nbody) if model.body_weldid[body]]
        first_site = {int(model.site_bodyid[site]): site for site in reversed(range(model.nsite))}
        frames = []
        for positions in self.arm.joint_positions(outputs):
            for joint, position in zip(self.arm.tracked, positions, strict=True):
                data.joint(joint.name).qpos[0] = position
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            lines = []
            for body in bodies:
                lines.append((data.xpos[model.body_parentid[body]].copy(), data.xpos[body].copy()))
                if body not in model.body_parentid:
                    end = data.xipos[body]
                    if body in first_site:
                        end = data.site_xpos[first_site[body]]
                    lines.append((data.xpos[body].copy(), end.copy()))
            frames.append(lines)
        return np.array(frames)

    def _compiled_with(self, values: Mapping[str, Any]) -> CompiledModel:
        """The model with these values of quantities (numbers or tuples of them), out of memory if there."""
        changed = {name: value for name, value in values.items() if value != self.quantities[name].stated}
        return _remembered(
            self._models,
            tuple(changed.items()),
            lambda: self._compiled(self.edited(changed)),
            _KEPT_MODELS,
        )

    def _compiled(self, spec: Any) -> CompiledModel:
        """A spec, which gets the tracking of this arm, compiled.

        The tracking is an actuator for every tracked joint, behind those of the model: a critically damped
        spring, force = control - J omega^2 position - 2 J omega speed with the joint's inertia J.
        """
        omega = self.arm.tracking_rad_s
        for joint in self.arm.tracked:
            name = free_name(f"tracking {joint.name}", "spring", spec.actuator)
            actuator = spec.add_actuator(PLAIN.default, name=name, target=joint.name)
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.gear = np.eye(6)[0]
            actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
            actuator.gainprm[0] = 1.0
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm[1] = -joint.inertia * omega**2
            actuator.biasprm[2] = -2 * joint.inertia * omega
        model = spec.compile()
        return CompiledModel(model, mujoco.MjData(model))

    def _late(self, model: Any) -> list[int]:
        """Places of actuators with a lag or delay that the stated model does not have."""
        stated = self.arm.nominal
        late = []
        for u in range(len(self.arm.inputs)):
            lags = model.actuator_actadr[u] >= 0 and not stated.actuator_actadr[u] >= 0
            delays = model.actuator_history[u, 0] > 0 and not stated.actuator_history[u, 0] > 0
            if lags or delays:
                late.append(u)
        return late

    def _run(
        self,
        compiled: CompiledModel,
        inputs: Real,
        start: Real,
        before: Real | None = None,
        forces: Real | None = None,
    ) -> Real:
        """Outputs (T, Y) of a compiled model from one start on.

        Parameters
        ----------
        compiled : CompiledModel
        inputs : (T, U + Y)
            Commands, then outputs as measured, near which the joints are held.
        start : (S,)
            See `RecordStart`.
        before : (U,) or None
            Commands before the first row; None: as in that.
        forces : (T, J) or None
            On the tracked joints, beside what holds them near the record [N m or N].
        """
        arm = self.arm
        model, data = compiled
        n_inputs = len(arm.inputs)
        if before is None:
            before = inputs[0, :n_inputs]
        step_s = model.opt.timestep
        steps_per_row = round(arm.dt_s / step_s)
        dead_zone = np.array([_number(model, f"{name}.{DEAD_ZONE}", 0.0) for name in arm.inputs])
        commands = _beyond(dead_zone, inputs[:, :n_inputs])
        before = _beyond(dead_zone, before)
        control = np.zeros((len(inputs) * steps_per_row, model.nu))
        control[:, :n_inputs] = np.repeat(commands, steps_per_row, axis=0)
        self._put(model, data, start, before)

        # What draws a joint to its path: the spring and damper of `_compiled` pull to zero by themselves.
        omega = arm.tracking_rad_s
        gain, offset = self._readings(model)
        if omega:
            for j, joint in enumerate(arm.tracked):
                k = joint.column
                delay_s = float(model.sensor_delay[model.sensor(arm.outputs[k]).id])
                path, slope = self._path(inputs[:, n_inputs + k], step_s, delay_s, model.opt.integrator)
                pull = omega**2 * (path - offset[k]) + 2 * omega * slope
                control[:, n_inputs + j] = joint.inertia / gain[k] * pull
        if forces is not None:
            last = n_inputs + forces.shape[1]
            control[:, n_inputs:last] += np.repeat(forces, steps_per_row, axis=0)

        # Delays begin with what was before: the commands, and the readings of the start.
        for u in range(n_inputs):
            past = model.actuator_history[u, 0]
            if past:
                mujoco.mj_initCtrlHistory(model, data, u, None, np.full((past, 1), before[u]))
        if model.nhistory:
            mujoco.mj_forward(model, data)
            for s in range(model.nsensor):
                past = model.sensor_history[s, 0]
                if past:
                    reading = data.sensordata[model.sensor_adr[s]]
                    mujoco.mj_initSensorHistory(model, data, s, None, np.full((past, 1), reading), 0.0)
        _wind(model, data, control[0])

        columns = [model.sensor(name).adr[0] for name in arm.outputs]
        sensed = _sensed(model, data, control)
        return np.asarray(sensed[::steps_per_row, columns] * gain + offset)

    def _put(self, model: Any, data: Any, start: Real, before: Real) -> None:
        """Write a start (S,), see `RecordStart`, and the commands (U,) before it into data."""
        mujoco.mj_resetData(model, data)
        arm = self.arm
        gain, offset = self._readings(model)
        for j, joint in enumerate(arm.tracked):
            k = joint.column
            data.joint(joint.name).qpos[0] = (start[j] - offset[k]) / gain[k]
            data.joint(joint.name).qvel[0] = start[len(arm.tracked) + j] / gain[k]
        start_filters(model, data, before)
        data.act[model.actuator_actadr[list(arm.filtered)]] = start[2 * len(arm.tracked) :]

    def began(self, model: Any, inputs: Real) -> Any:
        """mujoco.MjData of a compiled model as a record (T, U + Y) begins: as its first samples say."""
        data = mujoco.MjData(model)
        guess, _ = self._guess(inputs)
        self._put(model, data, guess, inputs[0, : len(self.arm.inputs)])
        return data

    def _readings(self, model: Any) -> tuple[Real, Real]:
        """Gains (Y,) and offsets (Y,) of the sensors in a compiled model: reading = gain value + offset."""
        gain = [_number(model, f"{name}.gain", 1.0) for name in self.arm.outputs]
        offset = [_number(model, f"{name}.offset", 0.0) for name in self.arm.outputs]
        return np.array(gain), np.array(offset)

    def _path(self, measured: Real, step_s: float, delay_s: float, integrator: int) -> tuple[Real, Real]:
        """Path and slope of an output, as the tracking meets them in every step of the model.

        Parameters
        ----------
        measured : (T,)
            The output; between rows a cubic spline.
        step_s, integrator
            Of the model: when in a step they are met (`_MET`).
        delay_s : float
            Of the sensor: the joint was so much earlier where it was read.

        Returns
        -------
        (N,), (N,) for N steps; beyond the last row as there.
        """

        def compute() -> tuple[Real, Real]:
            dt_s = self.arm.dt_s
            spline = CubicSpline(dt_s * np.arange(len(measured)), measured)
            steps = len(measured) * round(dt_s / step_s)
            begins_s = step_s * np.arange(steps) + delay_s
            end_s = spline.x[-1]
            met = _MET[integrator]
            path = spline(np.clip(begins_s + met.position * step_s, 0.0, end_s))
            slope = spline(np.clip(begins_s + met.speed * step_s, 0.0, end_s), 1)
            return np.asarray(path), np.asarray(slope)

        # An edit may change the integrator (`put_backlash`).
        met_by = (measured.tobytes(), step_s, delay_s, integrator)
        return _remembered(self._paths, met_by, compute, _KEPT_RECORDS)

    def _start(self, inputs: Real) -> RecordStart:
        """The start of a record (T, U + Y), out of memory if there."""
        return _remembered(self._starts, inputs.tobytes(), lambda: self._fitted_start(inputs), _KEPT_RECORDS)

    def _guess(self, inputs: Real) -> tuple[Real, Real]:
        """The start (S,) of a record (T, U + Y) as its first samples tell it, and what that may be off by
        (S,), see `RecordStart`."""
        arm = self.arm
        # Integrators but for Runge-Kutta keep the speed of the middle of the step before.
        step_s = arm.nominal.opt.timestep
        early_s = 0.5 * step_s
        if _MET[arm.nominal.opt.integrator] == WhenMet(0.5, 0.5):
            early_s = 0.0
        positions = []
        speeds = []
        for joint in arm.tracked:
            k = joint.column
            measured = inputs[:, len(arm.inputs) + k]
            position, speed = _from_first_samples(measured, arm.dt_s, self.noise[k], early_s)
            positions.append(position)
            speeds.append(speed)
        filters = [StartGuess(inputs[0, u], _spread_of_command(inputs[:, u])) for u in arm.filtered]
        states = np.array([*positions, *speeds, *filters]).reshape(-1, 2)
        return states[:, 0], states[:, 1]

    def _fitted_start(self, inputs: Real) -> RecordStart:
        """The start of a record: as its first samples say, moved once by what the stated model leaves.

        The move is not made where it asks for more than joints at rest and their spread leave open: then the
        model is wrong about something else.
        """
        n_inputs = len(self.arm.inputs)
        guess, spread = self._guess(inputs)
        compiled = self._compiled_with({})
        outputs = self._run(compiled, inputs, guess)
        slopes = np.zeros((guess.size, *outputs.shape))
        for k in range(guess.size):
            moved = guess.copy()
            moved[k] += spread[k]
            slopes[k] = (self._run(compiled, inputs, moved) - outputs) / spread[k]
        start = RecordStart(guess, guess, spread, slopes, self.noise)
        move = start.shift(inputs[:, n_inputs:] - outputs)
        n_joints = len(self.arm.tracked)
        rests = not np.any(guess[n_joints : 2 * n_joints])
        if rests and np.any(np.abs(move) > spread):
            return start
        return replace(start, state=guess + move)

    def commanded(self, stated: Mapping[str, float], experiments: Sequence[PlantExperiment]) -> float:
        """Share of the motion that the forces of the actuators make beside the tracking; 1 in a free run of
        motors.

        Of a motor it is what its commands make. A servo makes the motion of its command whatever the machine
        is: its force, without the damping of its own, makes what it strays from that. Of an actuator whose
        gain is no quantity: its command.

        Parameters
        ----------
        stated : name -> value
            Quantities that the model has; of these only names of gains matter.
        experiments : sequence of PlantExperiment

        Returns
        -------
        float
            RMS over outputs and records of the motion made over the motion measured, at most 1.
        """
        spec = self.edited({})
        without_gain = []
        for u, actuator in enumerate(list(spec.actuators)):
            if f"{actuator.name}.gain" not in stated:
                without_gain.append(u)
                continue
            damping = actuator.biasprm[2]
            put_gain(actuator.name, spec, 1 + _FORCE_CHANGE)
            if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
                put_component(actuator, "biasprm", 2, damping)
        stronger = self._compiled(spec)

        # Response to the change of forces over that change; an outputs' shares of variance add up.
        made = 0.0
        for e in experiments:
            inputs = e.input.copy()
            commands = inputs[:, without_gain]
            inputs[:, without_gain] += _FORCE_CHANGE * (commands - np.mean(commands, axis=0))
            start = self._start(e.input).state
            response = self._run(stronger, inputs, start)
            response -= self._run(self._compiled_with({}), e.input, start)
            made += float(np.sum(np.var(response / _FORCE_CHANGE, axis=0) / np.var(e.output, axis=0)))
        signals = len(experiments) * len(self.arm.outputs)
        return float(min(np.sqrt(made / signals), 1.0))


def start_filters(model: Any, data: Any, commands: Real) -> None:
    """Set states of actuators as if the commands (U,) had been held for long; integrators start at zero."""
    for u, has_state in enumerate(model.actuator_actadr[: len(commands)] >= 0):
        if has_state and model.actuator_dyntype[u] != int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
            data.act[model.actuator_actadr[u]] = commands[u]


def _from_first_samples(
    measured: Real, dt_s: float, noise: float, early_s: float
) -> tuple[StartGuess, StartGuess]:
    """Position in the first row, and speed a little earlier, of a joint.

    They are those of the longest parabola through first samples that leaves no more than noise. A joint that
    may have begun to move within a row rests: a log that begins with its step is the usual one.

    Parameters
    ----------
    measured : (T,)
        Readings of the joint, T >= 4.
    dt_s, noise : float
        Sampling period; standard deviation of the noise.
    early_s : float
        How much before the first row the speed is asked.
    """
    for n in _PARABOLA_SAMPLES:
        if n > len(measured):
            break
        time_s = dt_s * np.arange(n)
        parabola, covariance = np.polyfit(time_s, measured[:n], 2, cov="unscaled")
        squares = np.sum((measured[:n] - np.polyval(parabola, time_s)) ** 2)
        residual = float(np.sqrt(squares / (n - 3)))
        if n > _PARABOLA_SAMPLES[0] and residual > _NOISE_DEVIATIONS * noise:
            break
        half_acceleration, slope, begin = parabola
        level = max(residual, noise)
        _, slope_off, begin_off = _NOISE_DEVIATIONS * level * np.sqrt(np.diag(covariance))
        # A force may have changed within a row: by as much as it is.
        speed_spread = slope_off + abs(2 * half_acceleration) * dt_s
        speed = slope - 2 * half_acceleration * early_s
        position_spread = min(begin_off, level)
        if abs(speed) < speed_spread:
            guesses = (StartGuess(measured[0], position_spread), StartGuess(0.0, speed_spread))
        else:
            guesses = (StartGuess(begin, position_spread), StartGuess(speed, speed_spread))
    return guesses


def _spread_of_command(command: Real) -> float:
    """How far a command (T,) may have been from its first value: its standard deviation, 1 if it is held."""
    return float(np.std(command)) or 1.0


def _beyond(dead_zone: Real, commands: Real) -> Real:
    """Commands (T, U) or (U,) behind dead zones of so much on either side of zero (U,)."""
    return np.asarray(commands - np.clip(commands, -dead_zone, dead_zone))


def _number(model: Any, name: str, without: float) -> float:
    """First value of a <numeric> of a compiled model; `without` where it has none of that name."""
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if k < 0:
        return without
    return float(model.numeric(k).data[0])


def _wind(model: Any, data: Any, command: Real) -> None:
    """Wind springs of drives in data so far that motor and link speed up together under a command (U,).

    A spring's joint accelerates against its motor by qacc; the forces f on these joints that stop that follow
    from (M^-1) f = qacc over their rows and columns, and the deflection is f over the stiffness.
    """
    springs = []
    for k in range(model.njnt):
        if model.joint(k).name.endswith(f" {ELASTIC}"):
            springs.append(model.joint(k))
    if not springs:
        return
    dofs = np.array([spring.dofadr[0] for spring in springs])
    positions = np.array([spring.qposadr[0] for spring in springs])
    data.ctrl[:] = command
    mujoco.mj_forward(model, data)
    acceleration_by_force = np.zeros((dofs.size, model.nv))
    mujoco.mj_solveM(model, data, acceleration_by_force, np.eye(model.nv)[dofs])
    force = np.linalg.solve(acceleration_by_force[:, dofs], data.qacc[dofs])
    data.qpos[positions] = force / model.jnt_stiffness[[spring.id for spring in springs]]


def _sensed(model: Any, data: Any, control: Real) -> Real:
    """(N, numbers) what sensors read at the beginning of N steps under their commands, control (N, NU).

    Not finite from where the trial runs away.
    """
    joints = JointForces.of_model(model)
    if joints:
        return sensed_under(joints, model, data, control)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    _, rollouts = rollout.rollout(model, data, state[None], control[None])
    readings = np.array(rollouts[0])
    if ran_away(data):
        # A rollout ends there and repeats its last row.
        changes = np.flatnonzero(np.any(np.diff(readings, axis=0) != 0, axis=1))
        last_change = changes[-1] if changes.size else -1
        readings[last_change + 1 :] = np.nan
    return readings


def _rms(signals: Real) -> Real:
    """(T, Y) -> (Y,) root mean squares."""
    return np.asarray(np.sqrt(np.mean(signals**2, axis=0)))


def _remembered(kept: dict[Any, Kept], key: Any, compute: Callable[[], Kept], most: int) -> Kept:
    """What is kept under a key; computed where nothing is, in place of the oldest if there are `most`."""
    if key not in kept:
        if len(kept) >= most:
            oldest = next(iter(kept))
            kept.pop(oldest)
        kept[key] = compute()
    return kept[key]
