"""Listed effects around a simulation that knows none of them.

plant = with_effects(plant, "all", experiments, dt_s=0.01, motion="position_m")
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy

from diagnosis.machine.around import AnyBody, Body, Drive, MeasuredBody, Place, Where
from diagnosis.machine.listed_effects import KINDS, Magnitudes
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.motion_effects import BodyForces
from diagnosis.machine.own_plant import Plant, PlantExperiment
from diagnosis.machine.plant_effect import PlantEffect

_MISSING = {
    "input": "changes a command, and the stated input is none or zero in every record",
    "body": "needs motion=, the output that is the body's position or speed",
}
_NEEDS_MOTION = "motion: the output that is the body's motion"
_SMOOTHED = 11  # samples, of a measured position whose speed is asked


def with_effects(
    plant: Plant,
    names: Sequence[str] | Literal["all"],
    experiments: Sequence[PlantExperiment],
    *,
    dt_s: float,
    input: int = 0,  # noqa: A002
    drive: str | int | None = None,
    force: int | None = None,
    motion: str | int | None = None,
    motion_is: Literal["position", "speed"] = "position",
    measured_motion: tuple[int, int] | None = None,
    output: str | None = None,
    largest_force: float | None = None,
    at_rest_before: bool = True,
    prefix: str = "",
) -> Plant:
    """The plant with effects of `KINDS` around its simulation, beside those it has.

    names : of `KINDS`, or "all" that apply: those of the body where its motion is stated; lag, delay and gain
        of a sensor where there are several outputs (with one, they look like those of the actuator).
    dt_s : sampling period.
    input : column of the command that effects of an actuator change.
    drive : of a loop that the simulation closes: output, or column of what it returns, that is the command of
        its drive. The simulation adds `input`, zeros in records, to it; effects of the actuator act there.
    force : column of the force on the body, held over each sample; default `input`.
    motion : output, or column of what the simulation returns (beyond the outputs: a motion nobody measured),
        of the body that friction and springs act on.
    measured_motion : in place of it columns of position and speed among the inputs, of a simulation that
        gives the force which that motion takes as its `output`.
    output : that effects of a sensor change; default the motion, else the first.
    largest_force : for ranges, where the column of the force is zero in the records.
    at_rest_before : before its first row a command is zero; else as in that row.
    prefix : before the names, where this is asked of several inputs, bodies or sensors.

    Warns where springs and viscous friction have fewer than six samples per period, or the response to a
    pulse of force is not of a few poles.

    Raises ValueError, one line: an unknown name, column or output, a command of zeros, a simulation that
    friction and springs cannot be put around.
    """
    for name in () if names == "all" else names:
        if name not in KINDS:
            raise ValueError(f"plant: no listed effect is called {name!r}; there are {', '.join(KINDS)}")
    force = input if force is None else force
    for column in (input, force, *(measured_motion or ())):
        if not 0 <= column < experiments[0].input.shape[1]:
            count = experiments[0].input.shape[1]
            raise ValueError(f"plant: there is no input {column}; the records have {count}, from 0 on")
    seen = 0 if output is None else _column(plant, output)
    commanded = 0.0
    if drive is not None:
        signal = drive if isinstance(drive, int) else _column(plant, drive)
        commanded = _largest(_motion(plant, e, signal) for e in experiments)
        largest_force = largest_force or (commanded if force == input else None)
    body: AnyBody | None = None
    if motion is not None:
        moving = motion if isinstance(motion, int) else _column(plant, motion)
        seen = moving if output is None and moving < len(plant.output_names) else seen
        sizes = _of_body(plant, experiments, dt_s, force, moving, motion_is, largest_force)
        body = Body(force, moving, motion_is == "speed", dt_s, sizes.force)
    elif measured_motion is not None:
        sizes = Magnitudes(
            force=_largest(e.output[:, seen] for e in experiments),
            position=_largest(e.input[:, measured_motion[0]] for e in experiments),
            speed=_largest(e.input[:, measured_motion[1]] for e in experiments),
        )
        body = MeasuredBody.of(*measured_motion, seen, [e.input for e in experiments])
    else:
        sizes = Magnitudes()
    sizes = replace(
        sizes,
        input=sizes.force if body and input == force else _largest(e.input[:, input] for e in experiments),
        output=_largest(e.output[:, seen] - np.mean(e.output[:, seen]) for e in experiments),
        reading=_largest(e.output[:, seen] for e in experiments),
        dt_s=dt_s,
        duration_s=dt_s * max(len(e.input) for e in experiments),
    )
    places: dict[Where, int | AnyBody | Drive | None] = {"input": input, "output": seen, "body": body}
    if drive is not None:
        places["input"] = Drive(input, signal, dt_s, at_rest_before)
        sizes = replace(sizes, input=commanded)
    if measured_motion is not None:
        places["input"] = None
    found = list(plant.effects)
    own = {effect.name for effect in plant.effects}
    every = _of_all(plant)
    here = [kind for kind in every if places[kind.where] is not None and prefix + kind.name not in own]
    chosen = here if names == "all" else [KINDS[name] for name in names]
    for kind in chosen:
        on = places[kind.where]
        if on is None or (kind.where == "input" and not sizes.input > 0):
            raise ValueError(f"plant: {kind.name} {_MISSING[kind.where]}")
        found.append(
            replace(
                kind.at(sizes),
                name=prefix + kind.name,
                contains=kind.contains and prefix + kind.contains,
                place=Place(on, dt_s, at_rest_before),
            )
        )
    there = {effect.name for effect in found}
    inactive = dict(plant.inactive)
    if names == "all":
        # Of the actuator nothing applies where a motion is given: none drives it.
        unmoved = [kind for kind in every if kind.where == "body" and body is None]
        inactive |= {prefix + kind.name: _NEEDS_MOTION for kind in unmoved}
    inactive = {name: needs for name, needs in inactive.items() if name not in there}
    equipped = replace(plant, effects=tuple(found), dt_s=dt_s, inactive=inactive)
    _try(equipped, experiments[0], body)
    smooth = [kind.name for kind in chosen if _is_smooth(kind)]
    if smooth and isinstance(body, Body) and body.doubt:
        warnings.warn(
            f"plant: after a pulse of force the motion {body.doubt}, so that {' and '.join(smooth)} are some "
            "per cent off; sample finer or write their equations into it",
            stacklevel=2,
        )
    return equipped


def _of_all(plant: Plant) -> list[PlantEffect]:
    tried = ("always", "with several outputs") if len(plant.output_names) > 1 else ("always",)
    return [kind for kind in KINDS.values() if kind.tried in tried]


def _is_smooth(kind: PlantEffect) -> bool:
    """Whether it is a force that changes little within a sample."""
    if kind.law is None or kind.law.where != "body":
        return False
    forces = kind.law.forces({parameter.name: parameter.high for parameter in kind.parameters})
    return replace(BodyForces(), **forces).smooth


def _column(plant: Plant, output: str) -> int:
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
            f"plant: input {force} is zero in every record: friction needs largest_force= for its sizes"
        )
    moved = [_motion(plant, e, motion) for e in experiments]
    if motion_is == "speed":
        position, speed = _largest(np.cumsum(v) * dt_s for v in moved), _largest(moved)
    else:
        smooth = (scipy.signal.savgol_filter(x, _SMOOTHED, 2, deriv=1, delta=dt_s) for x in moved)
        position, speed = _largest(moved), _largest(smooth)
    return Magnitudes(force=pushed, position=position, speed=speed)


def _motion(plant: Plant, experiment: PlantExperiment, column: int) -> Real:
    if column < len(plant.output_names):
        return experiment.output[:, column]
    simulated = np.asarray(plant.simulation(plant.parameters, {}, experiment.input))
    if simulated.ndim != 2 or simulated.shape[1] <= column:
        raise ValueError(
            f"plant: motion= or drive= is column {column} of a simulation that returns {simulated.shape}"
        )
    return np.asarray(simulated[:, column])


def _try(plant: Plant, experiment: PlantExperiment, body: AnyBody | None) -> None:
    """Raises ValueError where the simulation does not follow a moderate force on the body."""
    for effect in plant.effects:
        if effect.place is None or effect.place.on is not body:
            continue
        candidate = effect.candidates()[0]
        change = candidate.effect_at(np.array(candidate.starts[len(candidate.starts) // 2]))
        if not np.all(np.isfinite(plant.simulated([change])(experiment.input))):
            raise ValueError(
                f"plant: {effect.name} cannot be put around this simulation (experiment {experiment.name}: "
                "its force and the motion do not settle); write its equation into it"
            )
