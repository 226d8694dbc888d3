"""Spaces of effects: the one in place of a stated value, and what is an effect only by name."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from diagnosis.evidence.hypotheses import Hypothesis
from diagnosis.fit.discrepancy import discrepancy
from diagnosis.machine.case import Case, Experiment
from diagnosis.search.moves import in_place_of
from plant.effects import LOOK_ALIKES
from plant.presets import paper_link
from tests.diagnosis.recorded import end_of_fit

TOLERANCE = 0.05


@pytest.fixture
def listed():
    return _listed()


def _listed(swing_rad=0.5):
    """Of a rig whose hub inertia is known to five per cent."""
    rig = paper_link().model_copy(update={"tolerances": {"hub.inertia_kg_m2": TOLERANCE}})
    output = np.column_stack([np.linspace(-0.5, 0.5, 50) * swing_rad] * 2)
    record = Experiment("only", "estimation", np.ones(50), output)
    case = Case("arm", rig, (record, replace(record, name="other", role="held_out")))
    return case.machine.candidates(case.experiments)


def test_every_prior_density_integrates_to_one(listed):
    for axis in (axis for candidate in listed for axis in candidate.axes):
        low, high = (0.0, 2 * np.pi) if axis.scale == "angle" else axis.box
        edges = [] if axis.usual is None else [axis.coordinate(v) for v in axis.usual]
        total, _ = quad(lambda x, axis=axis: np.exp(axis.log_density(x)), low, high, points=edges or None)
        assert total == pytest.approx(1.0, rel=1e-9), axis


def test_a_stated_value_is_seldom_wrong_by_more_than_thirty_tolerances(listed):
    above, below = [c.axes[0] for c in listed if c.effect == "hub_inertia"]
    factor = 1 + 30 * TOLERANCE
    for axis, inside, beyond in (
        (above, 0.99 * factor, 1.01 * factor),
        (below, 1.01 / factor, 0.99 / factor),
    ):
        assert axis.log_density(np.log(inside)) > axis.log_density(np.log(beyond)) + 1
    # Of what is stated as exact nothing of that kind is known.
    (exact, _) = [c.axes[0] for c in listed if c.effect == "link_stiffness"]
    assert exact.log_density(np.log(1.01)) == exact.log_density(np.log(9.0))


@pytest.mark.parametrize(
    ("factor", "ratio"),
    [
        (1.4, 1.4),
        (0.6, 0.6),
        # Worth a name from three tolerances on; a value pulled by less begins there.
        (1 + 2.5 * TOLERANCE, 1 + 3 * TOLERANCE),
        (1 - 2.5 * TOLERANCE, 1 - 3 * TOLERANCE),
    ],
)
def test_a_pulled_inertia_is_another_inertia_of_that_size_or_the_nearest_worth_a_name(listed, factor, ratio):
    candidate, x = in_place_of("hub.inertia_kg_m2", factor, listed)
    assert candidate.effect == "hub_inertia"
    assert candidate.parameters(x)["ratio"] == pytest.approx(ratio, rel=1e-12)


def test_a_body_on_a_spring_is_looked_for_where_it_swings_and_a_log_shows_it(listed):
    """From a swing in two seconds to eight samples a swing; faster, it is inertia of the hub."""
    inertia = next(c for c in listed if c.effect == "hub_inertia")
    rig = paper_link()
    body = LOOK_ALIKES["attached_body"].in_place_of(inertia, np.array([np.log(3.0)]), rig)
    axes = {axis.parameter: axis for axis in body.axes}
    seeming = (3.0 - 1) * rig.hub.inertia_kg_m2  # what three times the hub's inertia leaves for the body
    period_s = [
        2 * np.pi * np.sqrt(seeming / stiffness)
        for stiffness in (axes["stiffness_Nm_rad"].low, axes["stiffness_Nm_rad"].high)
    ]
    assert period_s == pytest.approx([2.0, 8 * rig.sampling.dt_s])
    assert len(body.starts) == 6
    for start in body.starts:
        found = body.parameters(start)
        assert found["inertia_kg_m2"] == pytest.approx(seeming)
        swing_rad_s = np.sqrt(found["stiffness_Nm_rad"] / seeming)
        assert 2 * np.pi / period_s[0] < swing_rad_s < 2 * np.pi / period_s[1]
        assert found["damping_Nms"] == pytest.approx(2 * 0.1 * swing_rad_s * seeming)


def test_a_value_that_no_effect_multiplies_has_none_in_its_place(listed):
    assert in_place_of("link.density_kg_m3", 1.5, listed) is None


def _ripple(listed, cycles_per_rev):
    """Its hypothesis where nothing but noise is left over, at any number of cycles."""
    (ripple,) = [c for c in listed if c.effect == "torque_ripple"]
    x = np.array([0.0, cycles_per_rev, 0.0])
    e = np.random.default_rng(5).standard_normal(200)
    jacobian = np.random.default_rng(6).standard_normal((200, 3))
    end = end_of_fit((ripple,), [x], e, jacobian)
    return Hypothesis.of(end, discrepancy(e, [100], 2))


def test_a_period_that_no_record_completes_is_rather_something_unknown(listed):
    (ripple,) = [c for c in listed if c.effect == "torque_ripple"]
    least = ripple.axes[1].low
    # A swing of 0.5 rad is a quarter of a period there.
    assert least == pytest.approx(np.pi)
    inside, at_edge = _ripple(listed, 3 * least), _ripple(listed, least)
    assert inside.log_weight > inside.log_weight_with_unknown
    assert at_edge.log_weight < at_edge.log_weight_with_unknown


def test_what_comes_once_per_revolution_is_a_weight_and_no_ripple():
    (ripple,) = [c for c in _listed(swing_rad=6.0) if c.effect == "torque_ripple"]
    assert ripple.axes[1].low == 2.0
