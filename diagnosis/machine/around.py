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

# Rounds of a simulation around a drive, and what the last may still move, over what the effects add there.
_ROUNDS, _CLOSE = 8, 1e-4
# Steps to a fixed point beside a linear loop, how many of them each next one is mixed of, and when it stands.
_STEPS, _MIXED, _STANDS = 200, 8, 1e-9
# A force that the simulation does not follow to this share of what it changes was not found.
_MISSED = 0.05
# Share of the largest early motion after a pulse that is one.
_SHOWS = 0.05
# Simulations that are kept of each kind: those of one set of parameters, beside sixteen records at most.
_KEPT = 16


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
        """The simulation with forces on the body; not a number where none were found that it follows."""
        run, force_at, motion_at = started.run, int(self.force or 0), int(self.motion)

        def simulated(inputs: Real) -> Real:
            # The response to a pulse is taken with the other inputs held at their first row.
            others = np.array(inputs[:1], dtype=np.float64)
            others[:, force_at] = 0.0
            response, sign = self._pulse_responses.value(
                (started.key, len(inputs), others.tobytes()),
                lambda: self._response(started.at_rest, others, len(inputs)),
            )

            def under(force: Real) -> tuple[Real, Real]:
                moved = inputs.copy()
                moved[:, force_at] = force
                found = run(moved)
                return found, sign * found[:, motion_at]

            command = inputs[:, force_at]
            free = self._runs_without.value(
                (started.key, started.start, inputs.shape, inputs.tobytes()), lambda: under(command)
            )

            def placed(outputs: Real, motion: Real) -> Real:
                found = outputs.copy()
                found[:, motion_at] = sign * motion
                return found

            alone = free[0].shape[1] == 1
            outputs, missed = with_forces(under, free, command, response, forces, placed, alone=alone)
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
        first = np.abs(moved[:5])
        # The first that shows: at few samples per period the largest is on the way back.
        sign = float(np.sign(moved[np.argmax(first > _SHOWS * np.max(first))]))
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
        """Of inputs (T, U) of all records. Noise of the speed, white or not, is what it has on short ways."""
        ways = np.concatenate([_ways(u[:, self.speed]) for u in inputs])
        every = np.concatenate(inputs)[:, self.speed]
        # Before a body slides, bearings and gears give way by thousandths of its longest way.
        short = 5e-3 * float(np.max(ways))
        rests = every[ways <= short]
        # Of four deviations of the noise a sign is sure; a tenth of the usual speed is more than noise.
        slow = min(4 * _norm(rests) / max(rests.size, 1) ** 0.5, 0.1 * _norm(every) / every.size**0.5)
        return replace(self, force=force, slow=slow, short=short)

    def under(self, started: Started, forces: BodyForces) -> Run:
        def simulated(inputs: Real) -> Real:
            found = np.array(started.run(inputs))
            speed = np.where(self.resting(inputs), 0.0, inputs[:, self.speed])
            found[:, self.force] += forces.overcome(inputs[:, self.position], speed, found[:, self.force])
            return found

        return simulated

    def resting(self, inputs: Real) -> npt.NDArray[np.bool_]:
        """(T,) rows in which the body may be at rest, and those beside: it stops or starts between them."""
        v = inputs[:, self.speed]
        still = np.pad((np.abs(v) <= self.slow) | (_ways(v) <= self.short), 1)
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
        """The simulation with effects on the signal, in the order given; not a number where no fixed point
        was found."""

        signal = int(self.drive or 0)

        def changed(command: Real) -> Real:
            now = command
            for law, _, values in acting:
                now = law.change(now, values, self.dt_s, 0.0 if self.at_rest_before else float(now[0]))
            return np.asarray(now - command)

        def simulated(inputs: Real) -> Real:
            def with_added(extra: Real) -> tuple[Real, Real]:
                moved = np.array(inputs)
                moved[:, self.column] += extra
                found = run(moved)
                return found, found[:, signal]

            # The loop need not be linear: its response is that beside these inputs.
            response = self._responses.value(
                (started.key, inputs.shape, inputs.tobytes()),
                lambda: self._response(started.at_rest, inputs),
            )
            extra = np.zeros(len(inputs))
            found, command = with_added(extra)
            for _ in range(_ROUNDS):
                alone = command - scipy.signal.fftconvolve(response, extra)[: extra.size]
                extra, expected = _fixed(changed, alone, response, extra)
                found, command = with_added(extra)
                missed, size = _norm(command - expected), _norm(extra)
                if not missed > _CLOSE * size:
                    return found
            return found if missed < _MISSED * size else np.full_like(found, np.nan)

        return simulated

    def _response(self, run: Run, inputs: Real) -> Real:
        """(T,) of the signal to one that is added over the first sample, small beside what moves it."""
        signal, free = int(self.drive or 0), run(inputs)
        small, pushed = 1e-3 * max(float(np.std(free[:, signal])), 1e-9), np.array(inputs)
        pushed[0, self.column] += small
        return np.asarray((run(pushed) - free)[:, signal] / small)


def _fixed(changed: Callable[[Real], Real], alone: Real, response: Real, start: Real) -> tuple[Real, Real]:
    """x (T,) = changed(alone + response * x), and that command; Anderson's mixing of the last steps."""
    points, steps, x = list[Real](), list[Real](), start
    for _ in range(_STEPS):
        step = changed(alone + scipy.signal.fftconvolve(response, x)[: x.size]) - x
        if not _norm(step) > _STANDS * _norm(x):
            break
        points, steps = [*points, x][-_MIXED:], [*steps, step][-_MIXED:]
        x = x + step
        if len(steps) > 1:
            moves, turns = np.diff(points, axis=0).T, np.diff(steps, axis=0).T
            x = x - (moves + turns) @ np.linalg.lstsq(turns, step, rcond=1e-12)[0]
    return x, np.asarray(alone + scipy.signal.fftconvolve(response, x)[: x.size])


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
    """A simulation with effects around it, on each column in the order given."""
    bodies: dict[int, tuple[AnyBody, BodyForces]] = {}
    drives: dict[int, tuple[Actuator, list[Acting]]] = {}
    for law, place, values in acting:
        if isinstance(place, Actuator) and place.drive is not None:
            drives.setdefault(id(place), (place, []))[1].append((law, place, values))
        elif isinstance(place, Body | MeasuredBody):
            _, forces = bodies.get(id(place), (place, BodyForces()))
            bodies[id(place)] = (place, forces + law.change(values))
    inner = started
    for body, forces in bodies.values():
        known = (inner.key, Identity(body), forces)
        at_rest = body.under(replace(inner, run=inner.at_rest, start=None), forces)
        inner = Started(body.under(inner, forces), at_rest, known, inner.start)

    for drive, effects in drives.values():
        laws = tuple((Identity(law), *values.items()) for law, _, values in effects)
        run = drive.under(inner, effects, inner.run)
        at_rest = drive.under(inner, effects, inner.at_rest)
        inner = Started(run, at_rest, (inner.key, Identity(drive), laws), inner.start)

    def simulated(inputs: Real) -> Real:
        return _changed(inner.run(_changed(inputs, acting, Actuator)), acting, Sensor)

    return simulated


def _norm(x: Real) -> float:
    return float(np.linalg.norm(x))


def _changed(signals: Real, acting: Sequence[Acting], kind: type[Actuator] | type[Sensor]) -> Real:
    found = signals
    for law, place, values in acting:
        if isinstance(place, kind) and getattr(place, "drive", None) is None:
            found = np.array(signals, dtype=np.float64) if found is signals else found
            k = int(place.column)
            before = 0.0 if place.at_rest_before else float(found[0, k])
            found[:, k] = law.change(found[:, k], values, place.dt_s, before)
    return found
