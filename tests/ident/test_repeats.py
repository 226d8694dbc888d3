"""Repeats at two amplitudes: how often a linear loop is accused, and what is said of others."""

import numpy as np
import pytest
from scipy import signal

from ident.checks.distortion_findings import distortion_findings
from ident.data.finding import FindingKind
from ident.data.record import Record
from ident.data.repeats import repeats_of
from tests.ident.findings import kinds, only

DT = 0.01
TIME = np.arange(2400) * DT
SWEEP = np.where(TIME < 20, np.sin(np.pi * TIME**2), 0.0)  # 0 to 20 Hz in 20 s, then rest


def closed_loop(resonance_Hz: float):
    """Reference to output under u = r - y: mode with damping 0.05 in series with a fast lag."""
    w = 2 * np.pi * resonance_Hz
    plant = signal.TransferFunction([0.5 * w**2], np.polymul([1, 0.1 * w, w**2], [0.005, 1]))
    loop = signal.TransferFunction(plant.num, np.polyadd(plant.den, plant.num))
    b, a, _ = signal.cont2discrete((loop.num, loop.den), DT, "bilinear")
    return b.ravel(), a


def recorded(system, amplitude, noise, rng, name):
    """One record of a sweep: run-to-run change of a loop as well as noise, which the loop colours."""
    r = amplitude * SWEEP
    y = signal.lfilter(*system, r) + noise * signal.lfilter([1], [1, -0.7], rng.standard_normal(r.size))
    return Record((r - y)[:, None], y[:, None], DT, name=name, reference=r[:, None])


def experiments(systems, noise, rng, repeats=3):
    return [
        recorded(system, size, noise, rng, f"{size} {k}")
        for system, size in zip(systems, (1.0, 1.5), strict=True)
        for k in range(repeats)
    ]


@pytest.mark.parametrize(("count", "most"), [(40, 3), pytest.param(100, 6, marks=pytest.mark.long)])
def test_a_linear_loop_is_accused_in_one_experiment_of_a_hundred(count, most):
    system = closed_loop(6.0)
    accused = 0
    for seed in range(count):
        (found,) = repeats_of(experiments([system, system], 0.05, np.random.default_rng(seed)))
        accused += bool(found.amplitude_effects)
    # Level 0.99: of 100 one is expected, sd 1, and 6 is 5 sd above; of 40 0.4, sd 0.63, and 3 is 4 sd above.
    assert accused <= most


def test_a_resonance_that_falls_with_amplitude_is_named_with_its_shift():
    records = experiments([closed_loop(6.0), closed_loop(5.94)], 0.01, np.random.default_rng(1))
    (found,) = repeats_of(records)
    assert found.rms == pytest.approx((np.std(SWEEP), 1.5 * np.std(SWEEP)))
    assert [len(names) for names in found.names] == [3, 3]
    told = only(distortion_findings(records, (), [found]), FindingKind.AMPLITUDE_EFFECT)
    # The plant's resonance moves by 1 %.
    assert told["shift_percent"] == pytest.approx(-1.0, abs=0.3)
    assert told["shift_from_Hz"] < 6.0 < told["shift_to_Hz"]
    # Sizes of the true responses' difference there, from the two transfer functions alone.
    omega = 2 * np.pi * np.linspace(told["most_from_Hz"], told["most_to_Hz"], 200)
    plants = []
    for resonance_Hz in (6.0, 5.94):
        closed = signal.freqz(*closed_loop(resonance_Hz), omega * DT)[1]
        plants.append(closed / (1 - closed))
    true = np.sqrt(np.mean(np.abs(plants[1] - plants[0]) ** 2 / np.abs(sum(plants) / 2) ** 2))
    assert told["percent"] == pytest.approx(100 * true, rel=0.3)


def friction_loop(amplitude, rng):
    """Shaft with Coulomb friction under u = r - y, stepped finely: J w' = 40 u - 6 w - 8 sign(w), stuck while
    the drive is too weak."""
    r = amplitude * SWEEP
    y, u = np.zeros(r.size), np.zeros(r.size)
    angle = speed = 0.0
    h = DT / 20
    for k in range(r.size):
        y[k] = angle + 0.002 * rng.standard_normal()
        u[k] = r[k] - y[k]
        for _ in range(20):
            free = speed + h * (40 * u[k] - 6 * speed)
            speed = np.sign(free) * max(abs(free) - 8 * h, 0.0)
            angle += h * speed
    return Record(u[:, None], y[:, None], DT, name=f"{amplitude}", reference=r[:, None])


def test_dry_friction_is_named_by_a_gain_that_grows_with_amplitude():
    rng = np.random.default_rng(2)
    records = [friction_loop(size, rng) for size in (1.0, 1.5) for _ in range(3)]
    told = only(distortion_findings(records, (), repeats_of(records)), FindingKind.AMPLITUDE_EFFECT)
    # A sine of amplitude A in speed meets friction as 4 8 / (pi A) of damping beside the 6 stated; drive and
    # with it speed are 1.5 times as large at the larger amplitude, so the gain grows and nothing shifts.
    assert 1 < told["gain_percent"] < 15
    assert told["gain_percent"] > 3 * abs(told["shift_percent"])


def test_what_is_no_repeat_is_left_out_and_no_effect_is_said_so():
    rng = np.random.default_rng(3)
    system = closed_loop(6.0)
    records = experiments([system, system], 0.05, rng)
    told = kinds(distortion_findings(records, (), repeats_of(records)))
    assert told == {FindingKind.REPEATED, FindingKind.AMPLITUDE_HIDDEN}
    (single,) = repeats_of(records[:4])  # the larger amplitude once
    assert len(single.rms) == 1
    assert single.amplitude_effects == ()
    other = Record(rng.standard_normal((2400, 1)), records[0].output, DT, name="other")
    assert repeats_of([records[0], other, records[3]]) == ()
