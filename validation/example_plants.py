"""A flexible link with uncertainty ellipses: published comparison plant for synthesis methods, no data
needed.

200 Hz; poles at z = 0.9999 and -4 rad/s, one mode at 15 rad/s with 1.5 % damping, zeros at +10.8 (non-minimum
phase) and -11.5 rad/s. The covariance is the first-order propagation of parameter spreads plus a part that
grows with frequency, so the ellipses are strongly elongated around the mode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import control
import numpy as np

from control_design.plants.ellipses import Complex, Real
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import UncertainPlant
from control_design.plants.set_expansion import stacked
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification

Scenario = Literal["A", "B", "C"]

# Sampling period.
_DT_S = 0.005
# Nominal value, and relative standard deviation in scenario A.
_PARAMETERS = {
    "gain": (1.0, 0.03),
    "slow_pole": (0.02, 0.15),
    "pole": (4.0, 0.05),
    "mode": (15.0, 0.006),
    "zeta": (0.015, 0.10),
    "zero_right": (10.8, 0.04),
    "zero_left": (11.5, 0.05),
}
# Nominal value of each parameter.
_NOMINAL = {name: nominal for name, (nominal, _) in _PARAMETERS.items()}
# Relative standard deviations of scenario A.
_SPREAD_A = {name: spread for name, (_, spread) in _PARAMETERS.items()}
# Relative standard deviations of each scenario.
_SPREAD: dict[Scenario, dict[str, float]] = {
    "A": _SPREAD_A,
    "B": _SPREAD_A | {"gain": 0.15, "mode": 0.015},
    "C": _SPREAD_A | {"gain": 0.25},
}
# Share of the response by which a disc widens it, in each scenario.
_ISOTROPIC: dict[Scenario, float] = {"A": 0.01, "B": 0.002, "C": 0.002}


class ResponseRecord(NamedTuple):
    """Plain uncertain response on given frequencies: (F,), (F,), (F, 2, 2), level."""

    omega_rad_s: Real
    centre: Complex
    covariance: Real
    level: float


@dataclass(frozen=True)
class LinkUncertainty:
    """Ellipses of the link at any frequency, for scenario A, B or C."""

    scenario: Scenario

    def at(self, omega_rad_s: Real, level: float) -> ResponseRecord:
        """Centre and covariance at omega (F,) [rad/s]."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        centre = _response(omega, _NOMINAL)
        covariance = np.zeros((omega.size, 2, 2))
        for key, spread in _SPREAD[self.scenario].items():
            step = 1e-5  # central difference: truncation 1e-10, rounding 1e-11, far below the covariance
            up = _response(omega, _NOMINAL | {key: _NOMINAL[key] * (1 + step)})
            down = _response(omega, _NOMINAL | {key: _NOMINAL[key] * (1 - step)})
            slope = (up - down) / (2 * step) * spread
            row = np.stack([slope.real, slope.imag], axis=-1)
            covariance += row[:, :, None] * row[:, None, :]
        isotropic = np.abs(centre) * _ISOTROPIC[self.scenario] * np.sqrt(1 + (omega / 20) ** 4)
        covariance += isotropic[:, None, None] ** 2 * np.eye(2)
        return ResponseRecord(omega, centre, covariance, level)

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        """Centre (F,) and generators (F, 9) of the covariance of `at`, for bounds between frequencies.

        dG/dtheta = G (gain'/gain + sum p'/(z - p) - sum q'/(z - q)) with the roots' derivatives by the same
        central differences as in `at`; the isotropic part is a disc, so its radius may carry a phase: G c (1
        + j (omega/20)^2) and j times it.
        """
        poles, zeros, gain = _roots_and_gain(_NOMINAL)
        inverse = {complex(root): intervals.pole(complex(root - 1)) for root in (*poles, *zeros[:2])}
        centre = RationalResponse(gain, zeros - 1, poles - 1, 0, _DT_S).expand(intervals, cleared)
        columns = []
        for key, spread in _SPREAD[self.scenario].items():
            step = 1e-5
            up = _roots_and_gain(_NOMINAL | {key: _NOMINAL[key] * (1 + step)})
            down = _roots_and_gain(_NOMINAL | {key: _NOMINAL[key] * (1 - step)})
            factor = spread / (2 * step)
            slope = intervals.constant((up[2] - down[2]) * factor / gain)
            moved = ((up[0] - down[0], poles, factor), (up[1] - down[1], zeros, -factor))
            for changes, roots, signed in moved:
                for change, root in zip(changes, roots, strict=True):
                    if change != 0:
                        slope = slope + inverse[complex(root)].scaled(complex(signed * change))
            columns.append(centre.times(slope))
        omega = intervals.centre
        h = intervals.half_width
        ones = np.ones(omega.size, dtype=np.complex128)
        growth = FirstOrder(ones + 1j * (omega / 20) ** 2, ones * (2j * omega / 400), (h / 20) ** 2, h)
        disc = centre.times(growth).scaled(_ISOTROPIC[self.scenario])
        return centre, stacked([*columns, disc, disc.scaled(1j)])

    def draw(self, rng: np.random.Generator, draws: int) -> Callable[[Real], Complex]:
        """Posterior samples: the seven parameters normal with their spreads (drawn again while not positive),
        put into the formula of G, plus the isotropic part.

        The isotropic part is |G_nominal| c sqrt(1 + (omega/20)^4) n(omega) with n complex of unit variance in
        each part: independent at knots a third of a decade apart, in between cos(a) n_k + sin(a) n_{k+1}.
        """
        parameters = [
            {key: _positive(rng, _NOMINAL[key], spread) for key, spread in _SPREAD[self.scenario].items()}
            for _ in range(draws)
        ]
        systems = [_roots_and_gain(drawn) for drawn in parameters]
        poles = np.array([system[0] for system in systems])
        zeros = np.array([system[1] for system in systems])
        gain = np.array([system[2] for system in systems])
        knots = np.arange(-15, 10) / 3.0
        noise = rng.standard_normal((draws, knots.size)) + 1j * rng.standard_normal((draws, knots.size))

        def at(omega: Real) -> Complex:
            z = np.exp(1j * omega * _DT_S)
            value = np.broadcast_to(gain[:, None], (draws, omega.size)).astype(np.complex128)
            for k in range(poles.shape[1]):
                value = value / (z - poles[:, k, None])
            for k in range(zeros.shape[1]):
                value = value * (z - zeros[:, k, None])
            place = np.clip(np.log10(np.maximum(omega, 1e-300)), knots[0], knots[-1] - 1e-9)
            left = np.searchsorted(knots, place, side="right") - 1
            angle = 0.5 * np.pi * (place - knots[left]) * 3.0
            n = np.cos(angle) * noise[:, left] + np.sin(angle) * noise[:, left + 1]
            size = np.abs(_response(omega, _NOMINAL)) * np.sqrt(1 + (omega / 20) ** 4)
            return np.asarray(value + _ISOTROPIC[self.scenario] * size * n, dtype=np.complex128)

        return at


def _positive(rng: np.random.Generator, nominal: float, spread: float) -> float:
    while True:
        value = nominal * (1 + spread * float(rng.standard_normal()))
        if value > 0:
            return value


def _roots_and_gain(p: Mapping[str, float]) -> tuple[Complex, Complex, float]:
    """Poles (4,), zeros (3,) in z and the gain of the sampled link with these parameters.

    The gain is that of the continuous response at .2 rad/s, far below the mode.
    """
    decay = -p["zeta"] * p["mode"]
    mode = complex(decay, p["mode"] * np.sqrt(1 - p["zeta"] ** 2))
    poles = np.exp(_DT_S * np.array([-p["slow_pole"], -p["pole"], mode, mode.conjugate()]))
    zeros = np.append(np.exp(_DT_S * np.array([p["zero_right"], -p["zero_left"]], dtype=complex)), -1.0)
    s = 0.2j
    wanted = (
        p["gain"]
        * (1 - s / p["zero_right"])
        * (1 + s / p["zero_left"])
        / (
            (s + p["slow_pole"])
            * (s / p["pole"] + 1)
            * (s**2 / p["mode"] ** 2 + 2 * p["zeta"] * s / p["mode"] + 1)
        )
    )
    z = np.exp(s * _DT_S)
    gain = abs(wanted) / abs(np.prod(z - zeros) / np.prod(z - poles))
    sign = np.sign(np.real(np.prod(1 - zeros) / np.prod(1 - poles)))
    return poles, zeros, float(gain * sign)


def _response(omega: Real, p: Mapping[str, float]) -> Complex:
    poles, zeros, gain = _roots_and_gain(p)
    z = np.exp(1j * omega * _DT_S)
    numerator = gain * np.prod(z[:, None] - zeros, axis=1)
    return np.asarray(numerator / np.prod(z[:, None] - poles, axis=1), dtype=np.complex128)


def flexible_link(scenario: Scenario = "A") -> UncertainPlant:
    """The link of scenario A (as published), B (gain 15 %, mode 1.5 %) or C (gain 25 %), 95 % ellipses."""
    poles, zeros, gain = _roots_and_gain(_NOMINAL)
    # Cascade of small blocks: a slow real part and the mode, never an expanded polynomial of the whole.
    slow = control.tf2ss(
        control.tf(gain * np.real(np.poly([zeros[2], zeros[1]])), np.real(np.poly(poles[:2])), _DT_S)
    )
    fast = control.tf2ss(control.tf(np.real(np.poly([zeros[0]])), np.real(np.poly(poles[2:])), _DT_S))
    nominal = control.series(slow, fast)
    return UncertainPlant(nominal, name=f"flexible link {scenario}", uncertainty=LinkUncertainty(scenario))


def flexible_link_specification(order: int) -> Specification:
    """The published weights W1 = (s/1.7 + 1.6)/(s + 0.0016), W3 = (s/40 + 1)/(6 (s/1500 + 1)), no
    computational delay."""
    return Specification(
        sensitivity_weight=RationalWeight(numerator=(1 / 1.7, 1.6), denominator=(1.0, 0.0016)),
        effort_weight=RationalWeight(numerator=(1 / 40, 1.0), denominator=(6 / 1500, 6.0)),
        controller_order=order,
        computational_delay_samples=0,
    )
