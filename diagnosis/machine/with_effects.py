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
from diagnosis.machine.plant_effect import PlantEffect
from ident.data.units import size_of, written_unit

# Where an effect acts -> why it cannot.
_MISSING = {
    "input": "changes a command, and the stated input is none or zero in every record",
    "body": "needs body=Body(motion), the output that is its position or speed",
}
_NEEDS_MOTION = "motion: the output that is the body's motion"
# Kinds of units of what is no motion: two parts between which there is play move against each other, and
# what drives or loads them jumps instead.
_NO_MOTION = frozenset({"N", "Nm", "A", "V", "W", "Pa"})
# Samples of a measured position that a parabola is fitted to for its speed: noise of a difference of
# neighbours is fifteen times as large.
_SMOOTHED = 11


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

    Warns where springs and viscous friction have fewer than six samples per period, or the response to a
    pulse of force is not of a few poles.

    Parameters
    ----------
    plant : Plant
    names : sequence of str or "all"
        Of `KINDS`, or all that apply: those of the body where its motion is stated; lag, delay and gain of a
        sensor where there are several outputs (with one, they look like those of the actuator).
    experiments : sequence of PlantExperiment
        Records, whose magnitudes give the ranges.
    dt_s : float
        Sampling period.
    actuator : Actuator or None
        Whose command effects change; None: the first input.
    body : Body, MeasuredBody or None
        That friction and springs act on; a `MeasuredBody` of a simulation that gives the force which a
        measured motion takes, as the output of the `sensor`.
    sensor : Sensor or None
        Whose output effects change; None: the motion of the body, else the first output.
    prefix : str
        Before the names, where this is asked of several inputs, bodies or sensors.

    Returns
    -------
    Plant

    Raises
    ------
    ValueError
        One line: no experiment, an unknown name, column or output, a command of zeros, a simulation that
        friction and springs cannot be put around.
    """
    if not experiments:
        raise ValueError("plant: with_effects needs at least one experiment, whose signals give the sizes")
    for name in () if names == "all" else names:
        if name not in KINDS:
            raise ValueError(f"plant: no listed effect is called {name!r}; there are {', '.join(KINDS)}")

    # Columns of the command, of the force, of the motion and of the output, by number.
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

    # Magnitudes that ranges are multiples of.
    commanded = None if signal is None else _largest(_motion(plant, e, signal) for e in experiments)
    sizes = Magnitudes()
    if isinstance(body, Body):
        motion = _column(plant, body.motion)
        if sensor is None and motion < len(plant.output_names):
            seen = motion
        largest = body.largest_force or (commanded if force == drive.column else None)
        sizes = _of_body(plant, experiments, dt_s, force, motion, body.motion_is, largest)
        body = replace(body, motion=motion, force=force, largest_force=sizes.force, dt_s=dt_s)
    elif body is not None:
        sizes = Magnitudes(
            force=_largest(e.output[:, seen] for e in experiments),
            position=_largest(e.input[:, body.position] for e in experiments),
            speed=_largest(e.input[:, body.speed] for e in experiments),
        )
        body = body.of(seen, [e.input for e in experiments])
    force_as_command = sizes.force if body and force == drive.column else None
    sizes = replace(
        sizes,
        input=commanded or force_as_command or _largest(e.input[:, drive.column] for e in experiments),
        output=_largest(e.output[:, seen] - np.mean(e.output[:, seen]) for e in experiments),
        reading=_largest(e.output[:, seen] for e in experiments),
        dt_s=dt_s,
        duration_s=dt_s * max(len(e.input) for e in experiments),
    )

    # Effects at their places; of a motion that is given nothing is driven.
    places: dict[Where, Place | None] = {
        "input": None if isinstance(body, MeasuredBody) else drive,
        "output": Sensor(seen, dt_s),
        "body": body,
    }
    known = {effect.name for effect in plant.effects}
    usual = _tried(several_outputs=len(plant.output_names) > 1)
    if names == "all":
        chosen = []
        for kind in usual:
            has_place = places[kind.law.where] is not None
            cannot_act = kind.name == "backlash" and _is_no_motion(plant, seen)
            if has_place and not cannot_act and prefix + kind.name not in known:
                chosen.append(kind)
    else:
        chosen = [KINDS[name] for name in names]
    effects = list(plant.effects)
    for kind in chosen:
        place = places[kind.law.where]
        if place is None or (kind.law.where == "input" and not sizes.input > 0):
            raise ValueError(f"plant: {kind.name} {_MISSING[kind.law.where]}")
        effects.append(
            replace(
                kind.at(sizes),
                name=prefix + kind.name,
                contains=kind.contains and prefix + kind.contains,
                place=place,
            )
        )

    # What would need a motion is told as such where all were asked for.
    inactive = dict(plant.inactive)
    if names == "all" and body is None:
        inactive |= {prefix + kind.name: _NEEDS_MOTION for kind in usual if kind.law.where == "body"}
    present = {effect.name for effect in effects}
    inactive = {name: needs for name, needs in inactive.items() if name not in present}
    equipped = replace(plant, effects=tuple(effects), dt_s=dt_s, inactive=inactive)
    if body is not None:
        _refuse_unsettled(equipped, body, experiments[0])
    if isinstance(body, Body):
        _warn_of_doubt(body, chosen)
    return equipped


def _tried(*, several_outputs: bool) -> list[PlantEffect]:
    """Rows of `KINDS` that are tried where nobody chose them."""
    when = ("always", "with several outputs") if several_outputs else ("always",)
    return [kind for kind in KINDS.values() if kind.tried in when]


def _refuse_unsettled(plant: Plant, body: Body | MeasuredBody, experiment: PlantExperiment) -> None:
    """Raises ValueError where a moderate effect of a body does not settle in a record."""
    for effect in plant.effects:
        if effect.place is not body:
            continue
        candidate = effect.candidates()[0]
        middle = candidate.starts[len(candidate.starts) // 2]
        moderate = candidate.effect_at(np.array(middle))
        if not np.all(np.isfinite(plant.simulated([moderate])(experiment.input))):
            raise ValueError(
                f"plant: {effect.name} cannot be put around this simulation (experiment "
                f"{experiment.name}: its force and the motion do not settle); write its equation into it"
            )


def _warn_of_doubt(body: Body, chosen: Sequence[PlantEffect]) -> None:
    """Warns where smooth forces among the chosen effects act less exactly on a body (`Body.doubt`)."""
    smooth = []
    for kind in chosen:
        if kind.law.where != "body":
            continue
        largest = {parameter.name: parameter.high for parameter in kind.parameters}
        if kind.law.change(largest).smooth:
            smooth.append(kind.name)
    if smooth and body.doubt:
        warnings.warn(
            f"plant: after a pulse of force the motion {body.doubt}, so that {' and '.join(smooth)} are some "
            "per cent off; sample finer or write their equations into it",
            stacklevel=3,
        )


def _is_no_motion(plant: Plant, output: int) -> bool:
    """Whether the unit of an output is that of a force, a torque, a current, a voltage, power or pressure."""
    name = plant.output_names[output]
    size = size_of(plant.units.get(name) or written_unit(name))
    return size is not None and size.kind in _NO_MOTION


def _column(plant: Plant, output: str | int) -> int:
    """Column of an output that is given by name, or the column that is given. Raises ValueError for a name
    that no output has."""
    if isinstance(output, int):
        return output
    if output not in plant.output_names:
        raise ValueError(f"plant: no output is called {output!r}; there are {', '.join(plant.output_names)}")
    return plant.output_names.index(output)


def _largest(signals: Iterable[Real]) -> float:
    """Largest size in any of several signals (T,)."""
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
    """Largest force, position and speed of a body in the records.

    force : column of the inputs. motion : of the outputs, or beyond. largest_force : in place of what the
    records have. Raises ValueError for a force of zeros.
    """
    size = largest_force or _largest(e.input[:, force] for e in experiments)
    if not size > 0:
        raise ValueError(
            f"plant: input {force} is zero in every record: state largest_force= of the body for its sizes"
        )
    motions = [_motion(plant, e, motion) for e in experiments]
    if motion_is == "speed":
        position = _largest(np.cumsum(speed) * dt_s for speed in motions)
        return Magnitudes(force=size, position=position, speed=_largest(motions))
    speeds = (scipy.signal.savgol_filter(x, _SMOOTHED, 2, deriv=1, delta=dt_s) for x in motions)
    return Magnitudes(force=size, position=_largest(motions), speed=_largest(speeds))


def _motion(plant: Plant, experiment: PlantExperiment, column: int) -> Real:
    """(T,) a column of the outputs as measured, or one behind them as simulated.

    Raises ValueError for a column that is nowhere.
    """
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
