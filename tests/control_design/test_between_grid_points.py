"""Bounds for all frequencies: never below what sampling finds, close to it, honest where none is had."""

import control
import numpy as np
import pytest

from control_design import Controller, PlantChannel, Specification, UncertainPlant, certify
from control_design.analysis.between_grid_points import Obstacle
from control_design.analysis.worst_case import worst_case
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import frequency_response
from control_design.plants.set_expansion import stacked
from ident import Poles
from ident.uncertainty import ResponsePosterior
from validation.example_plants import ResponseRecord, flexible_link, flexible_link_specification

from .plants import RelativeDisc, hub_arm, random_stable, tip_acceleration

_DT = 0.005


class RationalDisc:
    """Discs of radius proportional to |G (1 + j omega/corner)^2|, with an expansion between frequencies."""

    def __init__(self, system: control.StateSpace, integrators: int, relative_std: float, corner: float):
        self.system, self.relative_std, self.corner = system, relative_std, corner
        self.form = RationalResponse.from_state_space(system, integrators)

    def at(self, omega_rad_s: np.ndarray, level: float) -> ResponseRecord:
        centre = frequency_response(self.system, omega_rad_s)
        std = np.abs(centre) * self.relative_std * (1 + (omega_rad_s / self.corner) ** 2)
        return ResponseRecord(omega_rad_s, centre, std[:, None, None] ** 2 * np.eye(2), level)

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        centre = self.form.expand(intervals, cleared)
        x, h = 1 + 1j * intervals.centre / self.corner, intervals.half_width
        squared = FirstOrder(x**2, 2j * x / self.corner, (h / self.corner) ** 2, h)
        disc = centre.times(squared).scaled(self.relative_std)
        return centre, stacked([disc, disc.scaled(1j)])


def _controller(a: float, b: float, c: float, d: float, delay: int = 1) -> Controller:
    return Controller([[a]], [[b]], [[c]], [[d]], _DT, computational_delay_samples=delay)


def _arm(relative_std: float = 0.05, integrators: int = 1) -> UncertainPlant:
    system = hub_arm(integrators=integrators)
    return UncertainPlant(
        system, name="arm", uncertainty=RationalDisc(system, integrators, relative_std, 60.0)
    )


def _sampled(controller: Controller, plant: UncertainPlant, spec: Specification, n: int) -> dict[str, float]:
    """Largest values on n log-spaced frequencies plus sinh-spaced ones around the modes, in pieces."""
    omega = np.geomspace(1e-5, plant.nyquist_rad_s, n)
    largest: dict[str, float] = {}
    for piece in np.array_split(omega, max(1, n // 20000)):
        found = worst_case(lambda w: controller.response(w, with_delay=False), plant, spec, piece, rounds=0)
        for kind in found.names:
            largest[kind] = max(largest.get(kind, 0.0), found.peak(kind)[0])
    return largest


@pytest.mark.parametrize("scenario", [pytest.param("A", marks=pytest.mark.long), "C"])
def test_link_is_bounded_for_all_frequencies_within_half_a_percent(scenario):
    plant, spec = flexible_link(scenario), flexible_link_specification(1)
    controller = Controller(
        [[0.99999]], [[0.002]], [[1.0]], [[0.25]], plant.dt_s, computational_delay_samples=0
    )
    certificate = certify(controller, [plant], spec)
    proof = certificate.plants[0].all_frequencies
    assert proof.proved, proof.obstacle
    # 200 times the first partition of about 500 intervals
    sampled = _sampled(controller, plant, spec, 100_000)
    for kind in ("tracking", "modulus", "effort"):
        dense = certificate.plants[0].worst_weighted if kind == "tracking" else sampled[kind]
        assert sampled[kind] <= proof.bounds[kind]
        assert proof.bounds[kind] <= 1.005 * dense
    assert certificate.gamma_bound == proof.gamma <= 1.005 * certificate.gamma
    assert proof.half_turns == 0.0
    assert 0 < proof.distance <= certificate.plants[0].worst_margins.modulus


@pytest.mark.parametrize("integrators", [1, 2])
def test_integrating_loops_are_bounded_down_to_zero_frequency(integrators):
    plant = _arm(integrators=integrators)
    if integrators == 1:  # PI: two integrators in the loop
        controller = _controller(1.0, 0.001, 1.0, 0.3)
        spec = Specification(bandwidth_rad_s=0.5, integrator=True, effort_limit=4.0, modulus_margin=0.4)
    else:  # lead
        controller = _controller(0.8, 1.0, -0.2 * 0.19, 0.2)
        spec = Specification(bandwidth_rad_s=0.3, effort_limit=4.0, modulus_margin=0.3)
    certificate = certify(controller, [plant], spec)
    proof = certificate.plants[0].all_frequencies
    assert proof.proved, proof.obstacle
    assert proof.half_turns == 1.0
    sampled = _sampled(controller, plant, spec, 60_000)
    for kind in ("tracking", "modulus", "effort"):
        assert sampled[kind] <= proof.bounds[kind] <= 1.005 * sampled[kind]


@pytest.mark.parametrize("separate", [False, True])
def test_damping_of_the_mode_is_bounded_for_both_channels(separate):
    tip = tip_acceleration()
    performance = PlantChannel(tip, RationalDisc(tip, 0, 0.03, 60.0)) if separate else None
    system = hub_arm()
    plant = UncertainPlant(
        system, name="arm", uncertainty=RationalDisc(system, 1, 0.05, 60.0), performance=performance
    )
    spec = Specification(modulus_margin=0.4, mode_peak_ratio=0.5)
    controller = _controller(0.0, 0.0, 0.0, 1.0)
    certificate = certify(controller, [plant], spec)
    proof = certificate.plants[0].all_frequencies
    (item,) = [i for i in certificate.items if i.requirement.startswith("damping")]
    assert proof.proved
    (asked,) = [each for each in spec.weighted(plant) if each.name == "mode damping"]
    low, high = asked.band
    found = worst_case(
        lambda w: controller.response(w, with_delay=False),
        plant,
        spec,
        np.linspace(low, high, 40_001),
        rounds=0,
    ).peak("mode damping")[0]
    assert found <= item.bound <= 1.005 * item.achieved


def _random_posterior(rng: np.random.Generator, unstable: Poles) -> ResponsePosterior:
    mode = np.exp(_DT * 15 * rng.uniform(0.3, 4) * (-rng.uniform(0.005, 0.1) + 1j))
    poles = Poles(np.array([rng.uniform(0.9, 0.999)]), np.array([mode, mode])).appended(unstable)
    size = poles.order + 5 + unstable.order
    root = rng.standard_normal((size, size)) * rng.uniform(0.01, 0.1)
    mean = np.r_[0.3 * rng.standard_normal(size - unstable.order), np.zeros(unstable.order)]
    return ResponsePosterior(poles, mean, root, _DT, fir_length=5, unstable=unstable)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "unstable", [Poles(), Poles([1 / 1.03]), Poles([1 / 1.2], [0.95 + 0.1j])], ids=["stable", "one", "three"]
)
def test_posterior_loops_never_exceed_their_bounds(seed, unstable):
    rng = np.random.default_rng(seed)
    posterior = _random_posterior(rng, unstable)
    system = random_stable(rng, 2, _DT)  # poles of the loop for the count: any stable system will do
    plant = UncertainPlant(system, name="posterior", uncertainty=posterior)
    raw = Controller([[0.9]], [[1.0]], [[rng.standard_normal()]], [[3 * rng.standard_normal()]], _DT)
    omega = np.geomspace(1e-2, plant.nyquist_rad_s, 3000)
    # Largest loop gain of any member below 1: stable, and the worst case anywhere from far to near -1.
    size = rng.uniform(0.3, 0.8) / np.max(np.abs(raw.response(omega)) * plant.at(omega).farthest())
    controller = Controller(raw.A, raw.B, size * raw.C, size * raw.D, _DT)
    spec = Specification(modulus_margin=0.2, effort_limit=10.0, bandwidth_rad_s=None)
    proof = certify(controller, [plant], spec, n_dense=1500).plants[0].all_frequencies
    assert proof.proved, proof.obstacle
    sampled = _sampled(controller, plant, spec, 40_000)
    for kind in ("modulus", "effort"):
        assert sampled[kind] <= proof.bounds[kind] <= 1.005 * sampled[kind]


def test_a_resonance_the_grid_does_not_know_is_found_by_the_bounds():
    """A mode of relative width 1e-7 in the uncertainty alone lies between all grid points and reaches -1."""

    class Needle(RationalDisc):
        def at(self, omega_rad_s: np.ndarray, level: float) -> ResponseRecord:
            record = super().at(omega_rad_s, level)
            _, needle = self._needle(FrequencyIntervals(omega_rad_s, np.zeros(omega_rad_s.size), _DT))
            size = np.abs(needle.value) ** 2
            return ResponseRecord(
                omega_rad_s, record.centre, record.covariance + size[:, None, None] * np.eye(2), level
            )

        def _needle(self, intervals: FrequencyIntervals) -> tuple[FirstOrder, FirstOrder]:
            pole = np.exp(_DT * 33.3333333 * (-1e-7 + 1j))
            form = RationalResponse(2e-5 * _DT, np.zeros(0, complex), np.array([pole - 1]), 0, _DT)
            return form.expand(intervals, 0), form.expand(intervals, 0)

        def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
            centre, disc = super().first_order(intervals, cleared)
            needle = intervals.cleared(cleared).times(self._needle(intervals)[0])
            columns = [
                FirstOrder(disc.value[:, i], disc.slope[:, i], disc.remainder, disc.half_width)
                for i in range(2)
            ]
            return centre, stacked([*columns, needle, needle.scaled(1j)])

    system = hub_arm()
    plant = UncertainPlant(system, name="arm", uncertainty=Needle(system, 1, 0.02, 60.0))
    controller = _controller(0.0, 0.0, 0.0, 0.3)
    certificate = certify(controller, [plant], Specification(modulus_margin=0.3))
    assert certificate.plants[0].worst_margins.modulus > 0.3
    assert certificate.plants[0].stable
    proof = certificate.plants[0].all_frequencies
    assert proof.possible
    assert not proof.proved
    assert proof.obstacle is Obstacle.NO_DISTANCE
    assert proof.obstacle_at == pytest.approx(33.3333, abs=1e-3)
    assert not certificate.certified


def test_what_cannot_be_bounded_says_so_and_stands_on_the_grid():
    system = hub_arm()
    spec = Specification(modulus_margin=0.3)
    controller = _controller(0.0, 0.0, 0.0, 0.3)
    unknown = UncertainPlant(system, name="unknown", uncertainty=RelativeDisc(system, 0.02, 60.0))
    own = np.geomspace(0.5, 200.0, 400)
    measured = UncertainPlant(system, name="frf", uncertainty=RelativeDisc(system, 0.02, 60.0).at(own, 0.95))
    certificate = certify(controller, [unknown, measured], spec, between_own_points="nothing")
    assert certificate.certified
    assert certificate.gamma_bound is None
    assert [v.all_frequencies.possible for v in certificate.plants] == [False, False]
    found = [v.all_frequencies.obstacle for v in certificate.plants]
    assert found == [Obstacle.NO_DERIVATIVES, Obstacle.OWN_FREQUENCIES]
    assumed = certify(controller, [measured], spec, between_own_points="linear")
    proof = assumed.plants[0].all_frequencies
    assert proof.proved, proof.obstacle
    assert assumed.plants[0].assumed_linear
    assert assumed.gamma * (1 - 1e-12) <= proof.gamma


@pytest.mark.parametrize(("of_centre", "of_generators"), [(1.0, 0.9), (np.nan, 1.0), (1.0, np.nan)])
def test_an_expansion_that_is_not_that_of_the_ellipses_is_refused(of_centre, of_generators):
    class Wrong(RationalDisc):
        def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
            centre, generators = super().first_order(intervals, cleared)
            return centre.scaled(of_centre), generators.scaled(of_generators)

    system = hub_arm()
    plant = UncertainPlant(system, name="wrong", uncertainty=Wrong(system, 1, 0.02, 60.0))
    certificate = certify(_controller(0.0, 0.0, 0.0, 0.3), [plant], Specification(modulus_margin=0.3))
    proof = certificate.plants[0].all_frequencies
    assert not proof.possible
    assert proof.obstacle is Obstacle.INEXACT
    assert not proof.obstacle_at <= 1e-3


def test_exact_plants_are_bounded_and_unstable_loops_are_refuted():
    system = hub_arm()
    plant, spec = UncertainPlant(system, name="exact"), Specification(modulus_margin=0.3)
    certificate = certify(_controller(0.0, 0.0, 0.0, 0.3), [plant], spec)
    assert certificate.plants[0].all_frequencies.proved
    sensitivity = control.feedback(1, control.series(system, control.ss(0, 1, 0.3, 0, _DT)))
    omega = np.geomspace(1e-3, np.pi / _DT, 200_000)
    peak = np.max(np.abs(frequency_response(control.ss(sensitivity), omega)))
    bound = 1 / certificate.plants[0].all_frequencies.distance
    assert peak <= bound <= 1.01 * peak
    unstable = certify(_controller(0.0, 0.0, 0.0, 50.0), [plant], spec)
    assert not unstable.plants[0].all_frequencies.proved
    assert not unstable.certified


def test_a_weight_that_grows_without_limit_towards_zero_is_not_met():
    """Integrator asked of a loop whose controller has none: fine on a grid from 1e-4 on, infinite at 0."""
    plant = _arm()
    spec = Specification(bandwidth_rad_s=0.1, integrator=True, modulus_margin=0.3)
    certificate = certify(_controller(0.0, 0.0, 0.0, 0.3), [plant], spec)
    proof = certificate.plants[0].all_frequencies
    assert proof.proved
    assert proof.bounds["tracking"] == np.inf
    assert certificate.gamma_bound == np.inf
    assert not certificate.certified
