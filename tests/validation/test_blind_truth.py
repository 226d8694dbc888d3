"""The two simulators of the house agree: the blind protocol's elastica and the plant's linear modes."""

import tomllib

import numpy as np
import pytest

from plant import EFFECTS, Rig, paper_link, parse_effects, simulate
from plant.effects.joint import AttachedBody, GroundSpring
from tests.plant.test_effects import EXAMPLES
from validation.blind.beam import link_basis
from validation.blind.truth import LISTED, UNLISTED, Feedback, Truth

LINK = {"link.length_m": 0.8, "link.width_m": 0.02, "link.thickness_m": 0.003, "payload.mass_kg": 0.01}
RIG = paper_link().perturbed(LINK).model_dump(exclude={"tolerances"})
# Sizes that change these records by a noise deviation at least.
EFFECTS_HERE = EXAMPLES | {
    "coulomb_friction": {"torque_Nm": 0.02},
    "stribeck_friction": {name: 0.2 * size for name, size in EXAMPLES["stribeck_friction"].items()},
    "actuator_saturation": {"limit_V": 0.9},
    "structural_damping": {"ratio": 3.0},
    "joint_compliance": {"stiffness_Nm_rad": 60.0, "damping_Nms": 0.08},
}


def _voltage(T: int = 500) -> np.ndarray:
    bits = np.random.default_rng(11).integers(0, 2, T)
    return np.where(np.repeat(bits, 5)[:T] == 1, 1.2, -1.2)


def _noise_deviations(ours: Truth, effects: list[dict[str, object]], voltage: np.ndarray) -> np.ndarray:
    record = ours.record(voltage).measured(np.zeros((voltage.size, 2)))
    plant = simulate(Rig.model_validate(RIG), voltage, parse_effects(effects)).output
    return np.sqrt(np.mean(((record - plant) / ours.noise) ** 2, axis=0))


def test_effects_of_the_list_are_all_there():
    # The diagnosis may know more than the protocol hides: an effect that is added there need not be here.
    assert set(LISTED) == set(EFFECTS_HERE)
    assert set(LISTED) <= set(EFFECTS)
    assert not set(LISTED) & set(UNLISTED)


def test_clamped_frequencies_are_those_of_the_uniform_beam():
    # cos b cosh b = -1: Euler-Bernoulli, no tip mass. The fourth mode of ten polynomials is good to 2e-5.
    omega = np.sqrt(link_basis(0.8, 3.0, 0.16, 0.0, 4).stiffness)
    exact = np.array([1.8751041, 4.6940911, 7.8547574, 10.9955407]) ** 2 * np.sqrt(3.0 / 0.16) / 0.64
    np.testing.assert_allclose(omega, exact, rtol=3e-5)


@pytest.mark.parametrize("name", [n for n in LISTED if n not in ("backlash", "quantisation")])
def test_every_effect_agrees_with_the_plants_to_a_small_part_of_the_noise(name):
    effects = [{"name": name, **EFFECTS_HERE[name]}]
    # Measured: at most 0.02 (what large deflections add to the linear model is most of it).
    assert np.all(_noise_deviations(Truth(RIG, effects), effects, _voltage()) < 0.05)


# Beyond the list, but the diagnosis has to know them: gravity and hub inertia look like them.
@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("ground_spring", GroundSpring(stiffness_Nm_rad=0.5)),
        ("attachment", AttachedBody(inertia_kg_m2=0.01, stiffness_Nm_rad=6.0, damping_Nms=0.05)),
    ],
)
def test_what_looks_like_an_effect_agrees_with_the_plants(name, effect):
    voltage = _voltage()
    ours = Truth(RIG, [{"name": name, **effect.parameters()}])
    record = ours.record(voltage).measured(np.zeros((voltage.size, 2)))
    rig = Rig.model_validate(RIG)
    plant = simulate(rig, voltage, [effect]).output
    nothing = simulate(rig, voltage).output
    assert np.all(np.std(record - nothing, axis=0) > 5 * ours.noise)
    assert np.all(np.sqrt(np.mean((record - plant) ** 2, axis=0)) < 0.05 * ours.noise)


def test_quantisation_agrees_but_for_values_at_an_edge():
    effects = [{"name": "quantisation", **EFFECTS_HERE["quantisation"]}]
    ours = Truth(RIG, effects).record(_voltage()).measured(np.zeros((500, 2)))[:, 1]
    plant = simulate(Rig.model_validate(RIG), _voltage(), parse_effects(effects)).tip_m
    assert np.mean(np.abs(ours - plant) > 1e-9) < 0.02


@pytest.mark.parametrize(
    "further", [[], [{"name": "hardening_spring", "cubic_Nm_rad3": 20.0}]], ids=["alone", "spring"]
)
def test_backlash_agrees_while_the_sequence_of_contacts_is_the_same(further):
    # Contact sequences are sensitive (0.2 noise deviations between correct solvers): a single pulse is not.
    voltage = np.zeros(300)
    voltage[5:60] = 1.0
    effects = [{"name": "backlash", "gap_rad": 0.01}, *further]
    assert np.all(_noise_deviations(Truth(RIG, effects), effects, voltage) < 0.1)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("air_drag", {"coefficient_Ns2_m3": 0.2}),
        ("cogging", {"relative_amplitude": 0.2, "cycles_per_rev": 12.0, "phase_rad": 0.3}),
        ("ground_spring", {"stiffness_Nm_rad": 0.1}),
        ("inductance", {"inductance_H": 0.02, "current_limit_A": 0.4}),
        ("asymmetric_friction", {"torque_positive_Nm": 0.03, "torque_negative_Nm": 0.01}),
        ("amplifier_cubic", {"cubic_1_V2": 0.1}),
        ("sensor_clipping", {"limit_m": 0.03}),
        ("winding_heat", {"rate_1_s": 0.1}),
        ("encoder_eccentricity", {"amplitude_rad": 0.5, "phase_rad": 1.5}),
    ],
)
def test_every_cause_beyond_the_list_changes_the_record(name, parameters):
    voltage = _voltage()
    nothing = Truth(RIG).record(voltage).measured(np.zeros((500, 2)))
    something = Truth(RIG, [{"name": name, **parameters}]).record(voltage).measured(np.zeros((500, 2)))
    assert np.max(np.abs(something - nothing)) > 1e-3
    assert name in UNLISTED


def test_friction_holds_a_voltage_below_its_level():
    # 0.2 V make 0.11 Nm; the hub may give way by the ten microradian of pre-sliding, no more.
    voltage = np.full(400, 0.2)
    record = Truth(RIG, [{"name": "coulomb_friction", "torque_Nm": 0.2}]).record(voltage)
    assert np.max(np.abs(record.hub_angle_rad)) < 1e-5


def test_a_slew_replayed_open_loop_is_the_same_record():
    T = 400
    reference = np.clip((np.arange(T) - 50) / 150, 0, 1) * 0.3
    noise = np.random.default_rng(3).standard_normal(T) * 1e-3
    machine = Truth(RIG)
    slew = machine.record(np.zeros(T), Feedback(reference, 3.0, 0.2, 0.7), noise)
    assert abs(slew.hub_angle_rad[-1] - 0.3) < 0.05
    assert slew.voltage_V[0] == 0.0
    replayed = machine.record(slew.voltage_V)
    # The file carries the voltage to four digits behind the point, and the loop used just those.
    np.testing.assert_allclose(replayed.hub_angle_rad, slew.hub_angle_rad, rtol=0, atol=1e-12)


def test_bad_effects_are_refused_in_one_line():
    with pytest.raises(ValueError, match="unknown effect 'gremlins'"):
        Truth(RIG, [{"name": "gremlins"}])
    with pytest.raises(ValueError, match="given twice"):
        Truth(RIG, [{"name": "gravity", "acceleration_m_s2": 1.0}] * 2)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("coulomb_friction_and_tip_payload", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.long) for name in ("gravity", "periodic_disturbance")),
    ],
)
def test_recorded_cases_are_explained_to_the_noise(gap_cases, name):
    # Records of a third rig, by others: driven by the logged voltage, slew under control included.
    folder = gap_cases / "labelled" / name
    rig = tomllib.loads((folder / "rig.toml").read_text())
    answer = tomllib.loads((folder / "answer.toml").read_text())
    machine = Truth(rig, [{"name": e["name"], **e["parameters"]} for e in answer.get("effects", [])])
    for role in ("estimation", "held_out"):
        left = []
        for entry in tomllib.loads((folder / "case.toml").read_text())["experiments"]:
            if entry["role"] == role:
                data = np.loadtxt(folder / entry["file"], delimiter=",", skiprows=1)
                clean = machine.record(data[:, 1]).measured(np.zeros((len(data), 2)))
                left.append(((data[:, 2:] - clean) / machine.noise).ravel())
        rms = np.sqrt(np.mean(np.concatenate(left) ** 2))
        # Measured: equal to what the case's own answer states to four digits.
        assert rms == pytest.approx(answer["pooled_gap"][f"{role}_gap_after_oracle"], rel=2e-3)
