"""Joint coverage: exact where the answer is known by hand, honest on fresh draws, refused without draws."""

import control
import numpy as np
import pytest
from scipy.stats import norm

from control_design import Controller, PlantChannel, Specification, UncertainPlant, certify
from control_design.analysis.joint_coverage import SampledLoop, joint_coverage
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.set_expansion import stacked
from validation.example_plants import ResponseRecord, flexible_link, flexible_link_specification

from .plants import RelativeDisc, gain, hub_arm, tip_acceleration, uncertain_lag


@pytest.mark.parametrize("coverage", [pytest.param(0.8, marks=pytest.mark.long), 0.95])
def test_one_uncertain_gain_gives_the_one_sided_normal_quantile(coverage):
    """|S| peaks higher the larger the gain, so P(gamma <= worst case of |x| <= r) = P(x <= r), exactly."""
    plant = uncertain_lag(0.1)
    draws = 8000
    found = joint_coverage(
        gain(6.0), [plant], Specification(), rng=np.random.default_rng(1), coverage=coverage, draws=draws
    )
    radius = norm.ppf(coverage)
    # standard error of a quantile: sqrt(c (1 - c)/n)/density; four of them
    error = 4 * np.sqrt(coverage * (1 - coverage) / draws) / norm.pdf(radius)
    assert np.sqrt(-2 * np.log1p(-found.level)) == pytest.approx(radius, abs=error)
    given = np.sqrt(-2 * np.log(0.05))
    # 4.5 standard deviations of the share
    assert found.coverage_given == pytest.approx(norm.cdf(given), abs=4e-3)
    # the whole response lies in the ellipses where |x| <= r
    assert found.simultaneous_given == pytest.approx(1 - 2 * norm.sf(given), abs=6e-3)
    assert found.stable_share == 1.0


def test_unstable_draws_are_those_whose_poles_say_so():
    plant, controller = uncertain_lag(0.3), gain(40.0)
    omega = np.array([1.0])
    rng = np.random.default_rng(2)
    gamma, stable, _ = SampledLoop(controller, plant, Specification()).gamma(rng, 400)
    posterior = plant.uncertainty
    again = posterior.sample(np.random.default_rng(2), 250)  # the first chunk
    share = posterior.response_of(again, omega)[:, 0] / posterior.centre(omega)[0]
    for index, factor in enumerate(np.real(share)):
        # z^2 - 0.98 z + 40 (0.02) factor: gain times lag times one sample of delay
        poles = np.roots([1, -0.98, 40.0 * 0.02 * factor])
        assert stable[index] == (np.max(np.abs(poles)) < 1)
        assert np.isfinite(gamma[index]) == stable[index]
    assert 0 < np.mean(stable) < 1


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["A", "B", "C"])
def test_link_holds_in_95_percent_of_fresh_draws(scenario):
    plant, spec = flexible_link(scenario), flexible_link_specification(1)
    # Largest effort and peak of S both matter for this first-order controller.
    k = [[0.99999]], [[0.002]], [[1.0]], [[0.25]]
    controller = Controller(*k, plant.dt_s, computational_delay_samples=0)
    found = joint_coverage(controller, [plant], spec, rng=np.random.default_rng(1))
    fresh, *_ = SampledLoop(controller, plant, spec).gamma(np.random.default_rng(2), 3000)
    # binomial of 3000 (0.4 %) and of the 4000 calibrating draws (0.34 %): 2 % is almost four of their sum
    assert np.mean(fresh <= found.gamma) == pytest.approx(0.95, abs=0.02)


def test_certificate_uses_the_calibrated_level_and_says_so():
    plant = uncertain_lag(0.05)
    spec = Specification(modulus_margin=0.3)
    plain = certify(gain(6.0), [plant], spec)
    assert plain.joint is None
    high = certify(gain(6.0), [plant], spec, joint_coverage=0.999, rng=np.random.default_rng(0))
    assert high.joint.level > 0.95
    assert high.gamma == pytest.approx(high.joint.gamma, rel=1e-3)
    assert high.gamma > plain.gamma
    assert high.gamma <= high.gamma_bound
    # A level under the given one changes gamma's statement, not the ellipses that are checked.
    low = certify(gain(6.0), [plant], spec, joint_coverage=0.6, rng=np.random.default_rng(0))
    assert low.gamma == plain.gamma > low.joint.gamma


@pytest.mark.slow
def test_performance_channel_and_several_plants_are_drawn_together():
    system, tip = hub_arm(), tip_acceleration()
    measured, performed = (GaussianGain(g, n, 0.05) for g, n in ((system, 1), (tip, 0)))
    arm = UncertainPlant(system, name="arm", uncertainty=measured, performance=PlantChannel(tip, performed))
    spec = Specification(modulus_margin=0.3, mode_peak_ratio=0.9)
    controller = gain(0.3)
    one = joint_coverage(controller, [arm], spec, rng=np.random.default_rng(3), draws=3000)
    fresh, *_ = SampledLoop(controller, arm, spec).gamma(np.random.default_rng(4), 3000)
    # binomial, both sides: 0.56 %; four of it
    assert np.mean(fresh <= one.gamma) == pytest.approx(0.95, abs=0.023)
    # The damping weight rules: gamma is W4 |Gp| |S| at the peak, Gp drawn apart from G.
    exact = UncertainPlant(system, name="exact", performance=PlantChannel(tip))
    centre, *_ = SampledLoop(controller, exact, spec).gamma(np.random.default_rng(0), 1)
    assert one.gamma > centre[0]
    # Twice the same plant, drawn independently: P(max <= q) = P(gamma <= q)^2, so the quantile moves up.
    two = joint_coverage(controller, [arm, arm], spec, rng=np.random.default_rng(3), draws=3000)
    wanted = np.quantile(fresh, np.sqrt(0.95))
    # the density of gamma near its 97 % quantile: 0.3 % of gamma is 0.5 % of probability
    assert two.gamma == pytest.approx(wanted, rel=5e-3)
    assert two.gamma > one.gamma


class GaussianGain:
    """G (1 + std x), x normal: one generator."""

    def __init__(self, system: control.StateSpace, integrators: int, std: float) -> None:
        self.system, self.std = system, std
        self.form = RationalResponse.from_state_space(system, integrators)

    def at(self, omega_rad_s: np.ndarray, level: float) -> ResponseRecord:
        centre = self.form.at(omega_rad_s)
        row = np.stack([centre.real, centre.imag], axis=1) * self.std
        return ResponseRecord(omega_rad_s, centre, row[:, :, None] * row[:, None, :], level)

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        centre = self.form.expand(intervals, cleared)
        return centre, stacked([centre.scaled(self.std)])


def test_what_cannot_be_drawn_from_is_refused():
    rng = np.random.default_rng(0)
    measured = RelativeDisc(hub_arm(), 0.02, 60.0).at(np.geomspace(0.5, 200.0, 200), 0.95)
    plant = UncertainPlant(hub_arm(), name="frf", uncertainty=measured)
    lag = uncertain_lag(0.1)
    with pytest.raises(ValueError, match="needs posterior samples"):
        joint_coverage(gain(0.3), [plant], Specification(), rng=rng)
    with pytest.raises(ValueError, match=r"must lie in \(0, 1\)"):
        joint_coverage(gain(0.3), [lag], Specification(), rng=rng, coverage=95.0)
    with pytest.raises(ValueError, match="at least 100 draws"):
        joint_coverage(gain(0.3), [lag], Specification(), rng=rng, draws=10)
    with pytest.raises(ValueError, match="at least one plant"):
        joint_coverage(gain(0.3), [], Specification(), rng=rng)
    with pytest.raises(ValueError, match="needs rng"):
        certify(gain(0.3), [lag], Specification(), joint_coverage=0.95)
