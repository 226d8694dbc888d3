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

# Groups that are shown, those that are most alike. Chosen: what fits on a screen; the JSON answer has all.
_MOST_SHOWN = 8
# Sentences of advice on the next record. Chosen: nobody records more than these at once.
_MOST_ADVICE = 6
# Groups that one sentence of advice names: it stays a sentence.
_NAMED = 2
# A command that takes no more levels than these is a staircase or a square wave, not one that was cut.
# Chosen: a random command has a level a sample, an experiment with steps rarely more than twenty.
_MOST_LEVELS = 20
# Share of the time at the ends of the range from which on a command may be cut there. Chosen: below it, what
# is lost is small beside the motion; any command is at its two extreme values for a sample each.
_LIMITED = 0.02
# How many times longer a cut command stays at an end than at the other levels that it holds. Chosen: a
# staircase stays at all its levels for about as long.
_LONGER = 3.0
# A limit is met in motion: by at least this share of a usual step. A set point settles at its level.
_MET = 0.05
# A share of the time of less than 1 that is told of a command that moves: 1 is said of one that never does.
_MOST_OF_A_MOVING_ONE = 0.99
# Last parts of names of effects that a command's gain makes up for: forces that all scale together.
_INERTIAL = ("mass", "inertia", "armature", "damping", "payload", "frictionloss")


def check(place: Path | SimulatorSettings, time_limit_s: float = np.inf) -> RunSummary:
    """Logs, smallest sizes that show, what acts alike, what a record would have to do. Raises InputError."""
    deadline_s = time.monotonic() + time_limit_s
    if isinstance(place, SimulatorSettings):
        loaded = load_simulator_case(place, Path(), "--log")
        stated = place.model_dump(exclude_defaults=True)
        words = []
        for key, value in stated.items():
            for typed in value if isinstance(value, (list, tuple)) else [value]:
                words.append(f"--{key.replace('_', '-')}")
                # A switch stands for itself: it takes no value.
                if typed is not True:
                    words.append(str(typed))
    else:
        file, document = case_document(place)
        if not is_simulator(document):
            raise InputError(f"{file}: names no simulator's model; of a log alone: flexlink look LOG")
        loaded = load_simulator_case(settings_of(document, str(file)), file.parent, str(file))
        words = [str(file)]
    summary = of_case(loaded, telling(loaded.case, deadline_s))
    command = shlex.join(["flexlink", "diagnose", *words])
    return replace(summary, verdict=f"{summary.verdict}. Next: {command} --out found")


def of_case(loaded: SimulatorCase, seen: Telling) -> RunSummary:
    """What the logs of a case can tell, as sections, numbers and a verdict of one sentence or two.

    Parameters
    ----------
    loaded : SimulatorCase
    seen : Telling
        Of `loaded.case`: the smallest size of each candidate that shows, and groups that act alike.

    Returns
    -------
    RunSummary
        Its numbers hold all groups; its sections the first `_MOST_SHOWN`, the most alike ones.
    """
    case = loaded.case
    # Only a MuJoCo model has them: its names of values say nothing of their units.
    quantities = getattr(case.plant.simulation, "quantities", {})
    logs = [_log(loaded, k) for k in range(len(case.experiments))]
    doubts = (*loaded.doubts, *doubtful_columns(case))
    # A stated value goes by its own name unless an effect, tried or not, is called so.
    effects = {effect.name for effect in case.plant.effects} | set(case.plant.inactive)
    untried = {}
    for name, needs in case.plant.inactive.items():
        value = name.removeprefix("wrong_")
        untried[name if value in effects else value] = needs
    # Pairs before larger groups, the most alike first: whoever stops reading has seen the strongest.
    alike = tuple(sorted(seen.alike, key=lambda group: (len(group.names), group.left)))
    by_size = dict(sorted(seen.least.items(), key=lambda item: item[1]))
    first = replace(seen, least=by_size, alike=alike[:_MOST_SHOWN])

    # How a size is written: the first parameter of an effect with its unit, a stated value as a share of it.
    sizes = {}
    for effect in case.plant.effects:
        size = effect.parameters[0].name
        sizes[effect.name] = loaded.units.get(effect.name, {}).get(size, size)
    values = {}
    for name, key in case.plant.value_candidates.items():
        with_unit = key
        if key in quantities:
            with_unit = next((parameter.name for parameter in quantities[key].parameters), "")
        values[name] = (case.plant.value(key), with_unit)
    limits = [effect.name for effect in case.plant.effects if not effect.grows]

    # Two groups may lead to the same sentence.
    advice = list(dict.fromkeys(_advice(first)))[:_MOST_ADVICE]
    verdict = f"{len(by_size) - len(seen.hidden)} of {len(by_size)} candidates show"
    if alike:
        verdict += (
            f"; {len(alike)} groups of them look alike in these records, if one of them is present. "
            "The diagnosis says which of them it leaves open"
        )
    sections = check_sections(
        logs,
        case.dt_s,
        case.units,
        doubts,
        first,
        Candidates(sizes, values, limits, untried),
        advice,
        groups_left_out=len(alike) - len(first.alike),
    )
    numbers = {"logs": codec.plain(logs), "doubts": list(doubts), **codec.plain(seen), "advice": advice}
    return RunSummary(title=case.name, sections=sections, numbers=numbers, verdict=verdict)


def _log(loaded: SimulatorCase, k: int) -> LogSeen:
    """Length, motion and noise of the k-th log, and which of its commands may be cut off."""
    case = loaded.case
    experiment = case.experiments[k]
    limited = {}
    # The first columns of the input are the commands; behind them stands what was measured.
    for name, command in zip(loaded.inputs, experiment.input.T, strict=False):
        share = share_at_ends(command)
        if share > 0:
            limited[name] = share
    motion = np.std(experiment.output, axis=0)
    outputs = tuple(zip(case.outputs, map(float, motion), map(float, case.noise), strict=True))
    return LogSeen(experiment.name, experiment.role, len(experiment.output), outputs, limited)


def share_at_ends(command: Real) -> float:
    """Share of the time that a command (T,) is at the ends of its range, where it may be cut off there.

    Returns
    -------
    float
        1 if it never moves; 0 for one that is at its ends no longer than a staircase or a set point is.
    """
    levels, level_of, counts = np.unique(command, return_inverse=True, return_counts=True)
    if levels.size == 1:
        return 1.0
    share = float((counts[0] + counts[-1]) / command.size)
    if share <= _LIMITED or levels.size <= _MOST_LEVELS:
        return 0.0

    # Runs of equal samples, and whether each is at the lowest or at the highest level.
    steps = np.diff(command)
    begins = np.flatnonzero(np.r_[True, steps != 0])
    lengths = np.diff(np.r_[begins, command.size])
    at_end = np.isin(level_of[begins], [0, levels.size - 1])

    # A staircase holds its inner levels as long as its ends.
    least_held = np.max(lengths[at_end]) / _LONGER
    is_held = ~at_end & (lengths >= least_held)
    held = level_of[begins[is_held]]
    usual = np.median(counts[held]) if held.size else 1
    if max(counts[0], counts[-1]) <= _LONGER * usual:
        return 0.0

    # A command that settles at a set point comes to it in small steps; one that is cut stops in full motion.
    came_there = at_end & (begins > 0)
    last_steps = np.abs(steps[begins[came_there] - 1])
    if not last_steps.size:
        return 0.0
    usual_step = np.sqrt(np.mean(steps**2))
    if np.median(last_steps) <= _MET * usual_step:
        return 0.0
    return min(share, _MOST_OF_A_MOVING_ONE)


def _advice(seen: Telling) -> Iterator[str]:
    """What would tell apart what acts alike, most alike first, then show what is hidden; for every group the
    first that fits."""
    without_advice: list[str] = []
    for group in seen.alike:
        # "shoulder.gain" -> what it belongs to, by its kind: {"gain": ["shoulder"]}.
        owners: dict[str, list[str]] = {}
        for name in group.names:
            owner, _, kind = name.rpartition(".")
            owners.setdefault(kind, []).append(owner)
        kinds = set(owners)
        names = listing(group.names)
        if "gain" in kinds and kinds & set(_INERTIAL):
            yield (
                f"{names} scale together: repeat a record with a known mass on it, or measure "
                f"the force of {listing(owners['gain'])}"
            )
        elif "sensor_gain" in kinds:
            yield f"move {listing(owners['sensor_gain'])} by a known distance and compare the reading"
        elif "sensor_offset" in kinds:
            yield f"go to a known position of {listing(owners['sensor_offset'])} and compare the reading"
        elif kinds & {"delay", "lag", "sensor_delay"}:
            yield f"for {names}: step the command from rest, at a higher sampling rate"
        elif "frictionloss" in kinds:
            yield f"for {names}: hold several steady speeds, in both directions"
        elif kinds <= {"mass", "payload", "inertia"}:
            yield f"for {names}: weigh one of them"
        else:
            without_advice.append(names)
    if without_advice:
        unnamed = len(without_advice) - _NAMED
        further = f" and {unnamed} more groups" if unnamed > 0 else ""
        yield (
            f"for {'; '.join(without_advice[:_NAMED])}{further}: record at another speed and amplitude, or "
            "exclude what you know is as stated (exclude = [...] in the case file)"
        )
    if seen.hidden:
        yield f"for {listing(seen.hidden)}: move what they act on farther or faster"
