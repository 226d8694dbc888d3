"""Evidence against numerical integration, priors and probabilities that sum to one."""

from math import comb

import numpy as np
import pytest
from scipy.integrate import quad

from diagnosis.evidence.hypotheses import Hypothesis, Probabilities, log_evidence, log_prior, probabilities
from diagnosis.fit.discrepancy import discrepancy
from plant import EFFECTS
from plant.effects.search_space import Axis, Candidate
from tests.diagnosis.recorded import end_of_fit

SLOPE = np.array([0.5, -1.2, 0.8, 2.0])


def _candidate(low, high):
    return Candidate(EFFECTS["actuator_gain"], (Axis("ratio", "linear", low, high, 1e-4),), ())


def _linear_fit(target, low, high):
    """Least squares of e = SLOPE x - target inside the box, one coordinate and no nominal parameter."""
    x = float(np.clip(SLOPE @ target / (SLOPE @ SLOPE), low, high))
    e = SLOPE * x - target
    return end_of_fit((_candidate(low, high),), [[x]], e, SLOPE[:, None])


@pytest.mark.parametrize(
    ("optimum", "low", "high"),
    [
        (0.3, -2.0, 2.0),
        (0.95, 0.0, 1.0),
        (-0.4, 0.0, 1.0),
        (-3.0, 0.0, 1.0),
        (2.5, 0.0, 1.0),
        (1.0, 0.0, 1.0),
    ],
    ids=["inside", "near a bound", "below", "far below", "above", "on the bound"],
)
def test_evidence_of_a_linear_model_is_its_integral(optimum, low, high):
    target = SLOPE * optimum + np.array([1.2, 0.5, 0.0, 0.0])
    fit = _linear_fit(target, low, high)
    integral, _ = quad(lambda x: np.exp(-0.5 * np.sum((SLOPE * x - target) ** 2)) / (high - low), low, high)
    # Laplace is exact for a linear model; the cut-off at the bounds is, too.
    assert log_evidence(fit) == pytest.approx(np.log(integral), abs=1e-6)


@pytest.mark.parametrize("at", [0.0, 0.3, 1.0])
def test_a_coordinate_that_nothing_depends_on_neither_adds_nor_takes(at):
    e = np.array([1.2, 0.5, 0.0, 0.0])
    fit = end_of_fit((_candidate(0.0, 1.0),), [[at]], e, np.zeros((4, 1)))
    # Its share of a Gaussian 1e11 wide is 4e-12 and keeps four digits.
    assert log_evidence(fit) == pytest.approx(-0.5 * float(e @ e), abs=1e-4)


def test_evidence_integrates_the_deviations_of_the_nominal():
    rng = np.random.default_rng(3)
    J, e0 = rng.standard_normal((12, 2)), rng.standard_normal(12)
    A = J.T @ J + np.eye(2)
    d = -np.linalg.solve(A, J.T @ e0)
    e = e0 + J @ d
    fit = end_of_fit((), (), e, J, d)
    # Marginal of e0 = -J d + noise: normal with covariance I + J J^T, without the constant of the noise.
    covariance = np.eye(12) + J @ J.T
    expected = -0.5 * e0 @ np.linalg.solve(covariance, e0) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert log_evidence(fit) == pytest.approx(expected, abs=1e-8)


def test_priors_of_all_sets_leave_the_rest_to_unknown():
    names = list(EFFECTS)
    total = sum(comb(len(names), k) * np.exp(log_prior(names[:k])) for k in range(4))
    assert total == pytest.approx(0.9, abs=1e-12)


def test_probabilities_sum_to_one_and_prefer_what_explains_the_records():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(5000)  # 2500 samples of two outputs
    good = _weighed(_fit_with(noise, "tip_payload"))
    bad = _weighed(_fit_with(1.5 * noise, "input_delay"))
    nothing = _weighed(end_of_fit((), (), 2 * noise, np.zeros((5000, 0))))
    weighed = probabilities([good, bad, nothing])
    total, sets = weighed.cause, weighed.sets
    assert sum(total.values()) == pytest.approx(1.0)
    assert sum(sets.values()) == pytest.approx(1.0)
    assert set(total) == {"none", "unknown", *EFFECTS}
    assert total["tip_payload"] > 0.9
    without = probabilities([bad, nothing]).cause
    assert without["unknown"] > 0.99


@pytest.mark.parametrize("leads", [True, False])
@pytest.mark.parametrize("name", ["rounding", "drag"])
def test_a_certain_effect_is_counted_once(name, leads):
    """Whether it was among the sets before, or listed at all."""
    sets = {(): 0.3, ("rounding",): 0.2, ("drag", "rounding"): 0.1, ("drag",): 0.3, ("unknown",): 0.1}
    cause = {"none": 0.3, "drag": 0.6, "unknown": 0.1}
    certain = Probabilities(cause, sets, {"drag": 0.4}).with_certain_effect(name, leads=leads)
    both = tuple(sorted({"drag", "rounding"}))
    assert certain.sets.keys() == {(name,), both, ("unknown",)}
    assert certain.sets[("unknown",)] == 0.1
    assert sum(certain.sets.values()) == pytest.approx(1.0)
    assert sum(certain.cause.values()) == pytest.approx(1.0)
    assert certain.presence[name] == pytest.approx(0.9)
    assert certain.cause["none"] == 0.0


def _fit_with(residuals, effect):
    axis = Axis("mass_kg" if effect == "tip_payload" else "delay_s", "log", 1e-3, 1.0, 1e-5)
    candidate = Candidate(EFFECTS[effect], (axis,), ())
    J = np.full((residuals.size, 1), 0.1)
    return end_of_fit((candidate,), [[-3.0]], residuals, J)


def _weighed(fit):
    return Hypothesis.of(fit, discrepancy(fit.residual_coefficients, [1000, 1500]))
