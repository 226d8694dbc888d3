"""Worst case over the ellipses on a dense grid, refined around its maxima. Exact at every grid frequency."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import (
    Complex,
    Ellipses,
    Real,
    distance_to_minus_one,
    largest_disturbance_gain,
)
from control_design.plants.frequency_grid import local_maxima
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification

KINDS = ("tracking", "modulus", "effort", "mode damping")


@dataclass(frozen=True, eq=False)
class PlantData:
    """One plant on one grid with everything that does not depend on the controller; all arrays (F,).

    delay = e^{-j omega (dt samples)}; w1, modulus, w3, w4 the weight magnitudes (w1 without the modulus
    margin); gp_max the largest |Gp| of an independent performance channel where w4 > 0, or None if Gp = G.
    """

    plant: UncertainPlant
    ellipses: Ellipses
    delay: Complex
    w1: Real
    modulus: Real
    w3: Real
    w4: Real
    gp_max: Real | None

    @classmethod
    def build(cls, plant: UncertainPlant, specification: Specification, omega_rad_s: Real) -> PlantData:
        """Evaluate plant and weights at omega (F,)."""
        dt = plant.dt_s
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        samples = specification.computational_delay_samples
        w4 = specification.damping_magnitude(omega, plant)
        gp_max: Real | None = None
        if plant.performance is not None:
            gp_max = np.zeros(omega.size)
            use = w4 > 0
            if np.any(use):
                gp_max[use] = plant.performance.at(omega[use]).farthest()
        total = specification.sensitivity_magnitude(omega, dt, plant.n_integrators)
        return cls(
            plant=plant,
            ellipses=plant.at(omega),
            delay=np.exp(-1j * omega * dt * samples),
            w1=np.where(total > specification.modulus_margin, total, 0.0),
            modulus=np.full(omega.size, specification.modulus_margin),
            w3=specification.effort_magnitude(omega, dt),
            w4=w4,
            gp_max=gp_max,
        )

    def weighted(self, k: Complex) -> dict[str, Real]:
        """Worst case over the ellipses of each weighted closed-loop function for controller values k (F,)
        without delay.

        Keys `KINDS` plus "distance" = dist(-1, K E); inf where a member of the ellipse puts the loop on -1.
        """
        loop = k * self.delay
        distance = distance_to_minus_one(loop, self.ellipses)
        safe = np.maximum(distance, 1e-300)
        with np.errstate(over="ignore"):
            inverse = np.where(distance > 0, 1.0 / safe, np.inf)
            # An infinite weight (integrator asked of the loop) at an infinite loop gain never occurs: the
            # grid starts above 0.
            values = {
                "tracking": _product(self.w1, inverse),
                "modulus": _product(self.modulus, inverse),
                "effort": _product(self.w3 * np.abs(k), inverse),
            }
        damping = np.zeros(loop.size)
        use = self.w4 > 0
        if np.any(use):
            if self.gp_max is not None:
                damping[use] = _product((self.w4 * self.gp_max)[use], inverse[use])
            else:
                damping[use] = self.w4[use] * largest_disturbance_gain(loop[use], self.ellipses.subset(use))
        values["mode damping"] = damping
        values["distance"] = distance
        return values


def _product(weight: Real, inverse: Real) -> Real:
    """weight * inverse with 0 * inf = 0: no requirement there."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(weight > 0, weight * inverse, 0.0), dtype=np.float64)


def worst_of(values: dict[str, Real]) -> Real:
    """Largest weighted value per frequency, (F,)."""
    return np.asarray(np.max([values[kind] for kind in KINDS], axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """Weighted worst cases on an adaptively refined grid: omega (F,), values as `PlantData.weighted`, k
    (F,)."""

    omega_rad_s: Real
    ellipses: Ellipses
    loop_factor: Complex
    values: dict[str, Real]

    def peak(self, kind: str) -> tuple[float, float]:
        """(largest value, its frequency) of one kind."""
        index = int(np.argmax(self.values[kind]))
        return float(self.values[kind][index]), float(self.omega_rad_s[index])


def worst_case(
    response: Callable[[Real], Complex],
    plant: UncertainPlant,
    specification: Specification,
    start: Real,
    *,
    rounds: int = 3,
    peaks: int = 8,
    inserted: int = 9,
) -> WorstCase:
    """Evaluate on `start` (F,) and refine around the largest local maxima of every kind.

    response: controller without delay. Each round puts `inserted` points between the neighbours of the
    `peaks` largest local maxima (ten times finer); plants known on their own grid only are not refined.
    """
    data = PlantData.build(plant, specification, start)
    omega = np.asarray(start, dtype=np.float64)
    values = data.weighted(response(omega))
    ellipses, loop = data.ellipses, response(omega) * data.delay
    if plant.own_grid is not None:
        rounds = 0
    for _ in range(rounds):
        wanted: list[Real] = []
        for kind in KINDS:
            if not np.any(values[kind] > 0):
                continue
            for index in local_maxima(values[kind])[:peaks]:
                low, high = omega[max(index - 1, 0)], omega[min(index + 1, omega.size - 1)]
                wanted.append(np.linspace(low, high, inserted + 2)[1:-1])
        extra = np.setdiff1d(np.concatenate(wanted), omega) if wanted else np.zeros(0)
        if extra.size == 0:
            break
        more = PlantData.build(plant, specification, extra)
        k = response(extra)
        added = more.weighted(k)
        order = np.argsort(np.concatenate([omega, extra]), kind="stable")
        merged = np.concatenate([omega, extra])[order]
        keep = np.concatenate([[True], np.diff(merged) > 0])
        order = order[keep]
        values = {key: np.concatenate([values[key], added[key]])[order] for key in values}
        loop = np.concatenate([loop, k * more.delay])[order]
        ellipses = Ellipses(
            merged[keep],
            *(
                np.concatenate([getattr(ellipses, name), getattr(more.ellipses, name)])[order]
                for name in ("centre", "semi_major", "semi_minor", "direction")
            ),
        )
        omega = merged[keep]
    return WorstCase(omega, ellipses, loop, values)
