"""A simulation that answers its input a sample later than the machine is told from one that is off."""

import numpy as np
import pytest
from scipy.signal import lfilter

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose
from diagnosis.where.late import samples_late

DT_S = 0.01
NOISE = np.array([1e-3, 1e-3])


def motor(inputs, time_constant_s=0.1, late=0):
    """Speed and angle (T, 2) of a motor, `late` rows behind."""
    a = np.exp(-DT_S / time_constant_s)
    speed = lfilter([0, 1 - a], [1, -a], inputs[:, 0])
    both = np.column_stack([speed, DT_S * np.cumsum(speed)])
    return np.concatenate([np.zeros((late, 2)), both[: len(both) - late]])


def case_of(simulation, machine, tolerance=0.0):
    rng, records = np.random.default_rng(7), []
    for name, role in (("a", "estimation"), ("b", "estimation"), ("c", "held_out")):
        u = rng.choice([-1.0, 1.0], 60).repeat(8)[:, None] * rng.uniform(0.5, 2)
        y = machine(u) + NOISE * rng.standard_normal((len(u), 2))
        records.append(PlantExperiment(name, role, u, y))
    plant = Plant(
        lambda p, e, u: (
            simulation(u, p["tau_s"]) + e.get("offset", {"rad": 0.0})["rad"] * np.array([0.0, 1.0])
        ),
        {"tau_s": 0.1},
        {"tau_s": tolerance} if tolerance else {},
        ("speed_rad_s", "angle_rad"),
        NOISE,
        (PlantEffect("offset", (EffectParameter("rad", 1e-3, 1.0),)),),
        dt_s=DT_S,
    )
    return PlantCase("motor", plant, tuple(records))


def _slower(inputs):
    """A motor whose time constant is off by a sample: re-estimation finds it."""
    return motor(inputs, 0.09)


def residuals_of(case):
    run = case.plant.simulator(())
    return {e.name: (e.output - run(e.input)) / case.noise for e in case.experiments}


@pytest.mark.parametrize("late", [1, 2])
def test_a_late_simulation_is_seen(late):
    case = case_of(lambda u, tau: motor(u, tau, late), motor)
    assert samples_late(case, residuals_of(case)) == late


@pytest.mark.parametrize(
    ("simulation", "machine"),
    [
        (motor, motor),
        # The machine is late: a delay of its input, which is on the list.
        (motor, lambda u: motor(u, late=2)),
        # A lag that is off by about a sample.
        (lambda u, tau: motor(u, 1.1 * tau), motor),
        (lambda u, tau: motor(1.2 * u, tau), motor),
        # Dry friction, which answers later in one part of the motion.
        (motor, lambda u: motor(u - 0.2 * np.sign(motor(u)[:, :1]))),
    ],
    ids=["exact", "delay", "lag", "gain", "friction"],
)
def test_what_is_off_otherwise_is_not_called_late(simulation, machine):
    case = case_of(simulation, machine)
    assert samples_late(case, residuals_of(case)) == 0


def test_one_record_that_is_not_late_speaks_against_it():
    case = case_of(lambda u, tau: motor(u, tau, 1), motor)
    residuals = residuals_of(case)
    b = case.experiments[1]
    residuals["b"] = (b.output - motor(b.input * 1.3)) / NOISE
    assert samples_late(case, residuals) == 0


def test_records_shorter_than_the_shifts_say_nothing():
    case = case_of(lambda u, tau: motor(u, tau, 1), motor)
    assert samples_late(case, {e.name: np.full((2, 2), 9.0) for e in case.experiments}) == 0


@pytest.mark.filterwarnings("ignore:plant")
def test_a_diagnosis_says_it():
    case = case_of(lambda u, tau: motor(u, tau, 1), motor, tolerance=0.05)
    (doubt,) = [one for one in diagnose(case).doubts if "more than the machine's" in one]
    assert not any(
        "more than the machine's" in one for one in diagnose(case_of(motor, _slower, tolerance=0.05)).doubts
    )
    assert doubt.startswith("the motion follows the stated input by one sample more than the machine's")
