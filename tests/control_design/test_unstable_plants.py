"""Plants that are unstable in open loop: a low order stabilises them, and the design finds it."""

from typing import Any

import control
import numpy as np
import pytest

from control_design import Specification, UncertainPlant, certify
from control_design.plants.stated_uncertainty import StatedDiscs
from control_design.plants.weights import RationalWeight
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions

_FEW = SynthesisOptions(starts=2, grid_points=60, mode_points=30, dense_points=1500, exchange_rounds=1)


def _plant(numerator: Any, denominator: Any, dt_s: float, delay: int = 0) -> UncertainPlant:
    system = control.c2d(control.ss(control.tf(numerator, denominator)), dt_s, "zoh")
    if delay:
        system = control.series(system, control.ss(control.tf([1], [1] + [0] * delay, dt_s)))
    five_percent = RationalWeight(numerator=(0.05,), denominator=(1.0,))
    return UncertainPlant("unstable", system, StatedDiscs(system, five_percent))


@pytest.mark.parametrize(
    ("plant", "asked"),
    [
        pytest.param(
            _plant([8], [1, 0.85, -30], 0.01),
            {"bandwidth_rad_s": 5.0, "modulus_margin": 0.4, "controller_order": 2},
            id="pendulum",
        ),
        pytest.param(
            _plant([20], [1, -1.6, 1.0], 0.01), {"modulus_margin": 0.3, "controller_order": 2}, id="two poles"
        ),
        pytest.param(
            _plant([2], [1, -2], 0.01, delay=6), {"modulus_margin": 0.3, "controller_order": 1}, id="delay"
        ),
        pytest.param(
            _plant([-1, 20], np.polymul([1, -1], [1, 8]), 0.01),
            {"modulus_margin": 0.25, "controller_order": 2},
            id="non-minimum phase",
        ),
        pytest.param(
            _plant([8100], np.polymul([1, 0, -9], [1, 1.2, 900]), 0.01),
            {"modulus_margin": 0.2, "controller_order": 4},
            id="resonance",
        ),
    ],
)
def test_an_unstable_plant_is_stabilised_by_a_low_order(plant, asked):
    spec = Specification(**asked)
    assert plant.unstable_poles >= 1
    found = synthesise([plant], spec, _FEW, rng=np.random.default_rng(5))
    assert found.gamma <= 1
    k = control.ss(*(getattr(found.controller, m) for m in "ABCD"), plant.dt_s)
    loop = control.series(k, control.ss(0, 1, 1, 0, plant.dt_s), plant.nominal)
    assert np.max(np.abs(control.feedback(loop, 1).poles())) < 1
    assert certify(found.controller, [plant], spec).certified
