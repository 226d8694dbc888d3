"""Effects around a simulation that does not know them: on an input, on an output, on the body between."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import scipy

from diagnosis.machine.body_forces import BodyForces
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.motion_effects import PulseResponse, with_forces

Run = Callable[[Real], Real]
Values = Mapping[str, float]

# Simulations around a drive: of a linear loop the first is enough, of others each is closer.
_ROUNDS = 8
# Share of what the effects add there that the last may still move. Chosen.
_CLOSE = 1e-4
# Steps to a fixed point beside a linear loop; a tight loop takes some tens.
_STEPS = 200
# Steps that each next one is mixed of: more repeat each other.
_MIXED = 8
# Share of the fixed point below which a step is none.
_STANDS = 1e-9
# Singular values below this share of the largest are not inverted when steps are mixed.
_MIXING_RANK = 1e-12
# A force that the simulation does not follow to this share of what it changes was not found.
_MISSED = 0.05
# Share of the largest early motion after a pulse that is one.
_SHOWS = 0.05
# Samples after a pulse in which the motion begins.
_EARLY_SAMPLES = 5
# Share of a signal's deviations that a pulse on it has: small beside what bends, large beside rounding.
_SMALL_PULSE = 1e-3
# Smallest deviations that such a pulse is a share of, of a signal that stands.
_LEAST_DEVIATION = 1e-9
# Simulations that are kept of each kind: those of one set of parameters, beside sixteen records at most.
_KEPT = 16
# Share of the longest way one way on which bearings and gears give way before a body slides.
_SHORT_WAY = 5e-3
# Deviations of a speed's noise from which on its sign is sure.
_SURE_SIGN = 4
# Share of the usual speed that is more than noise.
_SLOW = 0.1


@dataclass(frozen=True)
class Identity:
    """A key that equals another only where both hold the same object, which it keeps alive.

    The bare id of an object that is gone may be that of a new one.
    """

    held: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.held is other.held

    def __hash__(self) -> int:
        return id(self.held)


@dataclass(frozen=True, eq=False)
class Started:
    """A simulation from a start, and the same from rest.

    key : all that `at_rest` depends on besides its inputs: simulation, parameters, effects in and around it.
    start : the start of `run`, beyond the key.
    """

    run: Run
    at_rest: Run
    key: Hashable
    start: Hashable


class Remembered:
    """The last `_KEPT` values that were computed, each under everything it was computed from."""

    def __init__(self) -> None:
        self._values = dict[Hashable, Any]()

    def value(self, key: Hashable, compute: Callable[[], Any]) -> Any:
        """What stands under the key, else what `compute` gives, which is kept."""
        if key not in self._values:
            value = compute()
            if len(self._values) >= _KEPT:
                self._values.pop(next(iter(self._values)))
            self._values[key] = value
        return self._values[key]


@dataclass(frozen=True, eq=False)
class Body:
    """A body in the simulation, that friction and springs act on.

    motion : output, or column of what the simulation returns (beyond the outputs: a motion nobody measured).
    force : column of the inputs with the force on it, held over each sample; None: that of the actuator.
    largest_force : for ranges and a pulse to try it with, where that column is zero in the records.
    """

    motion: str | int
    motion_is: Literal["position", "speed"] = "position"
    force: int | None = None
    largest_force: float | None = None
    dt_s: float = float("nan")
    _pulse_responses: Remembered = field(default_factory=Remembered, init=False, repr=False)
    _runs_without: Remembered = field(default_factory=Remembered, init=False, repr=False)
    _doubts: set[str] = field(default_factory=set, init=False, repr=False)

    def under(self, started: Started, forces: BodyForces) -> Run:
        """The simulation with forces on the body.

        Its outputs are not a number throughout where no forces were found that the simulation follows.
        """
        force_at = int(self.force or 0)
        motion_at = int(self.motion)

        def simulated(inputs: Real) -> Real:
            # The response to a pulse is taken with the other inputs held at their first row.
            held = np.array(inputs[:1], dtype=np.float64)
            held[:, force_at] = 0.0
            response, sign = self._pulse_responses.value(
                (started.key, len(inputs), held.tobytes()),
                lambda: self._response(started.at_rest, held, len(inputs)),
            )

            def simulate(force: Real) -> tuple[Real, Real]:
                pushed = inputs.copy()
                pushed[:, force_at] = force
                outputs = started.run(pushed)
                return outputs, sign * outputs[:, motion_at]

            command = inputs[:, force_at]
            free = self._runs_without.value(
                (started.key, started.start, inputs.shape, inputs.tobytes()), lambda: simulate(command)
            )

            def with_motion(outputs: Real, motion: Real) -> Real:
                changed = outputs.copy()
                changed[:, motion_at] = sign * motion
                return changed

            is_only_output = free[0].shape[1] == 1
            outputs, missed = with_forces(
                simulate, free, command, response, forces, with_motion, is_only_output=is_only_output
            )
            return outputs if missed < _MISSED else np.full_like(outputs, np.nan)

        return simulated

    @property
    def doubt(self) -> str:
        """Why smooth forces act less exactly on some motion seen so far, "" where they do not."""
        return max(self._doubts, default="")

    def _response(self, run: Run, others: Real, n_samples: int) -> tuple[PulseResponse, float]:
        """Response (n_samples,) of the motion to a pulse of force, from rest, and the sign between the two.

        others (1, U): the other inputs, held throughout, with zero force. The sign is -1 where force and
        motion count opposite ways.
        """
        force_at = int(self.force or 0)
        motion_at = int(self.motion)
        pulse = self.largest_force or 1.0
        still = np.repeat(others, n_samples, axis=0)
        pushed = still.copy()
        pushed[1, force_at] = pulse
        moved = (run(pushed) - run(still))[:, motion_at] / pulse
        # The first that shows says the sign: at few samples per period the largest is on the way back.
        early = np.abs(moved[:_EARLY_SAMPLES])
        shows = early > _SHOWS * np.max(early)
        sign = float(np.sign(moved[np.argmax(shows)]))
        response = PulseResponse.of(sign * moved, self.dt_s, of_speed=self.motion_is == "speed")
        self._doubts.add(response.doubt)
        return response, sign


@dataclass(frozen=True, eq=False)
class MeasuredBody:
    """A body whose motion is given, whose force is asked: inputs of position and speed, output of force.

    position, speed : columns of the inputs; force : of the outputs, the sensor's.
    slow, short : it may be at rest where it is no faster, or turns back before its speeds add up to that:
        what friction holds there is anything up to its level, and such rows say nothing (`resting`).
    """

    position: int
    speed: int
    force: int = 0
    slow: float = 0.0
    short: float = 0.0

    def of(self, force: int, inputs: Sequence[Real]) -> MeasuredBody:
        """The body with its limits of rest, from inputs (T, U) of all records.

        force : column of the outputs. Noise of the speed, white or not, is what it has on short ways.
        """
        ways = np.concatenate([_ways(u[:, self.speed]) for u in inputs])
        speeds = np.concatenate(inputs)[:, self.speed]
        short = _SHORT_WAY * float(np.max(ways))
        is_short = ways <= short
        at_rest = speeds[is_short]
        noise = _norm(at_rest) / max(at_rest.size, 1) ** 0.5
        usual_speed = _norm(speeds) / speeds.size**0.5
        slow = min(_SURE_SIGN * noise, _SLOW * usual_speed)
        return replace(self, force=force, slow=slow, short=short)

    def under(self, started: Started, forces: BodyForces) -> Run:
        """The simulation whose output of force has in it what the motion takes because of these forces."""

        def simulated(inputs: Real) -> Real:
            outputs = np.array(started.run(inputs))
            speed = np.where(self.resting(inputs), 0.0, inputs[:, self.speed])
            without = outputs[:, self.force]
            outputs[:, self.force] += forces.overcome(inputs[:, self.position], speed, without)
            return outputs

        return simulated

    def resting(self, inputs: Real) -> npt.NDArray[np.bool_]:
        """(T,) rows in which the body may be at rest, and those beside: it stops or starts between them."""
        speed = inputs[:, self.speed]
        is_slow = np.abs(speed) <= self.slow
        is_short = _ways(speed) <= self.short
        still = np.pad(is_slow | is_short, 1)
        return np.asarray(still[:-2] | still[1:-1] | still[2:])


def _ways(speed: Real) -> Real:
    """(T,) sum of the size of a speed (T,) over all neighbours with the sign that it has in a row."""
    run = np.cumsum(np.diff(np.sign(speed), prepend=0.0) != 0)
    return np.asarray(np.bincount(run, np.abs(speed))[run])


AnyBody = Body | MeasuredBody
Where = Literal["input", "output", "body", "model", "simulation"]


@dataclass(frozen=True, eq=False)
class Sensor:
    """An output, by name or column."""

    column: str | int
    dt_s: float = float("nan")

    # Whatever it reads, it has read before.
    at_rest_before: ClassVar[bool] = False


@dataclass(frozen=True, eq=False)
class Actuator:
    """A column of the inputs, or a signal inside a loop that the simulation closes.

    drive : of such a loop: output, or column of what the simulation returns, that is the command of its
        drive. The simulation adds `column`, zeros in records, to it.
    at_rest_before : before its first row the command is zero; else as in that row.

    What an effect makes of the command of a drive comes back through the loop: it is solved beside the loop's
    response to a pulse, then simulated; where the loop is not linear, again beside what that gives.
    """

    column: int = 0
    drive: str | int | None = None
    at_rest_before: bool = True
    dt_s: float = float("nan")
    _responses: Remembered = field(default_factory=Remembered, init=False, repr=False)

    def under(self, started: Started, acting: Sequence[Acting], run: Run) -> Run:
        """A simulation (run) with effects on the signal of a drive, in the order given.

        started : that simulation from its start and from rest. Its outputs are not a number throughout where
        no fixed point was found.
        """
        signal_at = int(self.drive or 0)

        def added_by_effects(command: Real) -> Real:
            changed = command
            for law, _, values in acting:
                before = 0.0 if self.at_rest_before else float(changed[0])
                changed = law.change(changed, values, self.dt_s, before)
            return np.asarray(changed - command)

        def simulated(inputs: Real) -> Real:
            def simulate(added: Real) -> tuple[Real, Real]:
                moved = np.array(inputs)
                moved[:, self.column] += added
                outputs = run(moved)
                return outputs, outputs[:, signal_at]

            # The loop need not be linear: its response is that beside these inputs.
            response = self._responses.value(
                (started.key, inputs.shape, inputs.tobytes()),
                lambda: self._response(started.at_rest, inputs),
            )
            added = np.zeros(len(inputs))
            outputs, command = simulate(added)
            for _ in range(_ROUNDS):
                # What the linear loop would have commanded without, then the fixed point beside that.
                without = command - scipy.signal.fftconvolve(response, added)[: added.size]
                added, expected = _fixed(added_by_effects, without, response, added)
                outputs, command = simulate(added)
                missed = _norm(command - expected)
                size = _norm(added)
                if not missed > _CLOSE * size:
                    return outputs
            return outputs if missed < _MISSED * size else np.full_like(outputs, np.nan)

        return simulated

    def _response(self, run: Run, inputs: Real) -> Real:
        """(T,) change of the signal by a unit that is added over the first sample, small beside what moves
        it."""
        signal_at = int(self.drive or 0)
        free = run(inputs)
        deviation = max(float(np.std(free[:, signal_at])), _LEAST_DEVIATION)
        pulse = _SMALL_PULSE * deviation
        pushed = np.array(inputs)
        pushed[0, self.column] += pulse
        return np.asarray((run(pushed) - free)[:, signal_at] / pulse)


def _fixed(
    added_by_effects: Callable[[Real], Real], without: Real, response: Real, start: Real
) -> tuple[Real, Real]:
    """What effects add to the command of a linear loop, and that command.

    Solves x = added_by_effects(without + response * x) for x (T,) from a start (T,), by Anderson's mixing of
    the last steps. without, response : (T,) command without effects, and of the loop to a unit that is added.
    """
    points = list[Real]()
    steps = list[Real]()
    x = start
    for _ in range(_STEPS):
        step = added_by_effects(without + scipy.signal.fftconvolve(response, x)[: x.size]) - x
        if not _norm(step) > _STANDS * _norm(x):
            break
        points = [*points, x][-_MIXED:]
        steps = [*steps, step][-_MIXED:]
        x = x + step
        if len(steps) > 1:
            moves = np.diff(points, axis=0).T
            changes = np.diff(steps, axis=0).T
            x = x - (moves + changes) @ np.linalg.lstsq(changes, step, rcond=_MIXING_RANK)[0]
    return x, np.asarray(without + scipy.signal.fftconvolve(response, x)[: x.size])


@dataclass(frozen=True)
class EffectLaw:
    """What an effect does to a simulation that does not know it.

    where : "input" or "output", it changes a signal; "body", it is a force on a moving body; "model", it
        edits the description of a model; "simulation", it is told to the simulation, which knows it.
    change : of a signal, (T,), values, dt_s, what it was before its first row -> (T,); of a body, values ->
        `BodyForces`; of a model, model and values -> None.
    """

    where: Where = "simulation"
    change: Any = None


Place = Actuator | Sensor | Body | MeasuredBody
Acting = tuple[EffectLaw, Place, Values]


def around(started: Started, acting: Sequence[Acting]) -> Run:
    """Inputs (T, U) -> outputs (T, Y) of a simulation with effects around it, on each column in the order
    given."""
    bodies: dict[int, tuple[AnyBody, BodyForces]] = {}
    drives: dict[int, tuple[Actuator, list[Acting]]] = {}
    for law, place, values in acting:
        if isinstance(place, Actuator) and place.drive is not None:
            _, on_drive = drives.setdefault(id(place), (place, []))
            on_drive.append((law, place, values))
        elif isinstance(place, Body | MeasuredBody):
            _, forces = bodies.get(id(place), (place, BodyForces()))
            bodies[id(place)] = (place, forces + law.change(values))

    # From the inside out: forces on bodies, then loops around them.
    inner = started
    for body, forces in bodies.values():
        key = (inner.key, Identity(body), forces)
        at_rest = body.under(replace(inner, run=inner.at_rest, start=None), forces)
        inner = Started(body.under(inner, forces), at_rest, key, inner.start)
    for drive, effects in drives.values():
        laws = tuple((Identity(law), *values.items()) for law, _, values in effects)
        run = drive.under(inner, effects, inner.run)
        at_rest = drive.under(inner, effects, inner.at_rest)
        inner = Started(run, at_rest, (inner.key, Identity(drive), laws), inner.start)

    def simulated(inputs: Real) -> Real:
        return _changed(inner.run(_changed(inputs, acting, Actuator)), acting, Sensor)

    return simulated


def _norm(x: Real) -> float:
    """Euclidean length of (T,)."""
    return float(np.linalg.norm(x))


def _changed(signals: Real, acting: Sequence[Acting], kind: type[Actuator] | type[Sensor]) -> Real:
    """Signals (T, N) with the effects at places of a kind, but those inside a loop; the same array without
    any."""
    changed = signals
    for law, place, values in acting:
        if not isinstance(place, kind) or getattr(place, "drive", None) is not None:
            continue
        if changed is signals:
            changed = np.array(signals, dtype=np.float64)
        k = int(place.column)
        before = 0.0 if place.at_rest_before else float(changed[0, k])
        changed[:, k] = law.change(changed[:, k], values, place.dt_s, before)
    return changed
