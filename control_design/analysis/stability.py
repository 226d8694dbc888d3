"""Nominal stability two ways: closed-loop poles of the full state space, and the Nyquist count of the
uncertainty centre."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.multivariable import MultivariablePlant
from control_design.plants.plant_set import Mode, UncertainPlant, count_integrators, delayed, modes_of

_GAINS = 16  # steps of the root locus; halved up to _HALVINGS times where poles come near one another
_HALVINGS = 6  # the smallest step is then a thousandth of the way: 16 * 2^6 = 1024
_NEAR = 1.2  # ratio of frequencies within which a lighter pole of the loop is heard as the mode
_LOST = 0.02  # share of its damping; two digits show no less


class NominalLoop:
    """One nominal plant with the computational delay at its input, ready to be closed many times."""

    def __init__(self, plant: UncertainPlant | MultivariablePlant, delay_samples: int) -> None:
        system = delayed(plant.nominal, delay_samples)
        self._a, self._b, self._c, self._d = (np.asarray(getattr(system, m), dtype=float) for m in "ABCD")

    def poles(self, a: Real, b: Real, c: Real, d: Real) -> Complex:
        """Poles (n,) with the controller a, b, c, d (without delay); one infinite pole for an algebraic
        loop, det(1 + D_K D_G) = 0."""
        n = self._a.shape[0]
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(c))):
            return np.array([np.inf + 0j])
        # u = (1 + D_K D_G)^-1 (c x_k - d C x), e = -(C x + D u)
        u = np.hstack([-d @ self._c, c])
        if np.any(self._d):
            loop = np.eye(d.shape[0]) + d @ self._d
            if not abs(np.linalg.det(loop)) > 1e-12:
                return np.array([np.inf + 0j])
            u = np.linalg.solve(loop, u)
        e = -self._d @ u
        e[:, :n] -= self._c
        closed = np.vstack([self._b @ u, b @ e])
        closed[:n, :n] += self._a
        closed[n:, n:] += a
        if not np.all(np.isfinite(closed)):
            return np.array([np.inf + 0j])
        return np.asarray(np.linalg.eigvals(closed), dtype=np.complex128)


def closed_loop_poles(controller: Controller, plant: UncertainPlant) -> Complex:
    """Poles (n,) of the feedback of plant and controller, delay states included.

    Raises ValueError if the loop is algebraic (1 + D_K D_G = 0) or the sampling times differ.
    """
    if not np.isclose(controller.dt_s, plant.dt_s, rtol=1e-9, atol=0):
        raise ValueError(
            f"controller and plant {plant.name!r} differ in dt_s: {controller.dt_s} and {plant.dt_s}; "
            "sample both with the period of the loop"
        )
    loop = NominalLoop(plant, controller.computational_delay_samples)
    poles = loop.poles(controller.A, controller.B, controller.C, controller.D)
    if not np.all(np.isfinite(poles)):
        raise ValueError(f"plant {plant.name!r}: algebraic loop, 1 + D_K D_G = 0")
    return poles


@dataclass(frozen=True)
class ModeChange:
    """A lightly damped mode of the plant, and what becomes of it in the nominal loop (zeta 1: no swing)."""

    open_loop: Mode
    closed_loop: Mode

    @property
    def loses_damping(self) -> bool:
        """By a share that two digits can show."""
        return self.closed_loop.zeta < (1 - _LOST) * self.open_loop.zeta


def mode_changes(controller: Controller, plant: UncertainPlant) -> tuple[ModeChange, ...]:
    """Every stable mode of the plant in closed loop, ascending in frequency.

    A mode is followed along the root locus, gain of the controller from 0 to 1. Of closed-loop modes that no
    mode of the plant has become and that are within a fifth of its frequency, a lighter one takes its place:
    where poles of plant and controller meet, the lighter branch is what rings. Only the nominal plant.
    """
    modes = [mode for mode in plant.modes if mode.zeta > 0]
    loop = NominalLoop(plant, controller.computational_delay_samples)

    def poles_at(gain: float) -> Complex:
        found = loop.poles(controller.A, controller.B, gain * controller.C, gain * controller.D)
        return found[(found.imag >= 0) & np.isfinite(found)]

    def follow(from_: Complex, low: float, high: float, halvings: int) -> Complex:
        near = poles_at(high)
        away = np.abs(from_[:, None] - near[None])
        own = linear_sum_assignment(away)[1]
        others = away.copy()
        others[np.arange(from_.size), own] = np.inf
        if halvings and np.any(away.min(axis=1) > 0.3 * others.min(axis=1, initial=np.inf)):
            middle = 0.5 * (low + high)
            return follow(follow(from_, low, middle, halvings - 1), middle, high, halvings - 1)
        return near[own]

    s = [mode.omega_rad_s * (-mode.zeta + 1j * np.sqrt(1 - mode.zeta**2)) for mode in modes]
    followed = np.exp(np.array(s, dtype=np.complex128) * plant.dt_s)
    gains = np.linspace(0.0, 1.0, _GAINS + 1)
    if modes:
        for low, high in pairwise(gains.tolist()):
            followed = follow(followed, low, high, _HALVINGS)
    every = poles_at(1.0)
    rest = modes_of(every[~np.isin(every, followed)], plant.dt_s, zeta_below=1.0)
    changes = []
    for mode, pole in zip(modes, followed, strict=True):
        became = modes_of(np.array([pole]), plant.dt_s, zeta_below=1.0) or (
            Mode(float(abs(np.log(pole)) / plant.dt_s) if pole else np.inf, 1.0),
        )
        near = [m for m in rest if 1 / _NEAR < m.omega_rad_s / mode.omega_rad_s < _NEAR]
        changes.append(ModeChange(mode, min((*became, *near), key=lambda found: found.zeta)))
    return tuple(changes)


@dataclass(frozen=True)
class NyquistCount:
    """Half turns of 1 + L from zero frequency to Nyquist.

    half_turns: phase change / pi, counted anticlockwise. required: unstable poles + integrators/2 for a
    stable loop. largest_step_rad: largest phase step between neighbouring points (below pi/2 the count is
    trustworthy). matches: they agree.
    """

    half_turns: float
    required: float
    largest_step_rad: float
    points: int
    matches: bool


def _steps(value: Complex) -> Real:
    """Phase steps between neighbours on the last axis."""
    return np.asarray(np.angle(value[..., 1:] * np.conj(value[..., :-1])), dtype=np.float64)


def half_turns(value: Complex, integrators: int) -> Real:
    """Phase change / pi (...) of 1 + L (..., F) from near zero frequency to Nyquist.

    The remainders to the limit directions at both ends, known up to half turns, close the count to a multiple
    of 1/2.
    """
    first, last = np.angle(value[..., 0] * 1j**integrators), np.angle(value[..., -1])
    total = np.sum(_steps(value), axis=-1) + (first - np.pi * np.round(first / np.pi))
    total -= last - np.pi * np.round(last / np.pi)
    closed = np.round(total / np.pi, 9) + 0.0  # no minus sign on zero
    return np.asarray(closed, dtype=np.float64)


def winds(loop_gain: Complex, *, integrators: int, unstable_poles: int) -> tuple[Boolean, Boolean]:
    """(1 + L turns as a stable loop's, some phase step is wider than pi/3), each (D,), for L (D, F) from
    near zero frequency to Nyquist; see `nyquist_count`."""
    right = np.abs(half_turns(1.0 + loop_gain, integrators) - (unstable_poles + integrators / 2.0)) < 0.25
    return right, np.max(np.abs(_steps(1.0 + loop_gain)), axis=1) > np.pi / 3


def nyquist_count(
    loop_gain: Callable[[Real], Complex],
    start: Real,
    *,
    integrators: int,
    unstable_poles: int,
    refinable: bool = True,
) -> NyquistCount:
    """Count the half turns of F = 1 + L on the upper half of the circle.

    F has as many zeros as poles (L is proper and F(infinity) is not 0). With the contour indented outside z =
    1 the i integrators lie inside, so a stable loop turns by 2 pi P over the whole contour, P the unstable
    poles of L; by symmetry pi P over the upper half, of which the quarter of the indentation takes -i pi/2.
    Hence arg F(pi/dt) - arg F(0+) = pi P + i pi/2, where arg F(0+) = -i pi/2 (mod pi). With i = 0, 1, 2 and P
    = 0 the phase therefore starts at 0, -pi/2, -pi and ends at 0.

    start (F,): first grid, ascending, ending at Nyquist. If refinable, points are added until every phase
    step is below pi/8 and the lowest frequency is lowered until F is within 0.1 rad of its limit direction
    there.
    """
    omega = np.asarray(start, dtype=np.float64)
    value = 1.0 + loop_gain(omega)
    if refinable:
        for _ in range(8):
            off_axis = np.angle(value[0] * 1j**integrators)
            if abs(np.sin(off_axis)) < 0.1:
                break
            lower = np.geomspace(omega[0] / 10.0, omega[0], 21)[:-1]
            omega = np.concatenate([lower, omega])
            value = np.concatenate([1.0 + loop_gain(lower), value])
        for _ in range(30):
            wide = np.flatnonzero(np.abs(_steps(value)) > np.pi / 8)
            wide = wide[(omega[wide + 1] - omega[wide]) > 1e-12 * omega[wide + 1]]
            if wide.size == 0 or omega.size > 200_000:
                break
            middle = 0.5 * (omega[wide] + omega[wide + 1])
            omega = np.insert(omega, wide + 1, middle)
            value = np.insert(value, wide + 1, 1.0 + loop_gain(middle))
    turns = float(half_turns(value, integrators))
    required = unstable_poles + integrators / 2.0
    largest = float(np.max(np.abs(_steps(value)))) if omega.size > 1 else np.pi
    matches = bool(abs(turns - required) < 0.25 and largest < np.pi / 2 and np.all(np.isfinite(value)))
    return NyquistCount(turns, required, largest, int(omega.size), matches)


def loop_integrators(controller: Controller, plant: UncertainPlant) -> tuple[int, int]:
    """(integrators, unstable poles) of the loop gain L = G K."""
    poles = controller.poles
    own = count_integrators(poles)
    others = poles[np.argsort(np.abs(poles - 1.0), kind="stable")][own:]
    return plant.n_integrators + own, plant.unstable_poles + int(np.sum(np.abs(others) >= 1.0))
