"""What a simulation of one's own does beside its stated values, before a fit relies on it."""

from __future__ import annotations

import time

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import RUNAWAY, Plant, PlantCase
from diagnosis.machine.plausible import FARTHER, LESS

# Step of a fit's slopes, as a share of a value's tolerance.
_STEP = 1e-3
# Largest change of a value that is looked at, in its logarithm: half as much again.
_FARTHEST = 0.5
# Slopes over one step and over two differ by less than this share where outputs are smooth. Chosen.
_BENT = 0.5
# Share of the least number of noise deviations that stands for a runaway from which on a trial is one.
_LOST = 0.5
# Records in which a value or an effect may show; more take longer.
_RECORDS = 5
# Correlation from which on an output follows the simulation closely enough to compare how far both move.
# Below half of it, it does not follow at all. Chosen.
_FOLLOWED = 0.8
# Factor that a column may be off by -> the unit it is in then.
_FACTORS = {180 / np.pi: "degrees", 1e3: "thousandths", 100.0: "hundredths", 30 / np.pi: "rpm"}
# A factor is that of a unit where it is no farther from it than this, either way.
_NEAR = 2.0
# Samples that a record must have for a comparison of steps.
_LEAST_SAMPLES = 100
# Ratios of the simulation's step to the sampling period that are tried: of less than five an inertia would do
# as much.
_STEP_RATIOS = (5, 10, 20, 50, 100)
# Share of the motion before the first command up to which a record rests there.
_RESTS = 1e-3
# Share of the motion of a record that a part of it must have to be compared.
_MOVES = 0.01
# Share of the motion that a simulation with its own step must leave for others to be tried.
_FOLLOWS_BADLY = 0.5
# Relative difference of two steps that are the same: clocks of loggers are off by less.
_SAME_STEP = 1e-3
# What another step leaves at most, as a share of what the best sizes would.
_FAR_BETTER = 0.5


def doubts_about(case: PlantCase, deadline_s: float = np.inf) -> tuple[str, ...]:
    """Sentences on what makes an answer doubtful.

    They are on values and effects that change nothing, values at which the simulation diverges or is not
    smooth, columns that do not fit (`doubtful_columns`), and records that validate nothing.

    Parameters
    ----------
    case : PlantCase
    deadline_s : float
        Of time.monotonic(); what is left then is not looked at.

    Raises
    ------
    ValueError
        One line: a simulation that is random beside its stated values.
    """
    plant = case.plant
    doubts = list(doubtful_columns(case))
    inputs = [e.input for e in case.estimation[:_RECORDS]]
    _refuse_random(case, inputs[0])

    stated = [plant.simulator(())(u) for u in inputs]
    for key, tolerance in plant.tolerances.items():
        if time.monotonic() > deadline_s:
            return tuple(doubts)
        doubts += _doubts_about_value(plant, key, tolerance, inputs, stated)

    # Effects that the simulation knows itself: the largest start of each must change something.
    for effect in plant.effects:
        if effect.place is not None or time.monotonic() >= deadline_s:
            continue
        candidate = effect.candidates()[0]
        largest = candidate.starts[-1] if effect.grows else candidate.starts[0]
        run = plant.simulator([candidate.effect_at(np.array(largest))])
        if all(np.array_equal(run(u), y) for u, y in zip(inputs, stated, strict=True)):
            doubts.append(f"{effect.name} changes no output: does simulate use its argument effects?")

    body = plant.body
    if body is not None:
        moving = np.concatenate([e.input[~body.resting(e.input), body.speed] for e in case.experiments])
        if np.ptp(np.sign(moving)) == 0:
            doubts.append(
                f"all records move one way: dry friction cannot be told from an offset of "
                f"{case.outputs[body.force]} there; move both ways"
            )
    for e in case.held_out:
        for other in case.estimation:
            if np.array_equal(e.output, other.output):
                doubts.append(f"the validation record {e.name} is the same as {other.name}: add another one")
    return tuple(doubts)


def _refuse_random(case: PlantCase, inputs: Real) -> None:
    """Raises ValueError where two simulations under inputs (T, U) with the same moved parameters differ."""
    plant = case.plant
    factors = {key: float(np.exp(min(t, _FARTHEST))) for key, t in plant.tolerances.items()}
    moved = plant.scaled(factors)
    first = moved.simulator(())(inputs)
    second = moved.simulator(())(inputs)
    if not np.array_equal(first, second):
        raise ValueError(
            f"case {case.name}: two simulations with the same parameters, not those stated, differ by up "
            f"to {np.max(np.abs(first - second)):.3g}; make simulate a function of its arguments alone "
            "(no random numbers, nothing kept between calls)"
        )


def doubtful_columns(case: PlantCase) -> tuple[str, ...]:
    """Sentences on outputs that do not move as in the nominal simulation under the commands alone.

    They move the other way round, as another output does, or by a factor that no missing effect makes: a
    sign, columns that are exchanged, a unit. And on a step that is not the log's. First halves of the records
    may differ by their start and are not compared.
    """
    run = case.plant.replayed(())
    correlations = []
    ratios = []
    for e in case.estimation[:_RECORDS]:
        simulated = _last_half(run(e.input))
        measured = _last_half(e.output)
        size_simulated = np.linalg.norm(simulated, axis=0)
        size_measured = np.linalg.norm(measured, axis=0)
        sizes = np.outer(size_simulated, size_measured)
        correlations.append(
            np.divide(simulated.T @ measured, sizes, out=np.zeros_like(sizes), where=sizes > 0)
        )
        ratio = np.ones_like(size_simulated)
        ratios.append(np.divide(size_measured, size_simulated, out=ratio, where=size_simulated > 0))
    # (records, outputs of the simulation, columns of the log); (records, outputs).
    correlation = np.array(correlations)
    farther = np.array(ratios)

    doubts = []
    for k, name in enumerate(case.outputs):
        follows = np.abs(correlation[:, k, k]) > _FOLLOWED  # false where the simulation runs away
        if not np.any(follows):
            by_column = np.median(correlation[:, k], axis=0)
            for other, value in zip(case.outputs, by_column, strict=True):
                if value > _FOLLOWED and by_column[k] < 0.5 * _FOLLOWED:
                    doubts.append(
                        f"{name} of the simulation moves as the column of {other} does, not as its own: are "
                        "columns exchanged?"
                    )
            continue
        if np.median(correlation[:, k, k]) < -_FOLLOWED:
            doubts.append(
                f"{name} moves the other way round than in the simulation: is its sign, or its command's, "
                "turned?"
            )
        times = float(np.median(farther[follows, k]))
        # Friction makes any force of a motion that is given.
        body = case.plant.body
        is_force_of_motion = body is not None and body.force == k
        if not (is_force_of_motion or LESS < times < FARTHER):
            nearest = min(_FACTORS, key=lambda factor: abs(np.log(times / factor)))
            is_near = 1 / _NEAR < times / nearest < _NEAR
            unit = f"in {_FACTORS[nearest]}" if is_near else "in another unit"
            doubts.append(
                f"{name} moves {times:.3g} times as far as in the simulation: is its column {unit}?"
            )

    # A simulation that is held near its record follows it with any step, and one whose step is that of the
    # time stamps follows it badly for another reason.
    if not case.plant.untracked and not _steps_as_sampled(case.plant):
        # What the best sizes would leave of the motion is no question of steps.
        left_by_sizes = np.sqrt(np.mean(np.maximum(1 - np.diagonal(correlation[0]) ** 2, 0)))
        doubts += _other_step(case, float(left_by_sizes))
    return tuple(doubts)


def _steps_as_sampled(plant: Plant) -> bool:
    """Whether a simulation says that its step is the sampling period, as an FMU's is and a file may say."""
    step_s = getattr(plant.simulation, "dt_s", None)
    return step_s is not None and abs(step_s - plant.dt_s) < _SAME_STEP * plant.dt_s


def _last_half(signals: Real) -> Real:
    """Second half (T / 2, Y) of signals (T, Y), each about its mean there."""
    part = signals[len(signals) // 2 :]
    return np.asarray(part - np.mean(part, axis=0))


def _other_step(case: PlantCase, left_by_sizes: float) -> list[str]:
    """A sentence on a simulation whose step seems not to be the sampling period; none where it may be.

    Where a sample is several of its steps, or a step several samples, it follows the first record far better
    than with any sizes, which would leave the share `left_by_sizes` of the motion.
    """
    e = case.estimation[0]
    run = case.plant.replayed(())
    power = np.var(e.output, axis=0)
    # A record that rests before its first command is compared from there on.
    has_command = np.any(e.input != e.input[0], axis=1)
    begins = int(np.argmax(has_command))
    if np.any(np.var(e.output[: begins + 1], axis=0) > _RESTS * power):
        begins = 0

    def left(steps: int, samples: int) -> float:
        """Share of the motion that a simulation leaves whose step is samples / steps sampling periods.

        It is of as many samples as take no longer than the record, at least so many.
        """
        end = begins + max(len(e.input) // steps, _LEAST_SAMPLES)
        part = slice(begins, end, samples)
        measured = e.output[part]
        simulated = run(np.repeat(e.input[part], steps, axis=0))[::steps]
        moved = np.var(measured, axis=0)
        if not np.all(moved > _MOVES * power):
            return 1.0
        return float(np.sqrt(np.mean(np.var(measured - simulated, axis=0) / moved)))

    if not left(1, 1) > _FOLLOWS_BADLY:
        return []
    trials = [(n, 1) for n in _STEP_RATIOS]
    trials += [(1, n) for n in _STEP_RATIOS if len(e.input) >= n * _LEAST_SAMPLES]
    least_left, (steps, samples) = min((left(*trial), trial) for trial in trials)
    if least_left > _FAR_BETTER * left_by_sizes:
        return []
    what = f"a sample is {steps} of its steps" if steps > 1 else f"its step is {samples} samples"
    return [f"the simulation follows {e.name} far better where {what}: is its step the sampling period?"]


def _doubts_about_value(
    plant: Plant, key: str, tolerance: float, inputs: list[Real], stated: list[Real]
) -> list[str]:
    """A sentence on a stated value, or none.

    inputs, stated : (T, U) of records, and outputs (T, Y) as stated. tolerance : of the value.
    """
    farthest = min(tolerance, _FARTHEST)

    def change(by: float, k: int = 0) -> Real:
        """(T, Y) by which outputs of the k-th record change with the value times exp(by)."""
        return plant.scaled({key: float(np.exp(by))}).simulator(())(inputs[k]) - stated[k]

    changes = {sign: change(sign * farthest) for sign in (1, -1)}
    runaway = _LOST * np.min(RUNAWAY * plant.noise)
    lost = [sign for sign, moved in changes.items() if np.max(np.abs(moved)) > runaway]
    if lost:
        at = " and ".join(f"{plant.parameters[key] * np.exp(sign * farthest):.4g}" for sign in lost)
        return [f"the simulation diverges with {key} at {at}, inside its tolerance: it is not judged there"]
    if not any(np.any(moved) for moved in changes.values()):
        if any(np.any(change(farthest, k)) for k in range(1, len(inputs))):
            return []
        return [f"{key} changes no output: does simulate use it, and is it other than zero?"]

    # Outputs are smooth where twice a step does twice as much.
    one_step = change(_STEP * tolerance)
    two_steps = change(2 * _STEP * tolerance)
    curvature = _rms_over_noise(two_steps - 2 * one_step, plant)
    is_flat = not np.any(two_steps) and _rms_over_noise(changes[1], plant) > 1
    shows_within_tolerance = curvature / (2 * _STEP) > 1
    if is_flat or (shows_within_tolerance and curvature > _BENT * _rms_over_noise(two_steps, plant)):
        return [
            f"the outputs are not smooth in {key}: its re-estimated value, and sizes beside it, may be wrong"
        ]
    return []


def _rms_over_noise(outputs: Real, plant: Plant) -> float:
    """Root mean square of outputs (T, Y) in deviations of their noise."""
    return float(np.sqrt(np.mean((outputs / plant.noise) ** 2)))
