"""Logs of several loops at once: what feedback does to a direct fit, and what two stages leave of it. The
loops are run here sample by sample, by numpy."""

from functools import cache

import control
import numpy as np
import pytest
from scipy.signal import lfilter

from ident import IdentOptions, Record
from ident.closed_loop import two_stage_several
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from tests.ident.test_several_outputs import DT_S, NAMES, OMEGA, response, structure

PLANT = structure(drives=((1.0, -0.4), (0.5, 1.0)))
TRUTH = response(PLANT)
SIZE = np.abs(TRUTH).max(axis=0)
KNOWN = IdentOptions(n_real=1, n_pairs=2)


def controller(gain: float = 2.0) -> control.StateSpace:
    """PI with lead in each loop, coupled."""
    z = control.tf([1, 0], [1], DT_S)
    one = control.ss(gain * (0.3 + 0.6 * DT_S / (z - 1) + 0.02 / DT_S * (z - 1) / (z - 0.5)))
    both, mixed = control.append(one, one), np.array([[1.0, 0.2], [-0.1, 1.0]])
    return control.ss(both.A, both.B @ mixed, both.C, both.D @ mixed, DT_S)


def log(seed: int, noise: float, colour: float, moves=(1.0, 1.0), samples: int = 3000) -> Record:
    """References, commands and measurements; noise / (1 - colour q^-1) of that deviation at the outputs."""
    rng, law = np.random.default_rng(seed), controller()
    r = np.repeat(rng.choice([-1.0, 1.0], (samples // 2, 2)), 2, axis=0) * moves
    white = rng.normal(size=(samples, 2)) @ np.array([[1.0, 0.0], [0.3, 0.9]])
    v = noise * np.sqrt(1 - colour**2) * lfilter([1.0], [1.0, -colour], white, axis=0)
    x, k = np.zeros(PLANT.nstates), np.zeros(law.nstates)
    u, y = np.empty((2, samples, 2))
    for t in range(samples):
        y[t] = PLANT.C @ x + v[t]
        u[t] = law.C @ k + law.D @ (r[t] - y[t])
        k, x = law.A @ k + law.B @ (r[t] - y[t]), PLANT.A @ x + PLANT.B @ u[t]
    return Record(
        u,
        y,
        DT_S,
        name=f"seed {seed}",
        input_names=NAMES[0],
        output_names=NAMES[1],
        reference=r,
        reference_names=("r1", "r2"),
    )


def opened(item: Record) -> list[Record]:
    return list(two_stage_several([item], KNOWN).records)


@cache
def fitted(
    seed: int, noise: float, colour: float, stages: int, samples: int = 3000
) -> tuple[np.ndarray, float]:
    """Relative error of the response (F, Y, U), and the share of it that the balls hold."""
    item = log(seed, noise, colour, samples=samples)
    records = [item] if stages == 1 else list(two_stage_several([item], KNOWN).records)
    found = identify_mimo(records, KNOWN)
    held = matrix_posterior(records, found).at(OMEGA).holds(TRUTH)
    return (found.model.frequency_response(OMEGA) - TRUTH) / SIZE, float(np.mean(held))


def bias(seeds: int, *of: float, samples: int = 3000) -> tuple[float, float, float]:
    """Of the mean error over the seeds: its size, and what scatter alone makes of it; and the share held."""
    off, held = zip(*(fitted(seed, *of, samples=samples) for seed in range(seeds)), strict=True)
    rms = [np.sqrt(np.mean(np.abs(each) ** 2)) for each in (np.mean(off, axis=0), off - np.mean(off, axis=0))]
    return float(rms[0]), float(rms[1] / np.sqrt(seeds - 1)), float(np.mean(held))


@pytest.mark.long
def test_feedback_of_coloured_noise_biases_a_direct_fit_and_not_two_stages():
    direct, chance, _ = bias(8, 0.3, 0.9, 1)
    assert direct > 3 * chance
    staged, chance, _ = bias(8, 0.3, 0.9, 2)
    # The mean square of a mean over the seeds scatters, too, by its few independent directions.
    assert staged < 2 * chance
    assert staged < 0.7 * direct


@pytest.mark.slow
def test_balls_hold_the_response_in_a_loop_but_not_around_a_direct_fit():
    """Of one record, as it is and in two stages; the bias over many is in the long run."""
    assert fitted(0, 0.3, 0.9, stages=1, samples=1500)[1] < 0.05
    assert fitted(0, 0.03, 0.9, stages=2, samples=1500)[1] > 0.85


@pytest.mark.slow
def test_records_of_the_open_loop_stay_as_they_are():
    item = log(0, 0.03, 0.0, samples=600)
    free = Record(item.input, item.output, DT_S, name="free", input_names=NAMES[0], output_names=NAMES[1])
    stages = two_stage_several([free, item], KNOWN)
    np.testing.assert_array_equal(stages.records[0].input, free.input)
    np.testing.assert_array_equal(stages.records[0].output, free.output)
    assert stages.fit_percent[0] == 100.0
    assert 90.0 < stages.fit_percent[1] < 99.9


@pytest.mark.slow
def test_one_reference_at_a_time_in_records_of_their_own():
    items = [log(0, 0.03, 0.0, (1.0, 0.0), samples=1500), log(1, 0.03, 0.0, (0.0, 1.0), samples=1500)]
    stages = two_stage_several(items, KNOWN)
    found = identify_mimo(list(stages.records), KNOWN)
    assert np.sqrt(np.mean(np.abs((found.model.frequency_response(OMEGA) - TRUTH) / SIZE) ** 2)) < 5e-3
    with pytest.raises(ValueError, match=r"'seed 0'.*1\D+'r1'\D+2"):
        two_stage_several(items[:1], KNOWN)
