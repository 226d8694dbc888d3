"""Where tracking is asked of plants whose ellipses hold a gain of zero at low frequency."""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np
import pytest

from control_design import certify
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant, frequency_response
from control_design.specification import Specification
from control_design.specification.told_band import tracking_where_told
from ident.data.frequency_uncertainty import FrequencyUncertainty

DT_S = 0.01


@dataclass(frozen=True)
class UntoldBelow:
    """Circles about a response: 10 % of the gain, and below a frequency, rad/s, more than all of it."""

    system: control.StateSpace
    below_rad_s: float

    def at(self, omega_rad_s: Real, level: float) -> FrequencyUncertainty:
        """Ellipses of any level with these radii."""
        centre: Complex = frequency_response(self.system, omega_rad_s)
        share = 0.1 * np.maximum(1.0, 10.5 * (omega_rad_s < self.below_rad_s))
        variance = (share * np.abs(centre)) ** 2 / (-2 * np.log1p(-level))
        covariance = variance[:, None, None] * np.eye(2)
        return FrequencyUncertainty(omega_rad_s, centre, covariance, DT_S, level)


def axis(below_rad_s: float) -> UncertainPlant:
    """1 / (s + 1), told from a frequency on."""
    system = control.ss(control.tf([1.0], [1.0, 1.0]).sample(DT_S))
    return UncertainPlant(system, name="axis", uncertainty=UntoldBelow(system, below_rad_s))


ASKED = Specification(bandwidth_rad_s=5.0, lowest_bandwidth_rad_s=0.1, integrator=True)


@pytest.mark.parametrize("below_rad_s", [0.02, 0.3, 2.0])
def test_tracking_begins_above_the_frequencies_that_hold_zero(below_rad_s: float) -> None:
    """Not far above, and no bandwidth below it is sought."""
    told = tracking_where_told(ASKED, [axis(0.0), axis(below_rad_s)])
    assert told.tracking_from_rad_s is not None
    assert told.lowest_bandwidth_rad_s is not None
    assert below_rad_s < told.tracking_from_rad_s < 1.3 * below_rad_s
    assert told.lowest_bandwidth_rad_s == pytest.approx(max(0.1, 1.1 * told.tracking_from_rad_s), rel=0.01)


def test_a_plant_that_is_told_leaves_the_specification_as_it_is() -> None:
    """And so does a plant that is not where tracking is stated to begin, or where none is asked."""
    assert tracking_where_told(ASKED, [axis(0.0)]) is ASKED
    stated = ASKED.model_copy(update={"tracking_from_rad_s": 0.5})
    assert tracking_where_told(stated, [axis(0.3)]) is stated
    damping = Specification(controller_order=2)
    assert tracking_where_told(damping, [axis(0.3)]) is damping


def test_a_loop_that_cannot_track_below_is_certified_from_there_on() -> None:
    """Asked everywhere it misses, for zero is a member of the ellipses; asked above them it does not."""
    # K = 8 / (s / 60 + 1), in z by Tustin.
    law = control.ss(control.tf([8.0], [1 / 60, 1.0]).sample(DT_S, "tustin"))
    controller = Controller(law.A, law.B, law.C, law.D, DT_S, computational_delay_samples=0)
    asked = Specification(
        bandwidth_rad_s=2.0,
        low_frequency_rejection=0.2,
        modulus_margin=0.4,
        computational_delay_samples=0,
    )
    plant = axis(0.01)
    everywhere = certify(controller, [plant], asked, n_dense=1500)
    told = certify(controller, [plant], tracking_where_told(asked, [plant]), n_dense=1500)
    missed = {item.requirement for item in everywhere.items if not item.met}
    assert "tracking, largest |W1 S|" in missed
    tracking = next(item for item in told.items if item.requirement.startswith("tracking"))
    assert tracking.met
    assert tracking.requirement.endswith("rad/s on")


def test_from_where_on_needs_something_to_track() -> None:
    """Said by its name."""
    with pytest.raises(ValueError, match="tracking_from_rad_s needs bandwidth_rad_s"):
        Specification(tracking_from_rad_s=1.0)
