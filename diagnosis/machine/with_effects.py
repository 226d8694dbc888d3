"""Listed effects around a simulation that knows none of them.

plant = with_effects(plant, "all", experiments, dt_s=0.01, body=Body("position_m"))
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy

from diagnosis.machine.around import Actuator, Body, MeasuredBody, Place, Sensor, Where
from diagnosis.machine.listed_effects import KINDS, Magnitudes
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import Plant, PlantExperiment

_MISSING = {
    "input": "changes a command, and the stated input is none or zero in every record",
    "body": "needs body=Body(motion), the output that is its position or speed",
}
_NEEDS_MOTION = "motion: the output that is the body's motion"
_SMOOTHED = 11  # samples, of a measured position whose speed is asked


def with_effects(
    plant: Plant,
    names: Sequence[str] | Literal["all"],
    experiments: Sequence[PlantExperiment],
    *,
    dt_s: float,
    actuator: Actuator | None = None,
    body: Body | MeasuredBody | None = None,
    sensor: Sensor | None = None,
    prefix: str = "",
) -> Plant:
    """The plant with effects of `KINDS` around its simulation, beside those it has.

    names : of `KINDS`, or "all" that apply: those of the body where its motion is stated; lag, delay and gain
        of a sensor where there are several outputs (with one, they look like those of the actuator).
    dt_s : sampling period.
    actuator : whose command effects change; None: the first input.
    body : that friction and springs act on; a `MeasuredBody` of a simulation that gives the force which a
        measured motion takes, as the output of the `sensor`.
    sensor : whose output effects change; None: the motion of the body, else the first output.
    prefix : before the names, where this is asked of several inputs, bodies or sensors.

    Warns where springs and viscous friction have fewer than six samples per period, or the response to a
    pulse of force is not of a few poles.

    Raises ValueError, one line: no experiment, an unknown name, column or output, a command of zeros, a
    simulation that friction and springs cannot be put around.
    """
    if not experiments:
        raise ValueError("plant: with_effects needs at least one experiment, whose signals give the sizes")
    for name in () if names == "all" else names:
        if name not in KINDS:
            raise ValueError(f"plant: no listed effect is called {name!r}; there are {', '.join(KINDS)}")
    drive = actuator or Actuator()
    signal = None if drive.drive is None else _column(plant, drive.drive)
    drive = replace(drive, drive=signal, dt_s=dt_s)
    force = body.force if isinstance(body, Body) and body.force is not None else drive.column
    measured = (body.position, body.speed) if isinstance(body, MeasuredBody) else ()
    n_inputs = experiments[0].input.shape[1]
    for column in (drive.column, force, *measured):
        if not 0 <= column < n_inputs:
            raise ValueError(f"plant: there is no input {column}; the records have {n_inputs}, from 0 on")
    seen = 0 if sensor is None else _column(plant, sensor.column)
    if not 0 <= seen < len(plant.output_names):
        listed = ", ".join(plant.output_names)
        raise ValueError(f"plant: the sensor is output {seen}; those there are, from 0 on: {listed}")
    commanded = None if signal is None else _largest(_motion(plant, e, signal) for e in experiments)
    sizes = Magnitudes()
    if isinstance(body, Body):
        moving = _column(plant, body.motion)
        seen = moving if sensor is None and moving < len(plant.output_names) else seen
        largest = body.largest_force or (commanded if force == drive.column else None)
        sizes = _of_body(plant, experiments, dt_s, force, moving, body.motion_is, largest)
        body = replace(body, motion=moving, force=force, largest_force=sizes.force, dt_s=dt_s)
    elif body is not None:
        sizes = Magnitudes(
            force=_largest(e.output[:, seen] for e in experiments),
            position=_largest(e.input[:, body.position] for e in experiments),
            speed=_largest(e.input[:, body.speed] for e in experiments),
        )
        body = body.of(seen, [e.input for e in experiments])
    given = sizes.force if body and force == drive.column else None
    sizes = replace(
        sizes,
        input=commanded or given or _largest(e.input[:, drive.column] for e in experiments),
        output=_largest(e.output[:, seen] - np.mean(e.output[:, seen]) for e in experiments),
        reading=_largest(e.output[:, seen] for e in experiments),
        dt_s=dt_s,
        duration_s=dt_s * max(len(e.input) for e in experiments),
    )
    # Of a motion that is given nothing is driven.
    places: dict[Where, Place | None] = {
        "input": None if isinstance(body, MeasuredBody) else drive,
        "output": Sensor(seen, dt_s),
        "body": body,
    }
    found = list(plant.effects)
    own = {effect.name for effect in plant.effects}
    alone = len(plant.output_names) == 1
    every = [one for one in KINDS.values() if one.tried == "always" or (one.tried != "by name" and not alone)]
    here = [kind for kind in every if places[kind.law.where] is not None and prefix + kind.name not in own]
    chosen = here if names == "all" else [KINDS[name] for name in names]
    for kind in chosen:
        place = places[kind.law.where]
        if place is None or (kind.law.where == "input" and not sizes.input > 0):
            raise ValueError(f"plant: {kind.name} {_MISSING[kind.law.where]}")
        found.append(
            replace(
                kind.at(sizes),
                name=prefix + kind.name,
                contains=kind.contains and prefix + kind.contains,
                place=place,
            )
        )
    there = {effect.name for effect in found}
    inactive = dict(plant.inactive)
    if names == "all":
        unmoved = [kind for kind in every if kind.law.where == "body" and body is None]
        inactive |= {prefix + kind.name: _NEEDS_MOTION for kind in unmoved}
    inactive = {name: needs for name, needs in inactive.items() if name not in there}
    equipped = replace(plant, effects=tuple(found), dt_s=dt_s, inactive=inactive)
    for effect in equipped.effects if body is not None else ():
        if effect.place is not body:
            continue
        candidate = effect.candidates()[0]
        moderate = candidate.effect_at(np.array(candidate.starts[len(candidate.starts) // 2]))
        if not np.all(np.isfinite(equipped.simulated([moderate])(experiments[0].input))):
            raise ValueError(
                f"plant: {effect.name} cannot be put around this simulation (experiment "
                f"{experiments[0].name}: its force and the motion do not settle); write its equation into it"
            )
    smooth = [
        kind.name
        for kind in chosen
        if kind.law.where == "body"
        and kind.law.change({one.name: one.high for one in kind.parameters}).smooth
    ]
    if smooth and isinstance(body, Body) and body.doubt:
        warnings.warn(
            f"plant: after a pulse of force the motion {body.doubt}, so that {' and '.join(smooth)} are some "
            "per cent off; sample finer or write their equations into it",
            stacklevel=2,
        )
    return equipped


def _column(plant: Plant, output: str | int) -> int:
    if isinstance(output, int):
        return output
    if output not in plant.output_names:
        raise ValueError(f"plant: no output is called {output!r}; there are {', '.join(plant.output_names)}")
    return plant.output_names.index(output)


def _largest(signals: Iterable[Real]) -> float:
    return max(float(np.max(np.abs(signal))) for signal in signals)


def _of_body(
    plant: Plant,
    experiments: Sequence[PlantExperiment],
    dt_s: float,
    force: int,
    motion: int,
    motion_is: str,
    largest_force: float | None,
) -> Magnitudes:
    pushed = largest_force or _largest(e.input[:, force] for e in experiments)
    if not pushed > 0:
        raise ValueError(
            f"plant: input {force} is zero in every record: state largest_force= of the body for its sizes"
        )
    moved = [_motion(plant, e, motion) for e in experiments]
    if motion_is == "speed":
        position, speed = _largest(np.cumsum(v) * dt_s for v in moved), _largest(moved)
    else:
        smooth = (scipy.signal.savgol_filter(x, _SMOOTHED, 2, deriv=1, delta=dt_s) for x in moved)
        position, speed = _largest(moved), _largest(smooth)
    return Magnitudes(force=pushed, position=position, speed=speed)


def _motion(plant: Plant, experiment: PlantExperiment, column: int) -> Real:
    if column < 0:
        raise ValueError(f"plant: motion or drive is column {column}; columns count from 0 on")
    if column < len(plant.output_names):
        return experiment.output[:, column]
    simulated = np.asarray(plant.simulation(plant.parameters, {}, experiment.input))
    if simulated.ndim != 2 or simulated.shape[1] <= column:
        raise ValueError(
            f"plant: motion or drive is column {column} of a simulation that returns {simulated.shape}"
        )
    return np.asarray(simulated[:, column])
