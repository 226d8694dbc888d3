"""Units, signs, columns and sensors: every planted fault is named, no recorded case is refused."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis import Case, Experiment
from diagnosis.machine.plausible import refuse_implausible
from plant import paper_link, parse_effects, simulate
from plant.simulation import Simulator
from workflow.diagnose.case_files import load_case

RIG = paper_link().perturbed(
    {"sensors.hub_angle_noise_rad": 1e-3, "sensors.tip_acceleration_noise_m_s2": 0.05}
)
FRICTION = parse_effects([{"name": "coulomb_friction", "torque_Nm": 0.1}])
HUB, TIP, ACCELERATION = "hub_angle_rad", "tip_m", "tip_acceleration_m_s2"


def case_of(*outputs: str) -> Case:
    """Six records of an arm with friction, in steps of random sign."""
    experiments = []
    for number in range(6):
        rng = np.random.default_rng(number)
        voltage = (3.0 + number) * np.sign(rng.standard_normal(100)).repeat(8)
        run = Simulator(RIG, FRICTION, accelerometer=True).run(voltage, rng=rng)
        role = "held_out" if number > 3 else "estimation"
        experiments.append(Experiment(f"r{number}", role, voltage, run.columns(outputs), outputs=outputs))
    return Case("arm", RIG, tuple(experiments))


def changed(case: Case, change, *only: int) -> Case:
    """Each record's (T, 1 + Y) columns, voltage first, through `change`."""
    made = []
    for i, e in enumerate(case.experiments):
        columns = np.column_stack([e.voltage_V, e.output])
        columns = change(columns) if not only or i in only else columns
        made.append(replace(e, voltage_V=columns[:, 0], output=columns[:, 1:], readings=None))
    return replace(case, experiments=tuple(made))


def scaled(column: int, factor: float):
    return lambda columns: columns * np.where(np.arange(columns.shape[1]) == column, factor, 1.0)


def clipped(columns):
    limit = 0.4 * np.max(np.abs(columns[:, 1]))
    return np.column_stack([columns[:, 0], np.clip(columns[:, 1], -limit, limit), *columns[:, 2:].T])


def frozen(columns):
    fastest = int(np.argmax(np.abs(np.diff(columns[:500, 1]))))
    held = columns.copy()
    held[fastest + 1 :, 1] = held[fastest + 1, 1]
    return held


def swapped(a: int, b: int):
    def change(columns):
        order = np.arange(columns.shape[1])
        order[[a, b]] = b, a
        return columns[:, order]

    return change


DEGREES = 180 / np.pi
FAULTS = {
    "degrees as radians": ((HUB, TIP), scaled(1, DEGREES), ["all records", f"{HUB} 5", "57.3 (degrees"]),
    "radians as degrees": ((HUB,), scaled(1, 1 / DEGREES), [HUB, "57.3 (degrees"]),
    "millivolts as volts": (
        (HUB, TIP),
        scaled(0, 1e3),
        [f"{HUB} and {TIP}", "voltage_V off by 1000 (milli)"],
    ),
    "millimetres as metres": ((HUB, TIP), scaled(2, 1e3), [f"{TIP} off by 1000 (milli)"]),
    "g as m/s2": ((HUB, ACCELERATION), scaled(2, 1 / 9.81), [f"{ACCELERATION} off by 9.807 (g)"]),
    "voltage upside down": ((HUB, TIP), scaled(0, -1.0), ["wrong sign of voltage_V?"]),
    "hub upside down": ((HUB, TIP), scaled(1, -1.0), [f"wrong sign of {HUB}?"]),
    "hub or voltage upside down": ((HUB,), scaled(1, -1.0), [f"wrong sign of voltage_V or {HUB}?"]),
    "acceleration upside down": ((HUB, ACCELERATION), scaled(2, -1.0), [f"wrong sign of {ACCELERATION}?"]),
    "voltage and hub": ((HUB, TIP), swapped(0, 1), [f"columns of voltage_V and {HUB} look exchanged"]),
    "hub and tip": ((HUB, TIP), swapped(1, 2), [f"columns of {HUB} and {TIP} look exchanged"]),
    "hub and acceleration": (
        (HUB, ACCELERATION),
        swapped(1, 2),
        [f"columns of {HUB} and {ACCELERATION} look"],
    ),
    "clipped": ((HUB, TIP), clipped, ["experiment r", HUB, "is it clipped?"]),
    "not SI at all": ((HUB, TIP), scaled(2, 1e12), ["experiment r0", TIP, "SI units"]),
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_planted_fault_is_named(what):
    outputs, change, words = FAULTS[what]
    sound = case_of(*outputs)
    refuse_implausible(sound)
    with pytest.raises(ValueError, match=r"experiment|records|columns") as caught:
        refuse_implausible(changed(sound, change))
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("change", "word"), [(scaled(1, -1.0), "wrong sign"), (scaled(1, DEGREES), "57.3"), (frozen, "dead")]
)
def test_a_fault_in_one_record_names_it(change, word):
    with pytest.raises(ValueError, match=f"experiment r2: .*{word}"):
        refuse_implausible(changed(case_of(HUB, TIP), change, 2))


@pytest.mark.parametrize(
    ("key", "value"),
    [("link.thickness_m", 6.3), ("link.youngs_modulus_Pa", 69.0), ("link.density_kg_m3", 2.7)],
)
def test_a_rig_in_other_units_is_refused(key, value):
    case = case_of(HUB, TIP)
    with pytest.raises(ValueError, match=f"rig file: {key} is {value:g}; expected"):
        refuse_implausible(replace(case, rig=case.rig.perturbed({key: value})))


def test_effects_that_change_the_motion_most_are_no_fault():
    """Large, but an arm can be so: what a fault does is far beyond them, or looks otherwise."""
    voltage = 6 * np.sign(np.random.default_rng(3).standard_normal(100)).repeat(8)
    for effect in (
        {"name": "actuator_gain", "ratio": 0.4},
        {"name": "actuator_lag", "time_constant_s": 0.17},
        {"name": "joint_compliance", "stiffness_Nm_rad": 10.0, "damping_Nms": 0.02},
        {"name": "sensor_gain", "ratio": 2.0},
        {"name": "actuator_saturation", "limit_V": 1.5},
        {"name": "input_delay", "delay_s": 0.06},
    ):
        run = simulate(RIG, voltage, parse_effects([effect]), rng=np.random.default_rng(4))
        record = Experiment("a", "estimation", voltage, run.output)
        rig = RIG.perturbed({"sensors.tip_noise_m": 1e-3})
        case = Case("arm", rig, (record, replace(record, name="b", role="held_out")))
        refuse_implausible(case)


@pytest.mark.parametrize(
    "every", [pytest.param(4, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.long)]
)
def test_no_recorded_case_is_refused_and_its_faults_are(gap_cases, every):
    """In CI in every fourth one; the workshop's cases are loaded one by one in
    tests/workflow/test_diagnose_case_files.py."""
    for folder in sorted((gap_cases / "labelled").iterdir())[::every]:
        case = load_case(folder).case
        for change in (scaled(1, DEGREES), scaled(0, 1e-3), scaled(2, -1.0), swapped(0, 1)):
            with pytest.raises(ValueError, match="columns"):
                refuse_implausible(changed(case, change))
