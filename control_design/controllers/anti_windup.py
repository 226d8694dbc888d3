"""The anti-windup gain of a controller with limits, the same for every choice of its states.

A limited controller runs as x+ = A x + B e + M (u - w), w = C x + D e, with u the limited command. Seen from
outside, M is one transfer function, V(z) = (I + C (zI - A)^-1 M)^-1, and

    w = V K e + (I - V) u.

V has the poles of K as its zeros and the eigenvalues of A - M C as its poles. M = 0 is V = I: the command is
clipped and the states wind up. V = D K^-1 is the conditioned technique of Hanus, Kinnaert and Henrotte
(1987). Every M is one of the designs of Kothare, Campo, Morari and Nett (1994), "A unified framework for the
study of anti-windup designs", Automatica 30(12), with H2 = I. docs/theory/control.md has the mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.controllers.law import in_sections
from control_design.plants.ellipses import Complex, Real

# Frequencies at which V is looked at, on a logarithmic scale: 40 a decade, several across a mode of damping
# ratio .1.
_LOG_POINTS = 200
# Share of the Nyquist frequency at which they begin: 0.03 rad/s at 1 kHz, below the band of any loop.
_LOWEST_SHARE = 1e-5
# Midpoints on a linear scale for the mean of log |V|, which sets a bound only; twice as many move it by 1 %.
_LINEAR_POINTS = 400
# Largest |V| on the circle. The limited command enters the wanted one by I - V, so at most threefold. With 1
# nothing but clipping is left; a large value corrects within a sample, on noise, too. Chosen between the two.
_LARGEST_V = 2.0
# Ratio of two reference gains tried first: V changes little within a decade.
_SCAN_FACTOR = 10.0
# Halvings of that decade (of its logarithm): the reference gain is then known within a third.
_HALVINGS = 3
# Distance from z = 1 below which a pole counts as an integrator in the test of V: 0.1 rad/s at 1 kHz, a
# decade below loops of machines. Chosen.
_SLOW = 1e-4
# Of |V|, by which Re V may fall below zero: an integrator makes both zero at z = 1, and next to it rounding
# of a companion form decides the sign. 0.06 deg of phase beyond 90 deg.
_ROUNDING = 1e-3
# Distance from z = -1 below which a pole (of a derivative by the trapezoidal rule) has no place in s: its
# value there would be more than a million times that of the others.
_AT_MINUS_ONE = 1e-6
# Rounds of scaling rows and columns in turn; each at least halves what is left of their differences: to 1e-6.
_BALANCING_ROUNDS = 20


@dataclass(frozen=True)
class SectionedLaw:
    """The controller in sections (real Schur form), commands and errors in units in which gains compare.

    A (n, n) triangular but for pairs; B (n, Y); C (U, n); D (U, Y); states: T (n, n), whose columns are these
    states in the controller's own; command_unit (U,), units of the controller's commands per one of these.
    Built by `of`; nothing is checked.
    """

    A: Real
    B: Real
    C: Real
    D: Real
    states: Real
    command_unit: Real

    @classmethod
    def of(cls, A: Real, B: Real, C: Real, D: Real) -> SectionedLaw:
        """The law with rows and columns of K scaled to one size (Sinkhorn), so that its singular values do
        not depend on the units of commands and errors either.

        A (n, n), B (n, Y), C (U, n), D (U, Y) in the controller's own states and units, finite: `Controller`
        has checked them. LinAlgError for an eigenvalue of A on a frequency of `logarithmic_circle`.
        """
        sections, states, back = in_sections(A)
        plain = cls(sections, back @ B, C @ states, D, states, np.ones(D.shape[0]))
        size = np.median(np.abs(plain.response(logarithmic_circle())), axis=0)
        # An entry of K that vanishes counts as 1e-12 of the largest, far below any that matters: no row or
        # column of zeros to divide by.
        size = np.maximum(size, 1e-12 * (np.max(size) or 1.0))
        command = np.ones(size.shape[0])
        error = np.ones(size.shape[1])
        for _ in range(_BALANCING_ROUNDS):
            command = np.mean(size * error, axis=1)
            error = 1.0 / np.mean(size / command[:, None], axis=0)
        return cls(
            sections,
            plain.B * error,
            plain.C / command[:, None],
            D * error / command[:, None],
            states,
            command,
        )

    def response(self, z: Complex) -> Complex:
        """K(z), (F, U, Y), at z (F,) in these units; LinAlgError at an eigenvalue of A."""
        return self.C @ self._from_states(self.B, z) + self.D

    def correction(self, gain: Real, z: Complex) -> Complex:
        """V(z) = (I + C (zI - A)^-1 M)^-1, (F, U, U), at z (F,) of a gain (n, U) in these states and units.

        LinAlgError, or inf for one command, at an eigenvalue of A - M C.
        """
        commands = self.C.shape[0]
        if commands == 1:  # a ratio of two polynomials: tens of times faster by their roots
            zeros = np.linalg.eigvals(self.A)
            poles = np.linalg.eigvals(self.A - gain @ self.C)
            return np.asarray(np.prod((z[:, None] - zeros) / (z[:, None] - poles), axis=1))[:, None, None]
        return np.asarray(np.linalg.inv(np.eye(commands) + self.C @ self._from_states(gain, z)))

    def _from_states(self, entering: Real, z: Complex) -> Complex:
        """(zI - A)^-1 times a matrix (n, m) that enters the states, (F, n, m), at z (F,); LinAlgError at an
        eigenvalue of A."""
        shifted = z[:, None, None] * np.eye(self.A.shape[0]) - self.A
        return np.asarray(np.linalg.solve(shifted, np.broadcast_to(entering, (z.size, *entering.shape))))

    def radius(self, gain: Real) -> float:
        """Largest |eigenvalue| of A - M C, M: gain (n, U) in these states, finite; 0 without states."""
        return float(np.max(np.abs(np.linalg.eigvals(self.A - gain @ self.C)), initial=0.0))


def logarithmic_circle() -> Complex:
    """Points z = e^{j omega dt}, (F,), from `_LOWEST_SHARE` to .999 of the Nyquist frequency, where the
    trapezoidal rule puts zeros and poles."""
    return np.asarray(np.exp(1j * np.pi * np.geomspace(_LOWEST_SHARE, 0.999, _LOG_POINTS)))


def anti_windup_gain(A: Real, B: Real, C: Real, D: Real, *, slower: float = 1.0) -> Real:
    """Gain M of a limited controller whose limited part does not hunt, whatever its states are.

    Parameters
    ----------
    A, B, C, D : arrays (n, n), (n, Y), (U, n), (U, Y)
        The controller, in any states, finite (not checked); rows of C and D: the commands that have limits.
    slower : float
        Factor on the reference gain k0 of the notes: above 1 the states follow the limit more slowly. Where
        it has no solution the gain of factor 1 stands.

    Returns
    -------
    M : (n, U) array
        A similarity transform T of the states gives T M, and units of errors or commands scale it.

    Raises
    ------
    ValueError
        If a mode on or outside the unit circle cannot be corrected: no command shows it, or no error
        moves it.

    Notes
    -----
    V is the stable spectral factor, V(infinity) = I, of

        V V* = c (I + K K* / k0^2)^-1,

    for one command |V| = sqrt(c) / sqrt(1 + |K|^2 / k0^2): at frequencies where the controller's gain is
    above k0 its states follow the limited command, elsewhere the command is only clipped. M is the gain of a
    Kalman filter with state noise B, output noise D and measurement noise k0. k0 is the smallest gain with

    - V + V* >= 0 on the unit circle. The inner loop w -> u -> w is then stable for every saturation between
      0 and 1, also for the difference of two of its trajectories (circle criterion), so a constant error
      cannot make it hunt. A controller with several integrators cannot meet this; all but one of them are
      left out of the test, with as many of the slowest eigenvalues of A - M C;
    - |V| <= 2 on the circle. The mean of log |V| over the circle is 0 (Jensen), so c follows from k0.

    If none passes, the one whose V comes nearest. Neglected: the plant; `limited_loop` checks the loop.
    """
    n = A.shape[0]
    if n == 0:
        return np.zeros((0, C.shape[0]))
    law = SectionedLaw.of(A, B, C, D)
    z = logarithmic_circle()
    highest = float(np.max(np.linalg.norm(law.response(z), ord=2, axis=(-2, -1))))
    slow_poles = int(np.sum(np.abs(np.linalg.eigvals(law.A) - 1.0) < _SLOW))
    extra_integrators = max(slow_poles - 1, 0) if C.shape[0] == 1 else 0

    def violation(gain: Real) -> float:
        """How far V + V* is below zero, relative to |V|, for a gain (n, U) in the law's states; at most
        `_ROUNDING` where V is positive real."""
        correction = law.correction(gain, z)
        if extra_integrators:
            closed = np.linalg.eigvals(law.A - gain @ law.C)
            slowest = closed[np.argsort(np.abs(closed - 1.0))][:extra_integrators]
            with np.errstate(divide="ignore"):
                radii = np.exp(-np.abs(np.log(slowest)))  # of a pair as of two real ones equally fast
            left_out = np.prod((z[:, None] - radii) / (z[:, None] - 1.0), axis=1)
            correction = correction * left_out[:, None, None]
        hermitian = 0.5 * (correction + np.conj(np.swapaxes(correction, -2, -1)))
        smallest = np.linalg.eigvalsh(hermitian)[:, 0]
        return float(np.max(-smallest / np.linalg.norm(correction, ord=2, axis=(-2, -1))))

    # From the largest reference gain (a slow integrator alone is corrected) down to where V fails.
    lowest = min(_least_reference(law), highest)
    steps = int(np.ceil(np.log(max(highest / lowest, 1.0)) / np.log(_SCAN_FACTOR))) + 1 if highest > 0 else 0
    trials: list[tuple[float, float, Real]] = []  # violation, reference gain, gain
    passed: tuple[float, Real] | None = None
    failed = 0.0
    for reference in np.geomspace(highest, lowest, steps) if steps else ():
        gain = _spectral_gain(law, float(reference))
        if gain is None:
            continue
        short = violation(gain)
        trials.append((short, float(reference), gain))
        if short <= _ROUNDING:
            passed = (float(reference), gain)
        elif passed is not None:
            failed = float(reference)
            break
    if passed is not None and failed:
        for _ in range(_HALVINGS):
            middle = float(np.sqrt(passed[0] * failed))
            gain = _spectral_gain(law, middle)
            if gain is not None and violation(gain) <= _ROUNDING:
                passed = (middle, gain)
            else:
                failed = middle
    if passed is None and trials:
        _, reference, gain = min(trials, key=lambda trial: trial[0])
        passed = (reference, gain)
    if passed is not None and slower != 1.0:
        slowed = _spectral_gain(law, slower * passed[0])
        passed = passed if slowed is None else (slower * passed[0], slowed)

    if passed is None:
        # Without a mode that winds up for ever, clipping alone is safe.
        if law.radius(np.zeros((n, C.shape[0]))) < 1.0:
            return np.zeros((n, C.shape[0]))
        raise ValueError(
            "no anti-windup gain found for the limits: the controller has a marginal mode that its output "
            "does not show or its error does not move, or too many poles close together for its state space; "
            "give it in sections, or anti_windup_gain"
        )
    return np.asarray(law.states @ passed[1] / law.command_unit, dtype=np.float64)


def _least_reference(law: SectionedLaw) -> float:
    """Reference gain k0 at which |V| reaches `_LARGEST_V` on the circle.

    Positive, in the law's units; 1 where K vanishes. The mean of log det V V* is 0 there, so with
    V V* = c (I + K K*/k0^2)^-1 and U commands U log c is the mean of log det(I + K K*/k0^2).
    """
    angles = np.pi * (np.arange(_LINEAR_POINTS) + 0.5) / _LINEAR_POINTS
    gains = np.linalg.svd(law.response(np.exp(1j * angles)), compute_uv=False)
    largest = float(np.max(gains))
    if largest == 0.0:
        return 1.0
    # Logarithms of k0. At e^-40 of the largest gain |V| is large for certain, at e^5 of it V is 1 but for
    # 2e-5; known within 1 %, as it only ends a search in factors of ten.
    below = np.log(largest) - 40.0
    above = np.log(largest) + 5.0
    while above - below > 0.01:
        middle = 0.5 * (below + above)
        mean = float(np.mean(np.sum(np.log1p((gains / np.exp(middle)) ** 2), axis=1))) / law.C.shape[0]
        if mean > 2.0 * np.log(_LARGEST_V):
            below = middle
        else:
            above = middle
    return float(np.exp(above))


def _spectral_gain(law: SectionedLaw, reference: float) -> Real | None:
    """M (n, U) in the law's sections whose V has V V* = c (I + K K*/k0^2)^-1 with k0 the reference gain; None
    where the Riccati equation has no stabilising solution.

    Solved in the plane s = (z - 1)/((z + 1) scale), in which slow poles of a fast controller lie apart; in z
    where a pole lies at z = -1. None also where rounding spoils it. reference: positive, in the law's units.
    """
    from scipy.linalg import solve_continuous_are, solve_discrete_are

    n = law.A.shape[0]
    commands = law.C.shape[0]
    identity = np.eye(n)
    poles = np.linalg.eigvals(law.A)
    try:
        if np.min(np.abs(poles + 1.0)) < _AT_MINUS_ONE:
            b = law.B / reference
            d = law.D / reference
            output_noise = np.eye(commands) + d @ d.T
            covariance = solve_discrete_are(law.A.T, law.C.T, b @ b.T, output_noise, s=b @ d.T)
            seen = law.C @ covariance @ law.C.T + output_noise
            predicted = law.C @ covariance @ law.A.T + d @ b.T
            discrete: Real = np.asarray(np.linalg.solve(seen, predicted).T, dtype=np.float64)
            return discrete if law.radius(discrete) < 1.0 else None
        inverse = np.linalg.inv(law.A + identity)
        a = inverse @ (law.A - identity)
        speeds = np.abs(np.linalg.eigvals(a))
        scale = float(np.exp(np.mean(np.log(np.clip(speeds, _LOWEST_SHARE, 1.0)))))
        a = a / scale
        b = np.sqrt(2.0 / scale) * inverse @ law.B / reference
        c = np.sqrt(2.0 / scale) * law.C @ inverse
        d = (law.D - law.C @ inverse @ law.B) / reference
        output_noise = np.eye(commands) + d @ d.T
        covariance = solve_continuous_are(a.T, c.T, b @ b.T, output_noise, s=b @ d.T)
        kalman = np.linalg.solve(output_noise, c @ covariance + d @ b.T).T
        # V^-1 = I + c (s - a)^-1 kalman, sampled again; its value at z = infinity becomes I.
        sampled = np.linalg.inv(identity - scale * a)
        entering = np.sqrt(2.0 * scale) * sampled @ kalman
        direct = np.eye(commands) + scale * c @ sampled @ kalman
        gain = entering @ np.linalg.inv(direct)
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.all(np.isfinite(gain)) or not law.radius(gain) < 1.0:
        return None
    return np.asarray(gain)


def anti_windup_radius(A: Real, C: Real, gain: Real) -> float:
    """Largest |eigenvalue| of A - M C for A (n, n), C (U, n) and gain M (n, U); 0 without states.

    Infinite where A - M C is not finite. Shapes have to fit (numpy's ValueError).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.all(np.isfinite(A - gain @ C)):
            return float("inf")
    # In companion form poles that are close together leave little of A - M C but rounding.
    sections, states, back = in_sections(A)
    with np.errstate(over="ignore", invalid="ignore"):
        closed = sections - (back @ gain) @ (C @ states)
    if not np.all(np.isfinite(closed)):
        return float("inf")
    return float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
