"""The next experiment separates what differs, says when nothing does, and keeps the machine in its limits."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from diagnosis import ResidualModel
from diagnosis.fit.fit import fit
from diagnosis.next_experiment.competing import competing_hypotheses, competing_hypothesis
from diagnosis.next_experiment.discrimination import CompetingHypothesis
from diagnosis.next_experiment.experiment_choices import Excitation, Limits, excitations
from diagnosis.next_experiment.next_experiment import next_experiment
from plant import prbs, simulate
from plant.effects import (
    ActuatorLag,
    ActuatorSaturation,
    CoulombFriction,
    InputDelay,
    TipPayload,
    ViscousFriction,
)
from tests.diagnosis.synthetic_residuals import DT, RIG, inputs, made, white

NOISE = np.array([RIG.sensors.hub_angle_noise_rad, RIG.sensors.tip_noise_m])
TOLERANT = RIG.model_copy(update={"tolerances": {"hub.inertia_kg_m2": 0.05, "motor.resistance_ohm": 0.03}})


def _competing(*effects, rig=RIG):
    return tuple(CompetingHypothesis(1 / len(effects), rig, () if e is None else (e,)) for e in effects)


def test_what_differs_only_at_high_voltage_gets_high_voltage():
    limits = Limits(voltage_V=3.0)
    chosen = next_experiment(_competing(None, ActuatorSaturation(limit_V=2.0)), limits)
    assert chosen.amplitude_V > 2.0
    assert chosen.separates
    assert chosen.separations[0].standard_deviations > 10
    assert chosen.separations[0].hypotheses == ("no effect", "actuator_saturation")
    below = next_experiment(_competing(None, ActuatorSaturation(limit_V=2.0)), Limits(voltage_V=1.9))
    assert not below.separates
    assert below.separations[0].standard_deviations == pytest.approx(0.0, abs=1e-6)


def test_what_the_records_decided_is_said():
    first = CompetingHypothesis(0.97, RIG, (TipPayload(mass_kg=0.01),))
    second = CompetingHypothesis(0.001, RIG)
    assert next_experiment((first, second), Limits(1.0)).decided


def test_identical_hypotheses_are_not_separated():
    effect = CoulombFriction(torque_Nm=0.01)
    chosen = next_experiment(_competing(effect, effect), Limits(1.0))
    assert not chosen.separates
    assert chosen.separations[0].standard_deviations == 0.0
    assert len(chosen.considered) == 15


def test_what_free_parameters_absorb_does_not_count():
    """Two sizes of one effect are one explanation; so are a nominal parameter and an effect that moves it."""
    sizes = _competing(TipPayload(mass_kg=0.010), TipPayload(mass_kg=0.011))
    fixed = tuple(
        CompetingHypothesis(
            r.probability, r.rig, r.effects, lambda v: np.zeros((2 * v.size, 0)), np.zeros((0, 0))
        )
        for r in sizes
    )
    free, held = next_experiment(sizes, Limits(1.0)), next_experiment(fixed, Limits(1.0))
    assert held.separations[0].standard_deviations > 10
    # What a tenth more costs a size known to a factor e, log 1.1 = 0.095, and the curvature of the response.
    assert free.separations[0].standard_deviations < 0.02 * held.separations[0].standard_deviations


def test_tolerances_only_take_separation_away():
    effects = (InputDelay(delay_s=0.006), ActuatorLag(time_constant_s=0.006))
    choice = [Excitation("prbs", {}, prbs(9, 4, 1.0, 700))]
    exact = next_experiment(_competing(*effects), Limits(1.0), choices=choice)
    tolerant = next_experiment(_competing(*effects, rig=TOLERANT), Limits(1.0), choices=choice)
    d, less = (n.separations[0].standard_deviations for n in (exact, tolerant))
    assert 0 < less <= d * (1 + 1e-6)


def _gain(voltage, truth, hypothesis, seed):
    """Chi-square that the best-fitting hypothesis leaves more than the best-fitting truth on a record."""
    record = simulate(RIG, voltage, (truth,), rng=np.random.default_rng(seed)).output

    def least(make, size):
        def cost(log_size):
            model = simulate(RIG, voltage, (make(float(np.exp(log_size))),)).output
            return float(np.sum(((record - model) / NOISE) ** 2))

        return minimize_scalar(cost, bounds=(np.log(size / 3), np.log(3 * size)), method="bounded").fun

    return least(hypothesis, 0.006) - least(lambda s: InputDelay(delay_s=s), 0.006)


def test_chosen_experiment_separates_delay_from_lag_better_than_a_record_when_fitted():
    truth = InputDelay(delay_s=0.006)
    record = inputs()["prbs_high"]
    chosen = next_experiment(
        _competing(truth, ActuatorLag(time_constant_s=0.006)),
        Limits(float(np.max(record))),
        n_samples=record.size,
    )

    def mean_gain(voltage):
        return np.mean([_gain(voltage, truth, lambda s: ActuatorLag(time_constant_s=s), k) for k in range(3)])

    new, old = mean_gain(chosen.voltage_V), mean_gain(record)
    assert new > 1.5 * old
    # Promised with sizes known to a factor e, which hardly binds, and to first order in them.
    promised = chosen.separations[0].standard_deviations ** 2
    assert promised / 2 < new < 2 * promised


def test_limits_hold_for_every_hypothesis():
    competing = _competing(None, CoulombFriction(torque_Nm=0.01), ViscousFriction(coefficient_Nms=0.01))
    limits = Limits(2.0, hub_angle_rad=0.5, deflection_m=0.02)
    chosen = next_experiment(competing, limits)
    reach = RIG.hub.radius_m + RIG.link.length_m
    outputs = [simulate(RIG, chosen.voltage_V, r.effects).output for r in competing]
    hub = np.concatenate([y[:, 0] for y in outputs])
    deflection = np.concatenate([y[:, 1] - reach * y[:, 0] for y in outputs])
    assert np.max(np.abs(chosen.voltage_V)) <= 2.0 * (1 + 1e-9)
    assert np.max(np.abs(hub)) <= 0.5
    assert np.max(np.abs(deflection)) <= 0.02
    assert chosen.hub_angle_range_rad == pytest.approx((hub.min(), hub.max()))
    assert chosen.deflection_range_m == pytest.approx((deflection.min(), deflection.max()))
    assert chosen.voltage_V.size * DT == pytest.approx(chosen.duration_s)


def test_every_pair_is_spoken_of_and_the_best_is_first():
    competing = _competing(CoulombFriction(torque_Nm=0.01), ViscousFriction(coefficient_Nms=0.006), None)
    chosen = next_experiment(competing, Limits(1.0))
    assert [s.hypotheses for s in chosen.separations] == [
        ("coulomb_friction", "viscous_friction"),
        ("coulomb_friction", "no effect"),
        ("viscous_friction", "no effect"),
    ]
    scores = [c.score for c in chosen.considered if c.score is not None]
    assert chosen.considered[0].kind == chosen.kind
    assert scores[0] == max(scores)
    # What was not computed could not have won.
    assert all(c.at_most <= scores[0] * (1 + 1e-9) for c in chosen.considered if c.score is None)


def test_records_sharpen_the_separation():
    """Fitted competing have sizes that both fit the same records, and know them: they part no less."""
    delay = InputDelay(delay_s=0.006)
    rng = np.random.default_rng(3)
    residuals = white(rng)
    shift = {
        k: (simulate(RIG, v, (delay,)).output - simulate(RIG, v).output) / NOISE for k, v in inputs().items()
    }
    case = made({k: residuals[k] + shift[k] for k in residuals})
    model = ResidualModel(case)
    fits = []
    for name in ("input_delay", "actuator_lag"):
        candidate = next(c for c in case.machine.candidates(case.experiments) if c.effect == name)
        start = np.array([candidate.axes[0].coordinate(0.006)])
        fits.append(fit(model, (candidate,), (start,), np.zeros(0)))
    known = [competing_hypothesis(case, f, 0.5) for f in fits]
    vague = [CompetingHypothesis(0.5, r.rig, r.effects) for r in known]
    limits = Limits.of_records(case)
    choice = [Excitation("prbs", {}, prbs(9, 4, limits.voltage_V / 2, 700))]
    d, less = (
        next_experiment(r, limits, choices=choice).separations[0].standard_deviations for r in (known, vague)
    )
    assert d > less * (1 - 1e-6)
    ordered = competing_hypotheses(case, [SimpleNamespace(fit=f, log_weight=-f.cost) for f in fits], {})
    assert [r.name for r in ordered] == ["input_delay", "actuator_lag"]


def test_sets_that_name_the_same_cause_do_not_compete():
    residuals = white(np.random.default_rng(0))
    case = made(residuals)
    chosen = {
        c.effect: c
        for c in case.machine.candidates(case.experiments)
        if c.effect in ("input_delay", "actuator_lag")
    }
    start = {name: np.array([c.axes[0].coordinate(0.004)]) for name, c in chosen.items()}

    def fitted(*names):
        model = ResidualModel(case)
        return fit(model, [chosen[n] for n in names], [start[n] for n in names], np.zeros(0), iterations=1)

    sets = {("input_delay",): 0.6, ("actuator_lag", "input_delay"): 0.3, ("actuator_lag",): 0.05, (): 0.05}
    fits = [fitted("input_delay"), fitted("actuator_lag", "input_delay"), fitted("actuator_lag"), fitted()]
    competing = competing_hypotheses(case, [SimpleNamespace(fit=f, log_weight=-f.cost) for f in fits], sets)
    assert competing[0].name == "input_delay"
    assert {r.name for r in competing[1:]} == {"actuator_lag", "no effect"}


def test_effort_is_bounded(monkeypatch):
    """Time is counted in simulations, for that is where it goes."""
    calls = []

    def counted(*args, **kwargs):
        calls.append(1)
        return simulate(*args, **kwargs)

    for module in ("next_experiment", "discrimination"):
        monkeypatch.setattr(f"diagnosis.next_experiment.{module}.simulate", counted)
    competing = _competing(
        CoulombFriction(torque_Nm=0.01), ViscousFriction(coefficient_Nms=0.006), None, rig=TOLERANT
    )
    next_experiment(competing, Limits(1.0, 0.3, 0.05))
    # At most five scalings of 15, and 2 tolerances and one size for every hypothesis.
    assert len(calls) <= 15 * 3 * 5 + 16 * 3 * 3


def test_excitations_fit_their_voltage_and_length():
    found = excitations(2.0, 1001, DT, np.random.default_rng(0))
    assert len(found) == 10
    assert {x.kind for x in found} == {
        "random binary",
        "multisine",
        "doublet",
        "triangle",
        "step and hold",
        "chirp",
    }
    for x in found:
        assert x.voltage_V.shape == (1001,)
        # A sampled chirp or triangle misses its peak by at most a little.
        assert 1.9 < x.amplitude_V <= 2.0 * (1 + 1e-12), x.kind


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Limits(0.0), "limit voltage_V must be positive"),
        (lambda: Limits(1.0, np.nan), "limit hub_angle_rad must be positive"),
        (lambda: next_experiment(_competing(None), Limits(1.0)), "at least two hypotheses; got 1"),
        (lambda: CompetingHypothesis(1.5, RIG), "lies between 0 and 1; got"),
        (
            lambda: CompetingHypothesis(0.5, RIG, precision=np.eye(1)),
            "a hypothesis with directions needs their precision",
        ),
        (lambda: excitations(1.0, 50, DT, np.random.default_rng(0)), "at least 100 samples; got 50"),
        (
            lambda: next_experiment(_competing(None, CoulombFriction(torque_Nm=0.01)), Limits(1.0, 1e-9)),
            "no experiment stays within",
        ),
    ],
)
def test_bad_requests_are_one_clear_line(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
