"""Nominal stability two ways: closed-loop poles of the full state space, and a Nyquist count.

`NominalLoop` closes one plant with any controller and gives the poles; `closed_loop_poles` does it once, with
checks. `mode_changes` follows the plant's lightly damped modes along the root locus into the closed loop.
`nyquist_count` counts the half turns of 1 + L from zero frequency to Nyquist, of a response alone: it decides
about centres of ellipses and posterior samples, whose poles nobody computes. `loop_integrators` says how many
half turns a stable loop makes. Assumed of a count: the grid shows every turn; it is refined where that can be
done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.multivariable import MultivariablePlant
from control_design.plants.plant_set import Mode, UncertainPlant, count_integrators, delayed, modes_of

# Determinant of 1 + D_K D_G below which a loop is algebraic, and one that is closed has no defined command.
# Far above rounding of the 1, far below any loop that somebody would close.
_SMALLEST_DETERMINANT = 1e-12
# Relative difference of two sampling times that counts as none: rounding of decimal numbers.
_SAME_PERIOD = 1e-9

# Steps of the root locus, gain 0 to 1. From 4 to 32 no test moves.
_GAINS = 16
# Times that a step is halved at most where poles come near one another: the smallest one is a thousandth of
# the way, 16 * 2^6 = 1024. From 0 to 10 no test moves.
_HALVINGS = 6
# A pole may be followed if it moved by less than this share of its distance to the next candidate. Chosen.
_CLEARLY_NEAREST = 0.3
# Ratio of frequencies within which a lighter pole of the loop is heard as the mode. Chosen; with 1.05 or 1.5
# no test moves.
_NEAR = 1.2
# Share of its damping ratio that a mode loses before that is told: two digits show no less.
_LOST = 0.02

# Tolerance of a count of half turns, which comes in steps of 1/2: half of such a step.
_HALF_OF_A_STEP = 0.25
# Widest phase step, rad, between neighbours of a draw that is not counted again on a finer grid. Chosen,
# below the pi/2 that is believed.
_WIDE_STEP_RAD = np.pi / 3
# Widest phase step of a count that is believed: below it no turn by pi hides between two points that turn one
# way and back.
_WIDEST_STEP_RAD = np.pi / 2
# A refined count adds points until every phase step is below this: a quarter of what is believed.
_FINE_STEP_RAD = np.pi / 8
# Sine of the angle between 1 + L at the lowest frequency and its limit direction at which the grid begins low
# enough. Chosen: the remainder of 0.1 rad is then far from a half turn, and is added to the count.
_NEAR_LIMIT_DIRECTION = 0.1

# Decades by which it is lowered at most: from 1e-4 to 1e-12 rad/s at 200 Hz, below which all is rounding.
_MOST_DECADES = 8

# Points in each of these decades, where the response is a power of frequency and turns slowly. Chosen.
_POINTS_PER_DECADE = 20
# Rounds in which wide steps are halved: a limit of work for a loop that passes through -1. Thirty halvings
# make a step 1e9 times narrower.
_MOST_ROUNDS = 30

# Most points of a refined count: 3 MB of complex values, of which a few copies are made. Chosen.
_MOST_POINTS = 200_000

# Steps narrower than this share of their frequency are rounding.
_NARROWEST_STEP = 1e-12


class NominalLoop:
    """One nominal plant with the computational delay at its input, ready to be closed many times.

    Parameters
    ----------
    plant : UncertainPlant or MultivariablePlant
        Its `nominal` discrete state space counts.
    delay_samples : int
        Computational delay, not negative (not checked: a negative one counts as none).
    """

    def __init__(self, plant: UncertainPlant | MultivariablePlant, delay_samples: int) -> None:
        """Take the matrices of the plant behind its delay: (n, n), (n, U), (Y, n), (Y, U).

        Nothing is checked: the plant has checked its nominal.
        """
        system = delayed(plant.nominal, delay_samples)
        self._a = np.asarray(system.A, dtype=float)
        self._b = np.asarray(system.B, dtype=float)
        self._c = np.asarray(system.C, dtype=float)
        self._d = np.asarray(system.D, dtype=float)

    def poles(self, a: Real, b: Real, c: Real, d: Real) -> Complex:
        """Closed-loop poles in z with a controller u = K e, e = -y: as many as plant and delay (n) and
        controller have states.

        Parameters
        ----------
        a, b, c, d : arrays
            State space of the controller without delay: (m, m), (m, Y), (U, m), (U, Y). Shapes are not
            checked: numpy raises where they do not fit. Nor is the sampling time, which they do not have.

        Returns
        -------
        (N,) complex array
            N the states of plant, delay and controller; one infinite pole for an algebraic loop, det(1 + D_K
            D_G) = 0, and where a matrix is not finite.
        """
        n = self._a.shape[0]
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(c))):
            return np.array([np.inf + 0j])
        # u = (1 + D_K D_G)^-1 (c x_k - d C x), e = -(C x + D u), as rows over the states (x, x_k).
        u = np.hstack([-d @ self._c, c])
        if np.any(self._d):
            loop = np.eye(d.shape[0]) + d @ self._d
            if not abs(np.linalg.det(loop)) > _SMALLEST_DETERMINANT:
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
    """Poles (n,) in z of the feedback of plant and controller, delay states included.

    Raises
    ------
    ValueError
        The loop is algebraic (1 + D_K D_G = 0), or the sampling times differ.
    """
    if not np.isclose(controller.dt_s, plant.dt_s, rtol=_SAME_PERIOD, atol=0):
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
        """Whether the damping ratio falls by a share that two digits can show.

        No error is possible: an unstable closed-loop mode has a negative ratio.
        """
        return self.closed_loop.zeta < (1 - _LOST) * self.open_loop.zeta


def mode_changes(controller: Controller, plant: UncertainPlant) -> tuple[ModeChange, ...]:
    """What becomes of every stable mode of the plant in the nominal closed loop.

    Parameters
    ----------
    controller : Controller
    plant : UncertainPlant
        Its `modes` count, those with 0 < zeta < 0.4 below Nyquist, ascending: undamped frequency, rad/s, and
        damping ratio of each.

    Returns
    -------
    tuple of ModeChange
        Ascending in frequency of the open loop, empty without such modes. `closed_loop` has zeta 1 where the
        pole no longer swings, and then an infinite frequency where it lies at z = 0.

    Raises
    ------
    ValueError, IndexError
        By numpy, where a loop on the way has fewer finite poles than the plant has modes (an algebraic loop
        has none). Sampling times are not compared: `closed_loop_poles` does that.

    Notes
    -----
    A mode is followed along the root locus, gain of the controller from 0 to 1. Of closed-loop modes that no
    mode of the plant has become and that are within a fifth of its frequency, a lighter one takes its place:
    where poles of plant and controller meet, the lighter branch is what rings.
    """
    from scipy.optimize import linear_sum_assignment  # here: it takes its time to load

    modes = [mode for mode in plant.modes if mode.zeta > 0]
    loop = NominalLoop(plant, controller.computational_delay_samples)

    def poles_at(gain: float) -> Complex:
        """Finite poles in z of the upper half plane, with the controller times a gain.

        Empty where the loop is algebraic with that gain.
        """
        poles = loop.poles(controller.A, controller.B, gain * controller.C, gain * controller.D)
        is_upper = poles.imag >= 0
        return poles[is_upper & np.isfinite(poles)]

    def follow(before: Complex, low: float, high: float, halvings: int) -> Complex:
        """Poles (M,) at gain `high` that continue those at gain `low`: the nearest ones, each used once.

        before (M,), in z. Where a pole has not moved clearly less than the way to the next candidate, the
        step is halved, up to `halvings` times. With fewer candidates than poles numpy raises an error.
        """
        candidates = poles_at(high)
        distance = np.abs(before[:, None] - candidates[None])
        chosen = linear_sum_assignment(distance)[1]
        distance_to_next = distance.copy()
        distance_to_next[np.arange(before.size), chosen] = np.inf
        nearest = distance.min(axis=1)
        next_nearest = distance_to_next.min(axis=1, initial=np.inf)
        if halvings and np.any(nearest > _CLEARLY_NEAREST * next_nearest):
            middle = 0.5 * (low + high)
            half_way = follow(before, low, middle, halvings - 1)
            return follow(half_way, middle, high, halvings - 1)
        return candidates[chosen]

    # Poles of the modes in s, then in z, followed from the open to the closed loop.
    poles_s = [mode.omega_rad_s * (-mode.zeta + 1j * np.sqrt(1 - mode.zeta**2)) for mode in modes]
    followed = np.exp(np.array(poles_s, dtype=np.complex128) * plant.dt_s)
    gains = np.linspace(0.0, 1.0, _GAINS + 1)
    if modes:
        for low, high in pairwise(gains.tolist()):
            followed = follow(followed, low, high, _HALVINGS)

    # Modes of the loop that none of the plant's has become.
    closed_loop = poles_at(1.0)
    is_new = ~np.isin(closed_loop, followed)
    new_modes = modes_of(closed_loop[is_new], plant.dt_s, zeta_below=1.0)
    changes = []
    for mode, pole in zip(modes, followed, strict=True):
        candidates = list(modes_of(np.array([pole]), plant.dt_s, zeta_below=1.0))
        if not candidates:
            # A real pole swings no more; one at z = 0 is gone after a sample.
            omega = float(abs(np.log(pole)) / plant.dt_s) if pole else np.inf
            candidates = [Mode(omega, 1.0)]
        for new_mode in new_modes:
            if 1 / _NEAR < new_mode.omega_rad_s / mode.omega_rad_s < _NEAR:
                candidates.append(new_mode)
        changes.append(ModeChange(mode, min(candidates, key=lambda candidate: candidate.zeta)))
    return tuple(changes)


@dataclass(frozen=True)
class NyquistCount:
    """Half turns of 1 + L from zero frequency to Nyquist.

    Attributes
    ----------
    half_turns : float
        Phase change / pi, counted anticlockwise.
    required : float
        Half turns of a stable loop: unstable poles + integrators / 2.
    largest_step_rad : float
        Largest phase step between neighbouring points; below pi/2 the count is trustworthy.
    points : int
        Of the grid.
    matches : bool
        The count is trustworthy and the required one.
    """

    half_turns: float
    required: float
    largest_step_rad: float
    points: int
    matches: bool


def _steps(value: Complex) -> Real:
    """Phase steps (..., F - 1), rad, between neighbours on the last axis of values (..., F).

    Between -pi and pi; 0 beside a value of 0, nan beside nan. One value has no steps.
    """
    return np.asarray(np.angle(value[..., 1:] * np.conj(value[..., :-1])), dtype=np.float64)


def half_turns(value: Complex, integrators: int) -> Real:
    """Phase change / pi (...) of 1 + L (..., F) from near zero frequency to Nyquist, a multiple of 1/2.

    Parameters
    ----------
    value : (..., F) complex array
        1 + L on an ascending grid that ends at Nyquist.
    integrators : int
        Poles of L at z = 1.

    Notes
    -----
    The limit directions at both ends are known up to half turns: real at Nyquist, that of j^-integrators at
    zero frequency. The remainders to them close the count to a multiple of 1/2, which is rounded to nine
    digits (rounding of the sum). Not checked: a nan gives nan, a value of 0 counts as no turn; F = 0 is an
    IndexError.
    """
    first = np.angle(value[..., 0] * 1j**integrators)
    last = np.angle(value[..., -1])
    first_remainder = first - np.pi * np.round(first / np.pi)
    last_remainder = last - np.pi * np.round(last / np.pi)
    total = np.sum(_steps(value), axis=-1) + first_remainder
    total -= last_remainder
    # Adding 0.0 leaves no minus sign on zero.
    closed = np.round(total / np.pi, 9) + 0.0
    return np.asarray(closed, dtype=np.float64)


def winds(loop_gain: Complex, *, integrators: int, unstable_poles: int) -> tuple[Boolean, Boolean]:
    """Whether 1 + L turns as a stable loop's, and whether some phase step is wider than pi/3, (D,) each.

    Not checked: a draw with nan winds as no stable loop, and has no wide step.

    Parameters
    ----------
    loop_gain : (D, F) complex array
        L of D loops on an ascending grid from near zero frequency to Nyquist.
    integrators, unstable_poles : int
        Of L: poles at z = 1 and outside the circle; see `nyquist_count`.
    """
    required = unstable_poles + integrators / 2.0
    off_count = np.abs(half_turns(1.0 + loop_gain, integrators) - required)
    largest_step = np.max(np.abs(_steps(1.0 + loop_gain)), axis=1)
    return off_count < _HALF_OF_A_STEP, largest_step > _WIDE_STEP_RAD


def nyquist_count(
    loop_gain: Callable[[Real], Complex],
    start: Real,
    *,
    integrators: int,
    unstable_poles: int,
    refinable: bool = True,
) -> NyquistCount:
    """Count the half turns of F = 1 + L on the upper half of the circle.

    Parameters
    ----------
    loop_gain : callable
        L (N,) at frequencies (N,), rad/s.
    start : (F,) array
        First grid, ascending from above 0, ending at Nyquist, rad/s; at least one (IndexError), else not
        checked.
    integrators, unstable_poles : int
        Poles of L at z = 1 and outside the circle.
    refinable : bool
        L is known between the points: they are added until every phase step is below pi/8, and the lowest
        frequency is lowered by decades until F is within 0.1 rad of its limit direction there, or of its
        opposite, since directions are known up to half turns.

    Returns
    -------
    NyquistCount
        `matches` is false where L is not finite somewhere, or a phase step stays as wide as pi/2.

    Notes
    -----
    F has as many zeros as poles (L is proper and F(infinity) is not 0). With the contour indented outside z =
    1 the i integrators lie inside, so a stable loop turns by 2 pi P over the whole contour, P the unstable
    poles of L; by symmetry pi P over the upper half, of which the quarter of the indentation takes -i pi/2.
    Hence arg F(pi/dt) - arg F(0+) = pi P + i pi/2, where arg F(0+) = -i pi/2 (mod pi). With i = 0, 1, 2 and P
    = 0 the phase therefore starts at 0, -pi/2, -pi and ends at 0.
    """
    omega = np.asarray(start, dtype=np.float64)
    value = 1.0 + loop_gain(omega)
    if refinable:
        for _ in range(_MOST_DECADES):
            off_limit_direction = np.angle(value[0] * 1j**integrators)
            if abs(np.sin(off_limit_direction)) < _NEAR_LIMIT_DIRECTION:
                break
            # One decade more.
            lower = np.geomspace(omega[0] / 10.0, omega[0], _POINTS_PER_DECADE + 1)[:-1]
            omega = np.concatenate([lower, omega])
            value = np.concatenate([1.0 + loop_gain(lower), value])
        for _ in range(_MOST_ROUNDS):
            is_wide = np.abs(_steps(value)) > _FINE_STEP_RAD
            can_be_halved = np.diff(omega) > _NARROWEST_STEP * omega[1:]
            wide = np.flatnonzero(is_wide & can_be_halved)
            if wide.size == 0 or omega.size > _MOST_POINTS:
                break
            middle = 0.5 * (omega[wide] + omega[wide + 1])
            omega = np.insert(omega, wide + 1, middle)
            value = np.insert(value, wide + 1, 1.0 + loop_gain(middle))

    turns = float(half_turns(value, integrators))
    required = unstable_poles + integrators / 2.0
    largest_step = np.pi
    if omega.size > 1:
        largest_step = float(np.max(np.abs(_steps(value))))
    is_required = abs(turns - required) < _HALF_OF_A_STEP
    is_trustworthy = largest_step < _WIDEST_STEP_RAD and np.all(np.isfinite(value))
    matches = bool(is_required and is_trustworthy)
    return NyquistCount(turns, required, largest_step, int(omega.size), matches)


def loop_integrators(controller: Controller, plant: UncertainPlant) -> tuple[int, int]:
    """Numbers of integrators and of unstable poles of the loop gain L = G K, nominal plant and controller.

    A pole of the controller on the circle away from z = 1 counts as unstable.

    controller: its `poles` in z, without delay (a delay has poles at z = 0). plant: its `n_integrators` and
    `unstable_poles`. Nothing is checked: both objects have checked themselves.
    """
    poles = controller.poles
    n_controller = count_integrators(poles)
    nearest_one_first = np.argsort(np.abs(poles - 1.0), kind="stable")
    other_poles = poles[nearest_one_first][n_controller:]
    unstable = np.abs(other_poles) >= 1.0
    integrators = plant.n_integrators + n_controller
    return integrators, plant.unstable_poles + int(np.sum(unstable))
