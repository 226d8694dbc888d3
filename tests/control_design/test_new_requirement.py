"""A requirement that the numerics have never heard of: one class, and everything takes it up."""

import numpy as np
import pytest

from control_design import (
    Controller,
    LoopFunction,
    RationalWeight,
    Specification,
    SynthesisOptions,
    UncertainPlant,
    YoulaOptions,
    certify,
    synthesise,
    youla_bracket,
)
from control_design.controllers.biquads import Cascade
from control_design.specification import WeightedRequirement, specification
from control_design.synthesis.problem import Problem
from control_design.synthesis.rows import LoopRows
from validation.example_plants import flexible_link

from .plants import RelativeDisc, tip_acceleration

_LIMIT, _CORNER = 1.3, 40.0


class ComplementaryLimit(WeightedRequirement):
    """|T| below a limit that falls above a corner."""

    name, caption, function = "complementary", "largest |W T|", LoopFunction.COMPLEMENTARY

    @classmethod
    def of(cls, spec, plant):
        numerator = (1 / _LIMIT / _CORNER, 1 / _LIMIT)
        return cls(RationalWeight(numerator=numerator, denominator=(1 / 4000.0, 1.0)))


@pytest.fixture(autouse=True)
def _asked(monkeypatch):
    monkeypatch.setattr(specification, "REQUIREMENTS", (*specification.REQUIREMENTS, ComplementaryLimit))


def _sampled(controller: Controller, plant: UncertainPlant, near_rad_s: float) -> float:
    """Largest |W T| over members on the ellipses' boundaries, on a grid that is also fine near a frequency:
    the resonance of a weak controller is narrower than the spacing over all decades."""
    everywhere = np.geomspace(1e-3, plant.nyquist_rad_s * (1 - 1e-6), 4000)
    omega = np.union1d(everywhere, near_rad_s * np.linspace(0.98, 1.02, 801))
    e, k = plant.at(omega), controller.response(omega)
    s = 2j / plant.dt_s * np.tan(omega * plant.dt_s / 2)
    weight = np.abs((s / _CORNER + 1) / _LIMIT / (s / 4000 + 1))
    found = 0.0
    for angle in np.linspace(0, 2 * np.pi, 721):
        loop = k * e.points(np.cos(angle), np.sin(angle))
        found = max(found, float(np.max(weight * np.abs(loop / (1 + loop)))))
    return found


@pytest.mark.slow
def test_it_is_designed_for_checked_and_proved_between_grid_points():
    plant, spec = flexible_link("B"), Specification(bandwidth_rad_s=0.5, controller_order=1)
    options = SynthesisOptions(starts=1, exchange_rounds=1, dense_points=2000, grid_points=60)
    result = synthesise([plant], spec, options, rng=np.random.default_rng(1))
    certificate = certify(result.controller, [plant], spec)
    (item,) = [each for each in certificate.items if each.requirement == "largest |W T|"]
    assert item.achieved <= 1.01 * result.gamma  # 2000 points against a refined grid
    # 721 angles of the boundary: the worst member is missed by (pi/720)^2/2 of the ellipse at most.
    assert (
        item.achieved * (1 - 1e-3)
        <= _sampled(result.controller, plant, item.omega_rad_s)
        <= item.achieved * (1 + 1e-9)
    )
    assert item.achieved <= item.bound <= 1.005 * item.achieved
    assert certificate.plants[0].all_frequencies.proved
    assert youla_bracket(plant, spec, YoulaOptions(dense_points=1000, grid_points=40)).floor <= result.gamma


def test_slopes_and_curvature_of_its_rows_are_derivatives():
    plant = UncertainPlant(
        tip_acceleration(), name="tip", uncertainty=RelativeDisc(tip_acceleration(), 0.03, 60.0)
    )
    problem = Problem((plant,), Specification(controller_order=2), SynthesisOptions())
    cascade = Cascade(("second_order",), problem.dt_s, problem.scale_rad_s)
    x = np.array([0.03, 0.04, 0.05, 0.3, 0.4])
    rows = LoopRows(cascade, problem.rows())
    log, slope = rows.rows(x), rows.slopes(x)
    step = 1e-5
    moved = [(x + step * unit, x - step * unit) for unit in np.eye(x.size)]
    central = np.stack([(rows.rows(up) - rows.rows(down)) / (2 * step) for up, down in moved], axis=1)
    # Worst members are refined to about 1e-9 of log, which central differences magnify by 1/step.
    np.testing.assert_allclose(slope, central, atol=2e-3 * np.max(np.abs(slope)))
    share = np.random.default_rng(1).random(log.size)
    bends = [share @ (rows.slopes(up) - rows.slopes(down)) / (2 * step) for up, down in moved]
    bend = np.stack(bends, axis=1)
    np.testing.assert_allclose(rows.curvature(x, share), bend, atol=1e-2 * np.max(np.abs(bend)))
