"""Descents in bent and flat valleys; records by an independent simulator."""

import numpy as np
import pytest

from diagnosis import Experiment, ResidualModel
from diagnosis.fit import starts as starts_module
from diagnosis.fit.coordinates import parameter_intervals, widening_tolerance
from diagnosis.fit.levels import Levels
from diagnosis.fit.likelihood import White
from diagnosis.fit.starts import points_of
from diagnosis.search.white import descend_to_end
from plant import EFFECTS
from plant.effects.search_space import Axis, Candidate, log_axis
from tests.diagnosis.recorded import simulated_case
from validation.blind.rigs import draw_rig, draw_tolerances, stated


@pytest.fixture(scope="module")
def compliant(tmp_path_factory):
    """A joint that gives, on a rig whose stated values are off by draws of their tolerances."""
    rng = np.random.default_rng(21)
    table = draw_rig(rng)
    tolerances = draw_tolerances(rng)
    known = stated(table, tolerances, rng)
    link = table["link"]
    spring = link["youngs_modulus_Pa"] * link["width_m"] * link["thickness_m"] ** 3 / 4 / link["length_m"]
    effect = {"name": "joint_compliance", "stiffness_Nm_rad": 30 * spring, "damping_Nms": 0.03 * spring}
    records = [
        ("held_out" if k == 2 else "estimation", [effect], hold, 0.8) for k, hold in enumerate((6, 12, 25))
    ]
    return simulated_case(
        tmp_path_factory.mktemp("rig"), table, records, rng, register=8, stated=known, tolerances=tolerances
    )


@pytest.fixture(scope="module")
def ends(compliant):
    """Where the best starts of the screening end, as in a search."""
    model = ResidualModel(compliant)
    base = descend_to_end(model, (), np.zeros(0), np.zeros(model.nominal.count))
    (space,) = [
        c for c in compliant.machine.candidates(compliant.experiments) if c.effect == "joint_compliance"
    ]
    starts = points_of(model, base, space)[:12]
    return [descend_to_end(model, (space,), s.coordinates, s.deviations) for s in starts]


@pytest.mark.slow
def test_most_starts_end_in_one_minimum_although_it_lies_in_a_flat_valley(ends):
    best = min(ends, key=lambda end: end.cost)
    # A descent ends where less than half a unit of the cost is to be gained.
    assert sum(end.cost < best.cost + 1.0 for end in ends) >= len(ends) / 2
    scale = np.sqrt(np.diag(best.hessian))
    values = np.linalg.eigvalsh(best.hessian / np.outer(scale, scale))
    assert values[0] < 1e-3 * values[-1]


@pytest.mark.slow
def test_the_minimum_leaves_white_noise(ends):
    best = min(ends, key=lambda end: end.cost)
    n = best.residual_coefficients.size
    assert best.converged
    # White noise leaves n +- sqrt(2 n), three of them; ten fitted values take ten.
    assert abs(best.cost - (n - 10)) < 3 * np.sqrt(2 * n) + 10


@pytest.mark.parametrize("Hz", [0.1, 7.3, 33.0])
def test_few_of_many_frequencies_have_the_best_among_them(tmp_path, monkeypatch, Hz):
    """Of a long record only the most promising are fitted; here of a short one, to compare with all."""
    rng = np.random.default_rng(3)
    sine = {"name": "periodic_disturbance", "amplitude_Nm": 0.1, "frequency_Hz": Hz, "phase_rad": 1.0}
    friction = {"name": "coulomb_friction", "torque_Nm": 0.01}
    records = [(role, [sine, friction], 8, 0.25) for role in ("estimation", "held_out")]
    case = simulated_case(tmp_path, draw_rig(rng), records, rng)
    model = ResidualModel(case)
    base = descend_to_end(model, (), np.zeros(0), np.zeros(model.nominal.count))
    (space,) = [c for c in case.machine.candidates(case.experiments) if c.effect == sine["name"]]
    everywhere = points_of(model, base, space)
    for name, few in (("MOST_LINES", 10), ("BEST_LINES", 40), ("SLOW_LINES", 10)):
        monkeypatch.setattr(starts_module, name, few)
    assert len(everywhere) > 200
    best, *others = points_of(model, base, space)
    assert len(others) == 39
    assert (best.loss, best.coordinates[1]) == (everywhere[0].loss, everywhere[0].coordinates[1])


# On seed 6 a thousandth of the gap changes a record by 0.6 noise deviations: quotients over steps of half a
# per cent measure how contacts happen to fall, and the descent ends with an amplitude 6 % off.
@pytest.mark.parametrize(
    "seed",
    [*(pytest.param(k, marks=pytest.mark.long) for k in (0, 1, 3)), pytest.param(6, marks=pytest.mark.slow)],
)
def test_a_disturbance_beside_backlash_is_found_from_a_fifth_off(tmp_path, seed):
    """Where contacts switch, coarse difference quotients lead to the amplitude."""
    table = draw_rig(np.random.default_rng(seed))
    sine = {"amplitude_Nm": 0.03, "frequency_Hz": 0.56, "phase_rad": 4.6}
    effects = [{"name": "backlash", "gap_rad": 0.03}, {"name": "periodic_disturbance", **sine}]
    records = [(role, effects, 8, 0.25) for role in ("estimation", "held_out")]
    case = simulated_case(tmp_path, table, records, np.random.default_rng(seed))
    listed = {c.effect: c for c in case.machine.candidates(case.experiments)}
    pair = [listed["backlash"], listed["periodic_disturbance"]]
    start = np.array([np.log(0.0295), np.log(0.036), 0.56, 4.6])
    end = descend_to_end(ResidualModel(case), pair, start, np.zeros(0))
    assert end.cost < end.residual_coefficients.size + 4 * np.sqrt(2 * end.residual_coefficients.size)
    assert end.candidates[1].parameters(end.coordinates_of(1))["amplitude_Nm"] == pytest.approx(
        0.03, rel=0.01
    )


def _records(rng):
    """Two estimation records (60, 2) of nothing but noise."""
    return [
        Experiment(name, "estimation", rng.standard_normal(60), rng.standard_normal((60, 2)))
        for name in ("a", "b")
    ]


NOISE = np.array([0.1, 0.3])


@pytest.mark.parametrize(
    "likelihood",
    [White(NOISE, np.zeros(2)), Levels.of(_records(np.random.default_rng(0)), NOISE, 0.05)],
    ids=["white", "levels"],
)
def test_a_descent_may_stand_before_either_likelihood(likelihood):
    """What it takes for granted: weights are the slope of the loss over e, `linearised` that of
    `to_coefficients`, and `to_residuals` its inverse."""
    rng = np.random.default_rng(1)
    residuals = [rng.standard_normal((60, 2)) for _ in range(2)]
    e = np.concatenate([likelihood.to_coefficients(r) for r in residuals])
    direction = rng.standard_normal(e.size)
    slope = (likelihood.loss(e + 1e-5 * direction) - likelihood.loss(e - 1e-5 * direction)) / 2e-5
    assert slope == pytest.approx(likelihood.weights(e) * e @ direction, rel=1e-6)
    np.testing.assert_allclose(likelihood.to_residuals(e[:120], 2), residuals[0], atol=1e-12)
    change = rng.standard_normal((60, 2))
    moved = likelihood.to_coefficients(residuals[0] + change) - likelihood.to_coefficients(residuals[0])
    np.testing.assert_allclose(likelihood.linearised(change).ravel(), moved, atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "size", "angle", "low"),
    [
        ("gravity", "acceleration_m_s2", "direction_rad", -np.pi),
        ("torque_ripple", "amplitude_Nm", "phase_rad", 0.0),
        ("periodic_disturbance", "amplitude_Nm", "phase_rad", 0.0),
    ],
)
def test_an_angle_near_the_end_of_its_range_has_a_narrow_interval(effect, size, angle, low):
    """Draws beyond the end come back at the begin, a turn away: they are as near all the same."""
    axes = [log_axis(size, 0.01, 10.0), Axis(angle, "angle", low, low + 2 * np.pi, 1e-4)]
    coordinates = [0.0, low + 2 * np.pi - 0.02]
    if effect == "torque_ripple":
        axes.insert(1, Axis("cycles_per_rev", "linear", 2.0, 80.0, 1e-4))
        coordinates.insert(1, 12.0)
    if effect == "periodic_disturbance":
        axes.insert(1, Axis("frequency_Hz", "linear", 0.1, 60.0, 1e-4))
        coordinates.insert(1, 7.0)
    candidate = Candidate(EFFECTS[effect], tuple(axes), ())
    spread = np.array([0.1] * (len(axes) - 1) + [0.05])
    rng = np.random.default_rng(0)
    interval = parameter_intervals(candidate, np.array(coordinates), np.diag(spread**2), rng)[angle]
    assert interval == pytest.approx((coordinates[-1] - 0.098, coordinates[-1] + 0.098), abs=0.015)


@pytest.mark.parametrize(("known", "blamed"), [(0.1, None), (10.0, 0)])
def test_an_interval_that_tolerances_make_wide_says_by_which(known, blamed):
    """Two nominal values a, b (tolerance 1) and a size s. One record tells s + a to 0.1, another s + b/90 to
    `known`: only where that is much does s hang on a."""
    rows = np.array([[10.0, 0.0, 10.0], [0.0, 1 / known / 90, 1 / known]])
    inverse = np.linalg.inv(rows.T @ rows + np.diag([1.0, 1.0, 0.0]))
    exact = 1 / (rows.T @ rows)[2, 2]
    assert (exact < 0.25 * inverse[2, 2]) == (blamed is not None)
    assert widening_tolerance(inverse, 2, 2, inverse[2, 2]) == blamed
    assert widening_tolerance(inverse, 2, 2, 100 * inverse[2, 2]) is None  # other doubts are larger
    assert widening_tolerance(inverse[2:, 2:], 0, 0, inverse[2, 2]) is None
