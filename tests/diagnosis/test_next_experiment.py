"""The next experiment separates what differs, says when nothing does, and keeps the machine in its limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from diagnosis import Change, EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, ResidualModel
from diagnosis.evidence.hypotheses import Hypothesis
from diagnosis.fit.nominal import LogNormalParameters
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.next_experiment import discrimination
from diagnosis.next_experiment.experiment_choices import Limits, excitations
from diagnosis.next_experiment.next_experiment import next_experiment
from diagnosis.next_experiment.repeat import best_repeat
from diagnosis.search.white import descend_to_end
from plant import prbs, simulate
from plant.effects.actuator import ActuatorLag, ActuatorSaturation, InputDelay
from plant.effects.joint import CoulombFriction, ViscousFriction
from plant.effects.link import TipPayload
from tests.diagnosis.recorded import end_of_fit
from tests.diagnosis.synthetic_residuals import DT, NOISE, RIG, inputs, made, white

TOLERANT = RIG.model_copy(update={"tolerances": {"hub.inertia_kg_m2": 0.05, "motor.resistance_ohm": 0.03}})


CASE = made(white(np.random.default_rng(0)))


def _competing(*effects, rig=RIG):
    """With nothing free."""
    return tuple(
        discrimination.CompetingHypothesis(1 / len(effects), rig, () if e is None else (e,)) for e in effects
    )


def _candidate(effect, case=CASE):
    return next(c for c in case.machine.candidates(case.experiments) if c.effect == effect)


def _vague(*effects, rig=RIG):
    """With effect parameters known to a factor e and nominal ones to their tolerances, no record yet."""
    case, P = replace(CASE, rig=rig), len(rig.tolerances)
    found = []
    for effect in effects:
        candidate = _candidate(effect.id)
        x = np.array([axis.coordinate(effect.parameters()[axis.parameter]) for axis in candidate.axes])
        known = np.hstack([np.zeros((x.size, P)), np.eye(x.size)])
        end = end_of_fit((candidate,), [x], np.zeros(x.size), known, np.zeros(P))
        found.append(discrimination.competing_hypothesis(case, end, 1 / len(effects)))
    return tuple(found)


def _distance(competing, voltage):
    whitened = [(simulate(c.rig, voltage, c.effects).output / NOISE).ravel() for c in competing]
    return discrimination.distances(competing, voltage, whitened)[0][0]


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
    first = discrimination.CompetingHypothesis(0.97, RIG, (TipPayload(mass_kg=0.01),))
    second = discrimination.CompetingHypothesis(0.001, RIG)
    assert next_experiment((first, second), Limits(1.0)).decided


def test_identical_hypotheses_are_not_separated():
    effect = CoulombFriction(torque_Nm=0.01)
    chosen = next_experiment(_competing(effect, effect), Limits(1.0))
    assert not chosen.separates
    assert chosen.separations[0].standard_deviations == 0.0
    assert len(chosen.considered) == 15


def test_what_free_parameters_absorb_does_not_count():
    """Two sizes of one effect are one explanation."""
    sizes = TipPayload(mass_kg=0.010), TipPayload(mass_kg=0.011)
    free, held = (
        next_experiment(kind(*sizes), Limits(1.0)).separations[0].standard_deviations
        for kind in (_vague, _competing)
    )
    assert held > 10
    # What a tenth more costs sizes known to a factor e, log 1.1 = 0.095, and the curvature of the response.
    assert free < 0.02 * held


def test_tolerances_only_take_separation_away():
    effects = (InputDelay(delay_s=0.006), ActuatorLag(time_constant_s=0.006))
    voltage = prbs(9, 4, 1.0, 700)
    d, less = (_distance(_vague(*effects, rig=rig), voltage) for rig in (RIG, TOLERANT))
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
    hypotheses = (*_competing(truth), *_vague(ActuatorLag(time_constant_s=0.006)))
    chosen = next_experiment(hypotheses, Limits(float(np.max(record))), n_samples=record.size)

    def mean_gain(voltage):
        return np.mean([_gain(voltage, truth, lambda s: ActuatorLag(time_constant_s=s), k) for k in range(3)])

    new, old = mean_gain(chosen.voltage_V), mean_gain(record)
    assert new > 1.5 * old
    # Promised with a lag known to a factor e, which hardly binds, and to first order in it.
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
    """Fitted hypotheses have sizes that both fit the same records, and know them: they part no less."""
    delay = InputDelay(delay_s=0.006)
    residuals = white(np.random.default_rng(3))
    shift = {
        k: (simulate(RIG, v, (delay,)).output - simulate(RIG, v).output) / NOISE for k, v in inputs().items()
    }
    case = made({k: residuals[k] + shift[k] for k in residuals})
    fits = []
    for name in ("input_delay", "actuator_lag"):
        candidate = _candidate(name, case)
        start = np.array([candidate.axes[0].coordinate(0.006)])
        fits.append(descend_to_end(ResidualModel(case), (candidate,), start, np.zeros(0)))
    known = [discrimination.competing_hypothesis(case, f, 0.5) for f in fits]
    vague = [replace(one, precision=np.eye(1)) for one in known]
    voltage = prbs(9, 4, Limits.of_records(case).voltage_V / 2, 700)
    assert _distance(known, voltage) > _distance(vague, voltage) * (1 - 1e-6)
    ordered = discrimination.competing_hypotheses(case, [Hypothesis(f, -f.cost, -np.inf) for f in fits], {})
    assert [r.name for r in ordered] == ["input_delay", "actuator_lag"]


def test_sets_that_name_the_same_cause_do_not_compete():
    sets = {("input_delay",): 0.6, ("actuator_lag", "input_delay"): 0.3, ("actuator_lag",): 0.05, (): 0.05}
    found = []
    for names, p in sets.items():
        candidates = [_candidate(name) for name in names]
        start = np.array([c.axes[0].coordinate(0.004) for c in candidates])
        end = descend_to_end(ResidualModel(CASE), candidates, start, np.zeros(0))
        found.append(Hypothesis(end, np.log(p), -np.inf))
    competing = discrimination.competing_hypotheses(CASE, found, sets)
    assert competing[0].name == "input_delay"
    assert {r.name for r in competing[1:]} == {"actuator_lag", "no effect"}


def test_effort_is_bounded(monkeypatch):
    """Time is counted in simulations, for that is where it goes."""
    calls = []

    def counted(*args, **kwargs):
        calls.append(1)
        return simulate(*args, **kwargs)

    monkeypatch.setattr("diagnosis.next_experiment.discrimination.simulate", counted)
    competing = _vague(CoulombFriction(torque_Nm=0.01), ViscousFriction(coefficient_Nms=0.006), rig=TOLERANT)
    next_experiment((*competing, discrimination.CompetingHypothesis(0.5, TOLERANT)), Limits(1.0, 0.3, 0.05))
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
        (
            lambda: next_experiment(
                [discrimination.CompetingHypothesis(0.5, "a simulation", noise=np.ones(1), name="own")] * 2,
                Limits(1.0),
            ),
            "own: excitations are made for a rig's motor",
        ),
        (lambda: discrimination.CompetingHypothesis(1.5, RIG), "lies between 0 and 1; got"),
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


def test_a_fitted_rig_competes_with_the_values_it_was_fitted_with():
    """Beside a model error a deviation multiplies a value by exp(t d); else it divides it by 1 + t d."""
    nominal, d = LogNormalParameters(FlexibleArm(TOLERANT)), np.array([1.5, -0.5])
    found = discrimination.fitted_hypothesis(nominal, (), d, np.zeros(0), np.eye(2), 0.5, NOISE, ("none",))
    for key, tolerance, deviation in zip(TOLERANT.tolerances, TOLERANT.tolerances.values(), d, strict=True):
        assert found.rig.value(key) == pytest.approx(TOLERANT.value(key) * np.exp(tolerance * deviation))


def _valve(parameters, effects, inputs):
    """(T, 1) -> (T, 1), at once; a gain, a dead zone or an end of travel."""
    y = parameters["gain"] * inputs
    if "dead_zone" in effects:
        y = np.sign(y) * np.maximum(np.abs(y) - effects["dead_zone"]["width"], 0)
    limit = effects["end"]["limit"] if "end" in effects else np.inf
    return np.clip(y, -limit, limit)


def _open(*changes, free=False):
    """Answers about the valve that are left after two records; with `free`, its gain follows."""
    parameter = EffectParameter("width", 1e-3, 1.0), EffectParameter("limit", 0.1, 10.0)
    effects = PlantEffect("dead_zone", parameter[:1]), PlantEffect("end", parameter[1:])
    plant = Plant(_valve, {"gain": 1.0}, {"gain": 0.5}, ("y",), np.array([1e-3]), effects, 0.05)
    rng = np.random.default_rng(0)
    records = [
        PlantExperiment(name, role, u, _valve({"gain": 1.0}, {}, u) + 1e-3 * rng.standard_normal(u.shape))
        for name, role, size in (("small", "estimation", 1.0), ("large", "held_out", 3.0))
        for u in [size * np.sin(0.1 * np.arange(200.0))[:, None]]
    ]
    noise = np.array([0.02])
    follows = {"directions": lambda u: u / noise, "precision": np.zeros((1, 1))} if free else {}
    competing = tuple(
        discrimination.CompetingHypothesis(0.5, plant, (change,) if change else (), noise=noise, **follows)
        for change in changes
    )
    return PlantCase("valve", plant, records), competing


def test_of_ones_own_machine_the_record_that_shows_the_difference_is_repeated():
    # A dead zone is a larger share of a small motion, which tolerates less; an end shows in large ones.
    zone = best_repeat(*_open(None, Change("dead_zone", {"width": 0.05})))
    assert (zone.record, zone.change) == ("small", "third")
    assert zone.separations[0].standard_deviations > 2 * zone.same[0].standard_deviations
    end = best_repeat(*_open(None, Change("end", {"limit": 2.9})))
    assert (end.record, end.separates) == ("large", True)
    nothing = best_repeat(*_open(None, Change("end", {"limit": 3.5})))
    assert not nothing.separates


@pytest.mark.parametrize("bound", [2.0, 0.5])
def test_where_a_hypothesis_runs_away_nothing_is_recorded(bound):
    """A model that is unstable in large motions says nothing about how far a machine would go there."""
    case, _ = _open(None)

    def simulate(parameters, effects, inputs):
        y = _valve(parameters, effects, inputs)
        return np.where((np.abs(inputs) > bound) & ("dead_zone" in effects), 1e13, y)

    plant = replace(case.plant, simulation=simulate)
    noise = np.array([0.02])
    competing = tuple(
        discrimination.CompetingHypothesis(0.5, plant, changes, noise=noise)
        for changes in ((), (Change("dead_zone", {"width": 0.05}),))
    )
    found = best_repeat(case, competing)
    assert found.record == "small"
    assert found.change == ("third" if bound < 1 else found.change)
    assert found.separations[0].standard_deviations < 1e3


def test_what_a_free_gain_imitates_separates_nothing():
    case, (stated, _) = _open(None, None, free=True)
    other = replace(stated, rig=case.plant.scaled({"gain": 1.2}))
    assert best_repeat(case, (stated, other)).separations[0].standard_deviations < 1e-4
    known = tuple(replace(one, precision=np.eye(1) * 1e12) for one in (stated, other))
    assert best_repeat(case, known).separates
