"""What a simulation of one's own does beside its stated values, before a fit relies on it."""

from __future__ import annotations

import time

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import RUNAWAY, Plant, PlantCase
from diagnosis.machine.plausible import FARTHER, LESS

# Of a tolerance: the step of a fit's slopes, and the largest change of a value (in logarithms) looked at.
_STEP, _FARTHEST = 1e-3, 0.5
# Slopes over one step and over two differ by less than this share where outputs are smooth.
_BENT = 0.5
# Records in which a value or an effect may show.
_RECORDS = 5
# From this correlation on an output follows the simulation closely enough to compare how far both move.
_FOLLOWED = 0.8
_FACTORS = {180 / np.pi: "degrees", 1e3: "thousandths", 100.0: "hundredths", 30 / np.pi: "rpm"}


def doubts_about(case: PlantCase, deadline_s: float = np.inf) -> tuple[str, ...]:
    """Sentences on what makes an answer doubtful: values and effects that change nothing, values at which
    the simulation diverges or is not smooth, records that validate nothing.

    deadline_s : of time.monotonic(); what is left then is not looked at.

    Raises ValueError, one line: a simulation that is random beside its stated values.
    """
    plant, found = case.plant, list(doubtful_columns(case))
    inputs = [e.input for e in case.estimation[:_RECORDS]]
    moved = plant.scaled({key: np.exp(min(t, _FARTHEST)) for key, t in plant.tolerances.items()})
    first, second = moved.simulator(())(inputs[0]), moved.simulator(())(inputs[0])
    if not np.array_equal(first, second):
        raise ValueError(
            f"case {case.name}: two simulations with the same parameters, not those stated, differ by up "
            f"to {np.max(np.abs(first - second)):.3g}; make simulate a function of its arguments alone "
            "(no random numbers, nothing kept between calls)"
        )
    stated = [plant.simulator(())(u) for u in inputs]
    for key, tolerance in plant.tolerances.items():
        if time.monotonic() > deadline_s:
            return tuple(found)
        found += _of_value(plant, key, tolerance, inputs, stated)
    for effect in plant.effects:
        if effect.place is None and time.monotonic() < deadline_s:
            candidate = effect.candidates()[0]
            change = candidate.effect_at(np.array(candidate.starts[-1 if effect.grows else 0]))
            runs = zip(inputs, stated, strict=True)
            if all(np.array_equal(plant.simulator([change])(u), y) for u, y in runs):
                found.append(f"{effect.name} changes no output: does simulate use its argument effects?")
    if (body := plant.body) is not None:
        moving = np.concatenate([e.input[~body.resting(e.input), body.speed] for e in case.experiments])
        if np.ptp(np.sign(moving)) == 0:
            found.append(
                f"all records move one way: dry friction cannot be told from an offset of "
                f"{case.outputs[body.force]} there; move both ways"
            )
    for e in case.held_out:
        for other in case.estimation:
            if np.array_equal(e.output, other.output):
                found.append(f"the validation record {e.name} is the same as {other.name}: add another one")
    return tuple(found)


def doubtful_columns(case: PlantCase) -> tuple[str, ...]:
    """Sentences on outputs that move as the nominal simulation does under the commands alone, but the other
    way round, as another output's does, or by a factor that no missing effect makes: a sign, columns that
    are exchanged, a unit. The first halves may differ by their start. And on a step that is not the log's."""
    run, correlations, ratios = case.plant.replayed(()), [], []
    for e in case.estimation[:_RECORDS]:
        x, y = (
            one[len(one) // 2 :] - np.mean(one[len(one) // 2 :], axis=0) for one in (run(e.input), e.output)
        )
        own, moved = np.linalg.norm(x, axis=0), np.linalg.norm(y, axis=0)
        both = np.outer(own, moved)
        correlations.append(np.divide(x.T @ y, both, out=np.zeros_like(both), where=both > 0))
        ratios.append(np.divide(moved, own, out=np.ones_like(own), where=own > 0))
    alike, ratio = np.array(correlations), np.array(ratios)
    found = []
    for k, name in enumerate(case.outputs):
        told = np.abs(alike[:, k, k]) > _FOLLOWED  # false where the simulation runs away
        if not np.any(told):
            row = np.median(alike[:, k], axis=0)
            found += [
                f"{name} of the simulation moves as the column of {other} does, not as its own: are columns "
                "exchanged?"
                for other, value in zip(case.outputs, row, strict=True)
                if value > _FOLLOWED and row[k] < 0.5 * _FOLLOWED
            ]
            continue
        if np.median(alike[:, k, k]) < -_FOLLOWED:
            found.append(
                f"{name} moves the other way round than in the simulation: is its sign, or its command's, "
                "turned?"
            )
        times = float(np.median(ratio[told, k]))
        # Friction makes any force of a motion that is given.
        given = case.plant.body is not None and case.plant.body.force == k
        if not (given or LESS < times < FARTHER):
            near = min(_FACTORS, key=lambda factor: abs(np.log(times / factor)))
            unit = f"in {_FACTORS[near]}" if 0.5 < times / near < 2 else "in another unit"
            found.append(f"{name} moves {times:.3g} times as far as in the simulation: is its column {unit}?")
    # What the best sizes would leave of the motion is no question of steps.
    sized = np.sqrt(np.mean(np.maximum(1 - np.diagonal(alike[0]) ** 2, 0)))
    return (*found, *([] if case.plant.untracked else _other_step(case, float(sized))))


def _other_step(case: PlantCase, sized: float) -> list[str]:
    """On a simulation whose step seems not to be the sampling period: where a sample is several of its steps,
    or a step several samples, it follows the first record far better than with any sizes (sized)."""
    e, run = case.estimation[0], case.plant.replayed(())
    least, ratios = 100, (5, 10, 20, 50, 100)  # of less than five an inertia would do as much
    rests, moves = int(np.argmax(np.any(e.input != e.input[0], axis=1))), np.var(e.output, axis=0)
    if np.any(np.var(e.output[: rests + 1], axis=0) > 1e-3 * moves):
        rests = 0

    def left(steps: int, samples: int) -> float:
        """Share of the motion, of as many samples as take no longer than the record, at least so many."""
        part = slice(rests, rests + max(len(e.input) // steps, least), samples)
        missed = np.var(e.output[part] - run(np.repeat(e.input[part], steps, axis=0))[::steps], axis=0)
        moved = np.var(e.output[part], axis=0)
        return float(np.sqrt(np.mean(missed / moved))) if np.all(moved > 0.01 * moves) else 1.0

    tried = [(n, 1) for n in ratios] + [(1, n) for n in ratios if len(e.input) >= n * least]
    best, (n, samples) = min((left(*one), one) for one in tried) if left(1, 1) > 0.5 else (1.0, (1, 1))
    if best > 0.5 * sized:
        return []
    what = f"a sample is {n} of its steps" if n > 1 else f"its step is {samples} samples"
    return [f"the simulation follows {e.name} far better where {what}: is its step the sampling period?"]


def _of_value(plant: Plant, key: str, tolerance: float, inputs: list[Real], stated: list[Real]) -> list[str]:
    farthest = min(tolerance, _FARTHEST)

    def change(by: float, k: int = 0) -> Real:
        return plant.scaled({key: float(np.exp(by))}).simulator(())(inputs[k]) - stated[k]

    ends = [change(farthest), change(-farthest)]
    lost = [
        s
        for s, y in zip((1, -1), ends, strict=True)
        if np.max(np.abs(y)) > 0.5 * np.min(RUNAWAY * plant.noise)
    ]
    if lost:
        at = " and ".join(f"{plant.parameters[key] * np.exp(s * farthest):.4g}" for s in lost)
        return [f"the simulation diverges with {key} at {at}, inside its tolerance: it is not judged there"]
    if not any(np.any(y) for y in ends):
        if any(np.any(change(farthest, k)) for k in range(1, len(inputs))):
            return []
        return [f"{key} changes no output: does simulate use it, and is it other than zero?"]
    one, two = change(_STEP * tolerance), change(2 * _STEP * tolerance)
    bent = _rms(two - 2 * one, plant) / (2 * _STEP)
    flat = not np.any(two) and _rms(ends[0], plant) > 1
    if flat or (bent > 1 and _rms(two - 2 * one, plant) > _BENT * _rms(two, plant)):
        return [
            f"the outputs are not smooth in {key}: its re-estimated value, and sizes beside it, may be wrong"
        ]
    return []


def _rms(outputs: Real, plant: Plant) -> float:
    """Over noise."""
    return float(np.sqrt(np.mean((outputs / plant.noise) ** 2)))
