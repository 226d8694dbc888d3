"""Workshop cases: the truth begins anywhere, the nominal machine is its linear limit, answers hold."""

import json
import tomllib
from collections import Counter

import numpy as np
import pytest

from plant import Rig, parse_effects
from plant.simulation import Simulator, Start
from validation.blind.generate import generate
from validation.blind.truth import LISTED, WORKSHOP_UNLISTED, Background, Before, Feedback, Truth
from validation.blind.workshop.cases import SHARES, workshop_schedule
from validation.blind.workshop.machine import draw_workshop
from validation.blind.workshop.nominal import Log, Nominal
from validation.blind.workshop.score import FAMILIES, score_folders
from validation.blind.workshop.sizes import TIP_ONLY
from workflow.diagnose.case_files import load_case
from workflow.diagnose.document import FORMAT
from workflow.engine.errors import InputError


def _rig(dt_s=0.005):
    rig = draw_workshop("acc", np.random.default_rng(4)).stated
    rig["sampling"] = {"dt_s": dt_s, "transport_delay_s": 0.7 * dt_s}
    return rig


def _bits(T, size, seed=1):
    return size * np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], -(-T // 5)), 5)[:T]


def test_a_record_from_anywhere_agrees_with_the_plant_acceleration_and_delay_too():
    # Gravity knows where zero is: an arm let go at 0.2 rad swings; its voltage comes late by a part of dt.
    rig, voltage = _rig(), _bits(600, 0.3)
    effects = [{"name": "gravity", "acceleration_m_s2": 0.4}]
    ours = Truth(rig, effects).record(voltage, None, None, Before(0.2))
    simulator = Simulator(Rig.model_validate(rig), parse_effects(effects), accelerometer=True)
    plant = simulator.run(voltage, start=Start(hub_angle_rad=0.2))
    assert np.ptp(ours.hub_angle_rad) > 0.2
    # Measured 0.8 % of the acceleration: modes beyond the sixth, which ring at once when the arm is let go.
    pairs = (
        (ours.hub_angle_rad, plant.hub_angle_rad, 2e-3),
        (ours.tip_m, plant.tip_m, 2e-3),
        (ours.tip_acceleration_m_s2, plant.tip_acceleration_m_s2, 1.5e-2),
    )
    for mine, other, share in pairs:
        assert np.std(mine - other) < share * np.std(mine)


def test_background_is_what_it_says():
    rig, voltage = _rig(), np.full(300, 1e-3)
    # Within its pre-sliding deflection friction is a spring: the hub rests at torque over stiffness.
    level, deflection = 0.01, 1e-3
    held = Truth(rig, (), Background(dry_friction_Nm=level, presliding_rad=deflection)).record(voltage)
    motor = rig["motor"]
    torque = motor["gear_ratio"] * motor["torque_constant_Nm_A"] / motor["resistance_ohm"] * 1e-3
    assert np.mean(held.hub_angle_rad[-100:]) == pytest.approx(torque / level * deflection, rel=0.02)
    # Tilt along the link is the listed effect; two lags in series are symmetric.
    tilted = Truth(rig, (), Background(tilt_m_s2=0.3)).record(voltage, None, None, Before(0.3))
    listed = Truth(rig, [{"name": "gravity", "acceleration_m_s2": 0.3}], Background())
    same = listed.record(voltage, None, None, Before(0.3))
    np.testing.assert_allclose(tilted.tip_m, same.tip_m, rtol=0, atol=1e-12)
    wave = _bits(300, 0.3)
    lags = [
        Truth(rig, [{"name": "actuator_lag", "time_constant_s": one}], Background(amplifier_lag_s=other))
        for one, other in ((0.02, 0.005), (0.005, 0.02))
    ]
    one, other = (lag.record(wave).hub_angle_rad for lag in lags)
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6 * np.ptp(one))


@pytest.mark.parametrize(
    ("name", "gentle", "rough"),
    [
        ("gear_drag", {"coefficient_Nms2": 1e-9}, {"coefficient_Nms2": 0.3}),
        ("slew_limit", {"rate_V_s": 1e7}, {"rate_V_s": 20.0}),
        (
            "asymmetric_dead_zone",
            {"positive_V": 1e-9, "negative_V": 0.0},
            {"positive_V": 0.1, "negative_V": 0.0},
        ),
        (
            "attachment",
            {"inertia_kg_m2": 1e-9, "stiffness_Nm_rad": 1e-5, "damping_Nms": 1e-7},
            {"inertia_kg_m2": 0.01, "stiffness_Nm_rad": 6.0, "damping_Nms": 0.02},
        ),
    ],
)
def test_causes_only_workshops_have_grow_from_nothing(name, gentle, rough):
    assert name in WORKSHOP_UNLISTED
    rig, voltage = _rig(), _bits(400, 0.5)
    nothing = Truth(rig, (), Background()).record(voltage).hub_angle_rad
    small, large = (
        Truth(rig, [{"name": name, **given}], Background()).record(voltage).hub_angle_rad
        for given in (gentle, rough)
    )
    assert np.std(small - nothing) < 1e-5 * np.std(nothing)
    assert np.std(large - nothing) > 1e-2 * np.std(nothing)


@pytest.mark.parametrize("sensor", ["tip", "acc"])
def test_the_nominal_machine_is_the_truth_in_small_motion_and_finds_its_values(sensor):
    machine = draw_workshop(sensor, np.random.default_rng(3))
    truth = Truth(machine.true, (), Background())
    logs = []
    for seed in range(2):
        voltage = _bits(1000, 0.02, seed)
        clean = truth.record(voltage, None, None, Before(1.0 + seed, 200))
        tip = clean.tip_m if sensor == "tip" else clean.tip_acceleration_m_s2
        output = np.column_stack([clean.hub_angle_rad, tip])[200:]
        logs.append(Log(voltage, output, held_out=seed == 1))
    motion = np.std(logs[1].output, axis=0)
    nominal = Nominal(machine.tolerances, logs, sensor == "acc", 1e-3 * motion)
    exact = nominal.residuals(machine.true, np.zeros(len(machine.tolerances)))[1]
    # Measured 1e-6: rotations are exact, deflections small.
    assert np.all(np.std(exact, axis=0) < 1e-5 * motion)
    refit = nominal.refit(machine.stated)[1]
    stated = nominal.residuals(machine.stated, np.zeros(len(machine.tolerances)))[1]
    # Measured 0.064: the tolerances hold back a little.
    assert np.all(np.std(refit, axis=0) < 0.1 * np.std(stated, axis=0))


def test_a_controller_reads_the_encoder_and_keeps_its_limit():
    rig = _rig()
    around = Background(hub_offset_rad=0.7, encoder_step_rad=2e-3)
    reference = np.full(600, 1.5)
    machine = Truth(rig, (), around)
    loop = Feedback(reference, 2.0, 0.0, 0.5, limit_V=0.4)
    clean = machine.record(np.zeros(600), loop, None, Before(0.0))
    assert np.max(np.abs(clean.voltage_V)) == 0.4
    # The loop settles where the encoder, not the hub, shows the reference.
    assert np.mean(clean.hub_angle_rad[-100:]) + 0.7 == pytest.approx(1.5, abs=0.02)


def test_a_schedule_has_the_shares_and_no_effect_its_sensors_cannot_show():
    plans = workshop_schedule(240, np.random.default_rng(1))
    sorts = Counter(plan.sort for plan in plans)
    assert all(abs(sorts[sort] - 240 * share) <= 1 for sort, share in SHARES.items())
    assert Counter((plan.sensor, plan.closed_loop) for plan in plans).most_common()[-1][1] == 40
    assert {plan.first_effect for plan in plans if plan.sort == "single"} == set(LISTED) == set(FAMILIES)
    assert not [p for p in plans if p.first_effect in TIP_ONLY and p.sensor != "tip"]


@pytest.mark.long
def test_generated_cases_load_and_hold_what_their_answers_say(tmp_path):
    # One of each verdict: the pair and the second single effect take twenty seconds each.
    left_out = {name: {"case": name} for name in ("case_0002", "case_0005")}
    answers = generate(5, 1, tmp_path, open_cases=True, workshop=True, finished=left_out)
    answers = [answer for answer in answers if answer["case"] not in left_out]
    assert {a["verdict"] for a in answers} == {"none", "effect", "unknown"}
    for answer in answers:
        case = load_case(tmp_path / answer["case"]).case
        written = tomllib.loads((tmp_path / answer["case"] / "answer.toml").read_text())
        assert written["pooled_gap"] == answer["pooled_gap"]
        for key, relative in answer["true_minus_nominal_relative"].items():
            section, name = key.split(".")
            assert answer["true_rig"][section][name] / case.rig.value(key) - 1 == pytest.approx(
                relative, abs=1e-4
            )
        gaps = answer["pooled_gap"]
        if answer["verdict"] == "none":
            # Wanted 2 to 3.5 %; the controller's encoder and noise are in the records, not in the sizing.
            shares = [part["background_share_of_motion"] for part in answer["rms_held_out"].values()]
            assert 0.015 < np.sqrt(np.mean(np.square(shares))) < 0.05
            assert gaps["held_out_gap_before"] < 2 * gaps["held_out_gap_after_oracle"]
        else:
            assert answer["major_over_background_realised"] >= 2


def test_scores_of_folders(tmp_path):
    labelled, found = tmp_path / "labelled", tmp_path / "found"
    truths = {"a": ("none", []), "b": ("effect", ["gravity"]), "d": ("unknown", [])}
    truths["c"] = ("effect", ["backlash", "actuator_lag"])
    for name, (verdict, effects) in truths.items():
        (labelled / name).mkdir(parents=True)
        listed = "".join(f'[[effects]]\nname = "{e}"\n[effects.parameters]\n' for e in effects)
        (labelled / name / "answer.toml").write_text(
            f'case = "{name}"\nverdict = "{verdict}"\nmajor_over_background_realised = 5.0\n{listed}'
        )

    def answered(**answers):
        found.mkdir(exist_ok=True)
        for name, (verdict, effects) in answers.items():
            entries = [{"name": e, "probability": 1.0 / len(effects)} for e in effects]
            document = {"format": FORMAT, "case": name, "verdict": verdict, "effects": entries}
            document["combination"] = effects
            (found / f"{name}.json").write_text(json.dumps(document))

    answered(**truths)
    right = score_folders(labelled, found)["table"]["all"]
    assert right["verdict and set right, every case"]["hits"] == 4
    # Another torque is the right family, an actuator's fault is not.
    answered(b=("effect", ["torque_ripple"]))
    table = score_folders(labelled, found)["table"]["all"]
    assert (table["family, ratio >= 3"]["hits"], table["top-1, ratio >= 3"]["hits"]) == (1, 0)
    answered(b=("effect", ["actuator_gain"]))
    assert score_folders(labelled, found)["table"]["all"]["family, ratio >= 3"]["hits"] == 0
    (found / "b.json").unlink()
    assert score_folders(labelled, found)["n_cases"] == 4
    assert score_folders(labelled, found, partial=True)["n_cases"] == 3
    with pytest.raises(InputError, match="no diagnosis is there"):
        score_folders(labelled, labelled)
    answered(e=("none", []))
    with pytest.raises(InputError, match="e is none of the cases"):
        score_folders(labelled, found)


@pytest.mark.parametrize("name", ["work-01", "work-02", "work-16", "work-18"])
def test_the_nominal_machine_finds_the_gaps_of_recorded_workshop_cases(gap_cases, name):
    # Open and closed loop, lost rows, one and two sensors; the answers come from a finite-element rig.
    folder = gap_cases / "workshop" / "labelled" / name
    if not folder.is_dir():
        pytest.skip("no workshop cases there")
    answer = tomllib.loads((folder / "answer.toml").read_text())
    rig = tomllib.loads((folder / "rig.toml").read_text())
    tolerances = rig.pop("tolerances")
    del rig["sensors"]["noise_is"]
    noise = np.array(list(rig["sensors"].values()))
    records = load_case(folder).case.experiments
    logs = [Log(e.voltage_V, e.output, e.role == "held_out") for e in records]
    nominal = Nominal(tolerances, logs, answer["sensor"] == "acc", noise)
    off = np.log1p([answer["true_minus_nominal_relative"][key] for key in tolerances])
    for deviations, gap in ((0 * off, "held_out_gap_nominal"), (off, "held_out_gap_true_values")):
        residuals = nominal.residuals(rig, deviations)
        held = np.concatenate([r for r, log in zip(residuals, logs, strict=True) if log.held_out])
        # Measured: at most 0.4 %; the voltage before the first row is not known to the fit here.
        assert np.sqrt(np.mean((held / noise) ** 2)) == pytest.approx(answer["pooled_gap"][gap], rel=0.01)
