"""`flexlink check`: what logs of a simulator's model can tell, before anything is fitted to them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diagnosis.machine.own_plant import PlantCase
from diagnosis.machine.telling import Telling, telling
from workflow.diagnose.case_settings import case_document
from workflow.diagnose.simulator_case import (
    SimulatorSettings,
    is_simulator,
    load_simulator_case,
    settings_of,
)
from workflow.diagnose.words import FILTERS
from workflow.engine import codec
from workflow.engine.errors import InputError
from workflow.text.formats import listing
from workflow.text.templates import RunSummary, rows_of

# Groups that are shown, those that are most alike; candidates of every list; what a next record needs.
_MOST_SHOWN, _MOST_LISTED, _MOST_ADVICE = 8, 20, 6
# A command with more values than these that is at an end of its range for this share of the time may be cut.
_VALUES, _LIMITED = 20, 0.02
_INERTIAL = ("mass", "inertia", "armature", "damping", "payload", "frictionloss")


def check(place: Path | SimulatorSettings, time_limit_s: float = np.inf) -> RunSummary:
    """Logs, smallest sizes that show, what acts alike, what a record would have to do. Raises InputError."""
    deadline_s = time.monotonic() + time_limit_s
    if isinstance(place, SimulatorSettings):
        case = load_simulator_case(place, Path(), "--log").case
    else:
        file, document = case_document(place)
        if not is_simulator(document):
            raise InputError(f"{file}: names no simulator's model; of a log alone: flexlink look LOG")
        case = load_simulator_case(settings_of(document, str(file)), file.parent, str(file)).case
    return of_case(case, telling(case, deadline_s))


def of_case(case: PlantCase, found: Telling) -> RunSummary:
    """The same of a case that is loaded."""
    logs = [_log(case, k) for k in range(len(case.experiments))]
    alike = tuple(sorted(found.alike, key=lambda one: (len(one.names), one.left)))
    shown = dict(sorted(found.least.items(), key=lambda item: item[1]))
    first = replace(found, least=shown, alike=alike[:_MOST_SHOWN])
    told = {
        "logs": logs,
        "dt_s": case.dt_s,
        "telling": first,
        "shows": [name for name in shown if name not in found.hidden],
        "most": _MOST_LISTED,
        "more": len(alike) - len(first.alike),
        "sizes": {effect.name: effect.parameters[0].name for effect in case.plant.effects},
        "values": dict(case.plant.parameters),
        "untried": dict(case.plant.inactive),
        "advice": list(dict.fromkeys(_advice(first)))[:_MOST_ADVICE],
    }
    return RunSummary(
        title=case.name,
        sections=rows_of("summary/check.j2", FILTERS.items(), **told),
        numbers={"logs": codec.plain(logs), **codec.plain(found), "advice": told["advice"]},
        verdict=f"{len(shown) - len(found.hidden)} of {len(shown)} candidates show, {len(alike)} groups of "
        "them act alike",
    )


def _log(case: PlantCase, k: int) -> dict[str, Any]:
    e, limited = case.experiments[k], {}
    for u, command in enumerate(e.input.T[: e.input.shape[1] - _measured(case)]):
        at_ends = float(np.mean((command == command.max()) | (command == command.min())))
        if at_ends == 1.0 or (at_ends > _LIMITED and np.unique(command).size > _VALUES):
            limited[f"command {u + 1}"] = at_ends if np.ptp(command) == 0 else min(at_ends, 0.99)
    motion = np.std(e.output, axis=0)
    outputs = list(zip(case.outputs, map(float, motion), map(float, case.noise), strict=True))
    return {"name": e.name, "role": e.role, "samples": len(e.output), "outputs": outputs, "limited": limited}


def _measured(case: PlantCase) -> int:
    """Columns of the inputs behind the commands that hold what was measured."""
    e = case.experiments[0]
    Y = e.output.shape[1]
    return Y if e.input.shape[1] > Y and np.array_equal(e.input[:, -Y:], e.output) else 0


def _advice(found: Telling) -> Iterator[str]:
    """What would tell apart what acts alike, and show what is hidden; for every group the first that fits."""
    for one in found.alike:
        last = {name: name.rpartition(".")[2] for name in one.names}
        of = {
            kind: [name.rpartition(".")[0] for name in last if last[name] == kind] for kind in last.values()
        }
        if "gain" in of and set(of) & set(_INERTIAL):
            yield (
                f"{listing(one.names)} scale together: repeat a record with a known mass on it, or measure "
                f"the force of {listing(of['gain'])}"
            )
        elif "sensor_gain" in of:
            yield f"move {listing(of['sensor_gain'])} by a known distance and compare the reading"
        elif "sensor_offset" in of:
            yield f"go to a known position of {listing(of['sensor_offset'])} and compare the reading"
        elif set(of) & {"delay", "lag", "sensor_delay"}:
            yield f"for {listing(one.names)}: step the command from rest, at a higher sampling rate"
        elif "frictionloss" in of:
            yield f"for {listing(one.names)}: hold several steady speeds, in both directions"
        elif set(of) <= {"mass", "payload", "inertia"}:
            yield f"for {listing(one.names)}: weigh one of them"
        else:
            yield f"for {listing(one.names)}: state one of them, or record at another speed and amplitude"
    if found.hidden:
        yield f"for {listing(found.hidden)}: move what they act on farther or faster"
