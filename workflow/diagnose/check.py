"""`flexlink check`: what logs of a simulator's model can tell, before anything is fitted to them."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.probed import doubtful_columns
from diagnosis.machine.telling import Telling, telling
from workflow.describe.check import Candidates, LogSeen, check_sections
from workflow.describe.summary import RunSummary
from workflow.diagnose.case_settings import case_document
from workflow.diagnose.simulator_case import SimulatorCase, load_simulator_case
from workflow.diagnose.simulator_settings import SimulatorSettings, is_simulator, settings_of
from workflow.engine import codec
from workflow.engine.errors import InputError
from workflow.text.formats import listing

# Groups that are shown, those that are most alike; what a next record needs.
_MOST_SHOWN, _MOST_ADVICE = 8, 6
_NAMED = 2  # groups that one sentence of advice names: it stays a sentence
# A command with more values than these may be cut that is at the ends of its range for this share of the
# time, and at one of them so many times longer than at other levels that it holds.
_VALUES, _LIMITED, _LONGER = 20, 0.02, 3.0
# A limit is met in motion: by at least this share of a usual step. A set point settles at its level.
_MET = 0.05
_INERTIAL = ("mass", "inertia", "armature", "damping", "payload", "frictionloss")


def check(place: Path | SimulatorSettings, time_limit_s: float = np.inf) -> RunSummary:
    """Logs, smallest sizes that show, what acts alike, what a record would have to do. Raises InputError."""
    deadline_s = time.monotonic() + time_limit_s
    if isinstance(place, SimulatorSettings):
        loaded = load_simulator_case(place, Path(), "--log")
        stated = place.model_dump(exclude_defaults=True)
        words = []
        for key, value in stated.items():
            for one in value if isinstance(value, (list, tuple)) else [value]:
                words += [f"--{key.replace('_', '-')}", *([] if one is True else [str(one)])]
    else:
        file, document = case_document(place)
        if not is_simulator(document):
            raise InputError(f"{file}: names no simulator's model; of a log alone: flexlink look LOG")
        loaded = load_simulator_case(settings_of(document, str(file)), file.parent, str(file))
        words = [str(file)]
    told = of_case(loaded, telling(loaded.case, deadline_s))
    return replace(
        told, verdict=f"{told.verdict}. Next: {shlex.join(['flexlink', 'diagnose', *words])} --out found"
    )


def of_case(loaded: SimulatorCase, found: Telling) -> RunSummary:
    """The same of a case that is loaded."""
    case = loaded.case
    of = getattr(case.plant.simulation, "quantities", {})  # of MuJoCo, whose names have no units
    logs = [_log(loaded, k) for k in range(len(case.experiments))]
    doubts = (*loaded.doubts, *doubtful_columns(case))
    # A stated value goes by its own name unless an effect, tried or not, is called so.
    effects = {effect.name for effect in case.plant.effects} | set(case.plant.inactive)
    untried = {}
    for name, needs in case.plant.inactive.items():
        value = name.removeprefix("wrong_")
        untried[name if value in effects else value] = needs
    alike = tuple(sorted(found.alike, key=lambda one: (len(one.names), one.left)))
    shown = dict(sorted(found.least.items(), key=lambda item: item[1]))
    first = replace(found, least=shown, alike=alike[:_MOST_SHOWN])
    sizes = {
        effect.name: loaded.units.get(effect.name, {}).get(size, size)
        for effect in case.plant.effects
        for size in [effect.parameters[0].name]
    }
    values = {}
    for name, key in case.plant.value_candidates.items():
        with_unit = key
        if key in of:
            with_unit = next((parameter.name for parameter in of[key].parameters), "")
        values[name] = (case.plant.value(key), with_unit)
    limits = [effect.name for effect in case.plant.effects if not effect.grows]
    advice = list(dict.fromkeys(_advice(first)))[:_MOST_ADVICE]
    return RunSummary(
        title=case.name,
        sections=check_sections(
            logs,
            case.dt_s,
            case.units,
            doubts,
            first,
            Candidates(sizes, values, limits, untried),
            advice,
            groups_left_out=len(alike) - len(first.alike),
        ),
        numbers={"logs": codec.plain(logs), "doubts": list(doubts), **codec.plain(found), "advice": advice},
        verdict=f"{len(shown) - len(found.hidden)} of {len(shown)} candidates show"
        + (
            f"; {len(alike)} groups of them look alike in these records, if one of them is present. "
            "The diagnosis says which of them it leaves open"
            if alike
            else ""
        ),
    )


def _log(loaded: SimulatorCase, k: int) -> LogSeen:
    case = loaded.case
    e, limited = case.experiments[k], {}
    for name, command in zip(loaded.inputs, e.input.T, strict=False):  # behind them what was measured
        if share := _at_ends(command):
            limited[name] = share
    motion = np.std(e.output, axis=0)
    outputs = tuple(zip(case.outputs, map(float, motion), map(float, case.noise), strict=True))
    return LogSeen(e.name, e.role, len(e.output), outputs, limited)


def _at_ends(command: Real) -> float:
    """Share of the time that a command is at the ends of its range, 1 if it never moves; 0 unless it may be
    cut off there: one of held levels is at every level for as long."""
    values, level, counts = np.unique(command, return_inverse=True, return_counts=True)
    if values.size == 1:
        return 1.0
    share = float(counts[[0, -1]].sum() / command.size)
    steps = np.diff(command)
    begins = np.flatnonzero(np.r_[True, steps != 0])
    lengths, ends = np.diff(np.r_[begins, command.size]), np.isin(level[begins], [0, values.size - 1])
    held = level[begins[~ends & (lengths >= np.max(lengths[ends]) / _LONGER)]]
    longer = max(counts[[0, -1]]) > _LONGER * (np.median(counts[held]) if held.size else 1)
    met = np.abs(steps[begins[ends & (begins > 0)] - 1])
    sharp = met.size and np.median(met) > _MET * np.sqrt(np.mean(steps**2))
    return min(share, 0.99) if share > _LIMITED and values.size > _VALUES and longer and sharp else 0.0


def _advice(found: Telling) -> Iterator[str]:
    """What would tell apart what acts alike, most alike first, then show what is hidden; for every group the
    first that fits."""
    rest: list[str] = []
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
            rest.append(listing(one.names))
    if rest:
        more = f" and {len(rest) - _NAMED} more groups" if len(rest) > _NAMED else ""
        yield (
            f"for {'; '.join(rest[:_NAMED])}{more}: record at another speed and amplitude, or exclude "
            "what you know is as stated (exclude = [...] in the case file)"
        )
    if found.hidden:
        yield f"for {listing(found.hidden)}: move what they act on farther or faster"
