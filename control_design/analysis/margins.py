"""Gain, phase and delay margins of one loop and over ellipses of the loop gain.

A crossing is a loop gain on the negative real axis (gain margin) or on the unit circle (phase and delay
margin): of one loop its value, of an uncertain one any member of the ellipse K E. `nominal_margins` finds the
crossings of one loop by changes of sign on a frequency grid; `ellipse_margins` computes the members on the
axis and on the circle of every ellipse exactly (a segment and a quartic). Between the points of the grid both
add points where a quantity is smallest, since a crossing may be touched without a change of sign. At zero
frequency (without integrators) and at Nyquist the loop is real, and its gain limit may lie there; these ends
are taken by themselves. Neglected: a minimum narrower than the grid shows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from control_design.plants.ellipses import Complex, Ellipses, Real
from control_design.plants.frequency_grid import around_maxima, joined

# Relative distance from the real axis or the unit circle that counts as a crossing without a change of sign:
# the finest that the search between grid points resolves. From 1e-10 to 1e-8 no test moves.
_TOUCHES = 1e-9
# Rounds of the search between grid points. Nine new points between the two neighbours of a minimum leave it
# two neighbours a fifth as far apart: after four rounds, a 625th. With two, touched crossings are missed and
# margins depend on the unit of time (`test_margins`); with eight no test moves.
_ROUNDS = 4
# Minima that are searched, the smallest: more of them than a loop of any order here has near -1. With a
# quarter of them, or twice as many, no test moves.
_MINIMA = 16
# What the search may miss of a smallest value, relative: it is taken off the margins over ellipses, so that
# they err to the safe side. A minimum seen at a 625th of the grid's distance is missed by far less: with
# nothing taken off no test moves.
_MISSED = 1e-6

# Imaginary part, as a share of the modulus, within which a loop value handed to `crossing_margins` lies on
# the real axis. All lie on axis or circle within rounding, so it only tells which. Chosen, far above
# rounding.
_ON_AXIS = 1e-7

# Distance from modulus 1 within which such a value lies on the circle. Chosen likewise.
_ON_CIRCLE = 1e-6
# Imaginary part, as a share of the modulus, up to which one loop is real at Nyquist but for rounding: its
# response has the error of its state space. Chosen, a million roundings of doubles.
_REAL_LOOP = 1e-9

# Such a share for the centre of an ellipse, whose response comes from an uncertainty's own formulas and loses
# more digits. Chosen.
_REAL_CENTRE = 1e-6

# Tolerances of `brentq`, relative to the frequency: a few roundings of doubles.
_FREQUENCY_TOLERANCE = 1e-13

# Relative tolerance of `brentq`, which takes none below 4 roundings of doubles, 9e-16.
_BRENTQ_RELATIVE_TOLERANCE = 1e-14

# Ellipses with a major axis below this (the loop gain has no unit, and is 1 at the circle) have no boundary
# to speak of; their centre's crossings are sought instead. Some thousand roundings of 1.
_LEAST_AXIS = 1e-12
# Second-order coefficient of the quartic, as a share of the first-order one, that a circle gets, whose own is
# zero: rounding size, so that it moves the roots by no more than rounding.
_LEAST_SECOND_ORDER = 1e-14
# Distance from the circle up to which a root of the quartic, and the loop value it gives, lie on it. Where
# the boundary only touches the circle the root is double: half of its digits are right (1e-8), and
# eigenvalues lose some more.
_ROOT_ON_CIRCLE = 1e-5

# Keeps quotients finite where a loop gain is zero.
_TINY = 1e-300


@dataclass(frozen=True)
class Margins:
    """Margins of a loop; infinity where there is no crossing.

    Attributes
    ----------
    gain_up : float
        Factor by which the gain may rise, above 1.
    gain_down : float
        Factor to which the gain may fall, below 1; 0: no lower limit.
    phase_rad : float
        Smallest rotation of the loop gain to -1, either way.
    delay_s : float
        Smallest extra delay that brings the loop gain to -1.
    modulus : float
        Smallest distance of the loop gain from -1.
    """

    gain_up: float
    gain_down: float
    phase_rad: float
    delay_s: float
    modulus: float

    def worse(self, other: Margins) -> Margins:
        """Margins that both loops keep: the smaller of each, of `gain_down` the larger.

        A nan margin of this loop stays, one of `other` does not: callers have no nan here.
        """
        return Margins(
            min(self.gain_up, other.gain_up),
            max(self.gain_down, other.gain_down),
            min(self.phase_rad, other.phase_rad),
            min(self.delay_s, other.delay_s),
            min(self.modulus, other.modulus),
        )


@dataclass(frozen=True)
class GainCrossover:
    """The loop gain on the unit circle.

    Attributes
    ----------
    omega_rad_s : float
        Where, rad/s.
    phase_margin_rad : float
        arg(-L), above -pi and up to pi: so much lag (positive) or lead (negative) brings L to -1.
    delay_margin_s : float
        Extra delay that brings L to -1 there, s: a delay turns one way only, however long that is.
    """

    omega_rad_s: float
    phase_margin_rad: float
    delay_margin_s: float


@dataclass(frozen=True)
class PhaseCrossover:
    """The loop gain on the negative real axis.

    Attributes
    ----------
    omega_rad_s : float
        Where, rad/s; 0 and Nyquist where the loop is real there.
    gain_margin : float
        -1/L: the factor on the gain that brings L to -1; above 1 the gain may rise by it, below 1 fall to it.
    """

    omega_rad_s: float
    gain_margin: float


@dataclass(frozen=True)
class Crossovers:
    """All crossovers of one loop, by frequency: on the unit circle and on the negative real axis."""

    gain: tuple[GainCrossover, ...]
    phase: tuple[PhaseCrossover, ...]


class _Crossing(NamedTuple):
    """Loop gain on the real axis or on the unit circle, and its frequency, rad/s."""

    omega_rad_s: float
    value: complex


def crossing_margins(x: Complex, omega_rad_s: Real, modulus: float) -> Margins:
    """Margins that loop values on crossings leave.

    No value gives infinite margins. Not checked: a value on neither axis nor circle counts for nothing, a
    frequency of 0 gives an infinite delay or nan.

    Parameters
    ----------
    x : (N,) complex array
        Loop gains on the real axis, of which the negative ones count for gain, or on the unit circle.
    omega_rad_s : (N,) array
        Their frequencies, above 0.
    modulus : float
        The modulus margin, which is passed on.

    Returns
    -------
    Margins
    """
    # The gain may rise until the value next to -1 from the right reaches it, and fall likewise from the left.
    size = np.abs(x)
    on_axis = np.abs(np.imag(x)) <= _ON_AXIS * size
    real = np.real(x[on_axis])
    is_beyond = real < -1
    is_between = np.logical_and(real < 0, real > -1)
    gain_up = np.inf
    if np.any(is_between):
        gain_up = float(1 / np.max(-real[is_between]))
    gain_down = 0.0
    if np.any(is_beyond):
        gain_down = float(1 / np.min(-real[is_beyond]))

    on_circle = np.abs(size - 1.0) <= _ON_CIRCLE
    rotation_rad, delay_s = _turns(x[on_circle], omega_rad_s[on_circle])
    return Margins(
        gain_up=gain_up,
        gain_down=gain_down,
        phase_rad=float(np.min(rotation_rad, initial=np.inf)),
        delay_s=float(np.min(delay_s, initial=np.inf)),
        modulus=modulus,
    )


def _turns(x: Complex, omega_rad_s: Real) -> tuple[Real, Real]:
    """Rotation (rad) to -1 either way, and extra delay (s) to it, of loop values x on the unit circle.

    Both have the shape of x. A delay turns clockwise only, however long that way is.

    omega_rad_s broadcasts with x, above 0 (not checked: 0 gives inf or nan).
    """
    clockwise = np.mod(np.angle(-x), 2 * np.pi)
    either_way = np.minimum(clockwise, 2 * np.pi - clockwise)
    return either_way, clockwise / omega_rad_s


def nominal_margins(
    loop_gain: Callable[[Real], Complex],
    omega_rad_s: Real,
    *,
    refinable: bool = True,
    at_zero: float | None = None,
) -> Margins:
    """Margins of one loop on a grid, and between its points.

    Not checked: at least one frequency (IndexError), ascending; that L is finite (nan is no crossing, and the
    modulus is nan then).

    Parameters
    ----------
    loop_gain : callable
        L = G K (N,) at frequencies (N,), rad/s.
    omega_rad_s : (F,) array
        Ascending grid above 0 that ends at Nyquist.
    refinable : bool
        The loop gain is known between the points: crossings are found to rounding. Else they are interpolated
        on straight lines.
    at_zero : float, optional
        Loop gain at zero frequency; None where the loop integrates (no finite gain moves a pole through z = 1
        then).

    Returns
    -------
    Margins
    """
    return nominal_loop(loop_gain, omega_rad_s, refinable=refinable, at_zero=at_zero)[0]


def nominal_loop(
    loop_gain: Callable[[Real], Complex],
    omega_rad_s: Real,
    *,
    refinable: bool = True,
    at_zero: float | None = None,
) -> tuple[Margins, Crossovers]:
    """Margins of one loop, and every crossover that they are the smallest of.

    Parameters
    ----------
    loop_gain, omega_rad_s, refinable, at_zero
        As of `nominal_margins`.

    Returns
    -------
    Margins, Crossovers
        A crossover that is touched stands there once for each point of the grid that touches it.
    """
    crossings, modulus = _crossings(loop_gain, omega_rad_s, refinable, loop_gain(omega_rad_s))
    at_nyquist = loop_gain(omega_rad_s[-1:])[0]
    if at_nyquist.real < 0 and abs(at_nyquist.imag) <= _REAL_LOOP * abs(at_nyquist):
        crossings.append(_Crossing(float(omega_rad_s[-1]), complex(at_nyquist.real, 0.0)))
    values = np.array([crossing.value for crossing in crossings], complex)
    places = np.array([crossing.omega_rad_s for crossing in crossings])
    margins = crossing_margins(values, places, modulus)
    gain_crossovers: list[GainCrossover] = []
    phase_crossovers: list[PhaseCrossover] = []
    for place, value in sorted(crossings, key=lambda crossing: crossing.omega_rad_s):
        # Crossings of the axis are real to the last digit.
        if value.imag == 0.0 and value.real < 0:
            phase_crossovers.append(PhaseCrossover(place, -1.0 / value.real))
        elif value.imag != 0.0:
            _, delay_s = _turns(np.array([value]), np.array([place]))
            gain_crossovers.append(GainCrossover(place, float(np.angle(-value)), float(delay_s[0])))
    if at_zero is not None and at_zero < 0:
        phase_crossovers.insert(0, PhaseCrossover(0.0, -1.0 / at_zero))
    crossovers = Crossovers(tuple(gain_crossovers), tuple(phase_crossovers))
    if at_zero is None:
        return margins, crossovers

    # At zero frequency a negative loop gain limits the gain; no rotation or delay changes it.
    gain_up = np.inf
    gain_down = 0.0
    if -1 < at_zero < 0:
        gain_up = -1 / at_zero
    elif at_zero < -1:
        gain_down = -1 / at_zero
    limits_at_zero = Margins(gain_up, gain_down, np.inf, np.inf, abs(1.0 + at_zero))
    return margins.worse(limits_at_zero), crossovers


class _LoopValues(NamedTuple):
    """One loop at F frequencies: L (F,) complex, and three distances (F,) whose minima are crossings or near.

    off_axis: |Im L| / |L|. off_circle: |log |L||. distance: |1 + L|.
    """

    loop_gain: Complex
    off_axis: Real
    off_circle: Real
    distance: Real

    @classmethod
    def of(cls, loop_gain: Complex) -> _LoopValues:
        """Values of a loop gain (F,).

        A zero counts as 1e-300, so that quotient and logarithm are finite; nan stays nan.
        """
        size = np.maximum(np.abs(loop_gain), _TINY)
        return cls(
            loop_gain=loop_gain,
            off_axis=np.abs(np.imag(loop_gain)) / size,
            off_circle=np.abs(np.log(size)),
            distance=np.abs(1 + loop_gain),
        )


def _crossings(
    loop_gain: Callable[[Real], Complex], omega_rad_s: Real, refinable: bool, value: Complex
) -> tuple[list[_Crossing], float]:
    """Crossings of one loop strictly inside a grid (F,), and its least |1 + L|; value (F,): L on the grid.

    omega_rad_s: rad/s, ascending. refinable: `loop_gain` (N,) may be asked between the points. Fewer than two
    points give no crossing. Nothing is checked.
    """
    from scipy.optimize import brentq  # here: it takes its time to load

    omega = omega_rad_s
    values = _LoopValues.of(value)
    if refinable:
        omega, parts = _refined(lambda new: _LoopValues.of(loop_gain(new)), omega, values, sought=(1, 2, 3))
        values = _LoopValues(*parts)
        value = values.loop_gain

    def between(side: Callable[[complex], float], k: int) -> _Crossing:
        """Crossing between the points k and k + 1 of the grid, at which `side` has different signs.

        side: Im L or |L| - 1, no unit. Not checked: k is the position of a change of sign.
        """
        low = float(omega[k])
        high = float(omega[k + 1])
        if not refinable:
            side_low = side(complex(value[k]))
            side_high = side(complex(value[k + 1]))
            share = side_low / (side_low - side_high)
            step = value[k + 1] - value[k]
            return _Crossing(low + share * (high - low), complex(value[k] + share * step))

        def side_at(place: float) -> float:
            """Side, no unit, of the loop gain at a frequency `place`, rad/s."""
            return side(complex(loop_gain(np.array([place]))[0]))

        if not side_at(low) * side_at(high) < 0:
            # A sign that rounding makes: one of the ends is the crossing.
            return _Crossing(low, complex(value[k]))
        tolerance = _FREQUENCY_TOLERANCE * high
        place = float(brentq(side_at, low, high, xtol=tolerance, rtol=_BRENTQ_RELATIVE_TOLERANCE))
        return _Crossing(place, complex(loop_gain(np.array([place]))[0]))

    # Crossings of the negative real axis: where the imaginary part changes sign, or touches zero.
    sign = np.sign(np.imag(value))
    changes_sign = sign[:-1] * sign[1:] < 0
    is_negative = np.minimum(value.real[:-1], value.real[1:]) < 0
    on_axis: list[_Crossing] = []
    for k in np.flatnonzero(changes_sign & is_negative):
        on_axis.append(between(lambda x: x.imag, int(k)))
    touches_axis = values.off_axis[1:-1] <= _TOUCHES
    for k in np.flatnonzero(touches_axis) + 1:
        on_axis.append(_Crossing(float(omega[k]), value[k]))

    # Crossings of the unit circle, likewise.
    outside = np.abs(value) - 1.0
    crosses_circle = outside[:-1] * outside[1:] < 0
    on_circle: list[_Crossing] = []
    for k in np.flatnonzero(crosses_circle):
        on_circle.append(between(lambda x: abs(x) - 1.0, int(k)))
    touches_circle = np.abs(outside[1:-1]) <= _TOUCHES
    for k in np.flatnonzero(touches_circle) + 1:
        on_circle.append(_Crossing(float(omega[k]), value[k]))

    # What rounding leaves between them and the axis or circle goes.
    crossings: list[_Crossing] = []
    for place, x in on_axis:
        crossings.append(_Crossing(place, complex(x.real, 0.0)))
    for place, x in on_circle:
        crossings.append(_Crossing(place, complex(x / abs(x))))
    return crossings, float(np.min(values.distance))


def ellipse_margins(
    loop_gain: Complex,
    ellipses: Ellipses,
    distance: Real,
    *,
    between: Callable[[Real], tuple[Complex, Ellipses]] | None = None,
    at_zero: bool = False,
) -> Margins:
    """Smallest margins over all members of the ellipses K E.

    Parameters
    ----------
    loop_gain : (F,) complex array
        What multiplies the member: K with its delay.
    ellipses : Ellipses
        E on the grid: `omega_rad_s` (F,), `centre`, semi-axes and direction of each.
    distance : (F,) array
        Distance of -1 from K E on the grid; at least one (numpy: ValueError), finite (not checked).
    between : callable, optional
        Such a factor and the ellipses at other frequencies: the smallest values are then sought between the
        points and rounded to the safe side by `_MISSED`. None where nothing is known there.
    at_zero : bool
        The members are finite at zero frequency, for which `between` (or the first point) then answers.

    Returns
    -------
    Margins
        Without any margin (1, 1, 0, 0, 0) where an ellipse reaches -1.
    """
    no_margin = Margins(1.0, 1.0, 0.0, 0.0, 0.0)
    modulus = float(np.min(distance))
    if modulus <= 0:
        return no_margin
    grid = ellipses.omega_rad_s
    members = _members(loop_gain, ellipses)
    if between is not None:
        # The crossings of the centre join the grid: there the thinnest ellipses have members on a crossing.
        centre_on_grid = _centre(loop_gain, ellipses)
        crossings, _ = _crossings(lambda new: _centre(*between(new)), grid, True, centre_on_grid)
        crossed = np.setdiff1d([crossing.omega_rad_s for crossing in crossings], grid)
        parts: tuple[Any, ...] = members
        if crossed.size:
            grid, parts = joined(grid, parts, crossed, _members(*between(crossed)))
        every_value = tuple(range(len(parts)))
        _, parts = _refined(lambda new: _members(*between(new)), grid, parts, sought=every_value)
        members = _MemberValues(*parts)
    up = float(np.min(members.up))
    down = float(np.min(members.down))
    phase_rad = float(np.min(members.rotation_rad))
    delay_s = float(np.min(members.delay_s))

    # At Nyquist and at zero frequency the loop is real.
    ends = [(loop_gain[-1:], ellipses.subset(np.array([-1])))]
    if at_zero and between is not None:
        ends.append(between(np.zeros(1)))
    for factor, ellipse in ends:
        # The ellipse then lies along the real axis, and its imaginary part is rounding.
        centres, major, minor = _axes(factor, ellipse)
        centre = centres[0]
        is_real = abs(centre.imag) <= _REAL_CENTRE * abs(centre)
        if ellipse.omega_rad_s[0] > 0 and not is_real:
            # No Nyquist frequency: the own grid of the plant ends before it.
            continue
        reach = np.hypot(major.real, minor.real)[0]
        low = float(centre.real - reach)
        high = float(centre.real + reach)
        if -1 < low < 0:
            up = min(up, -1 / low)
        if high < -1:
            down = min(down, -high)
        modulus = min(modulus, max(low + 1.0, -1.0 - high, 0.0))
    if modulus <= 0:
        return no_margin

    safe_share = 1.0 if between is None else 1.0 - _MISSED
    gain_down = 0.0
    if np.isfinite(down):
        gain_down = min(1.0, 1 / (down * safe_share))
    return Margins(
        gain_up=max(1.0, up * safe_share),
        gain_down=gain_down,
        phase_rad=phase_rad * safe_share,
        delay_s=delay_s * safe_share,
        modulus=modulus,
    )


def _axes(factor: Complex, ellipses: Ellipses) -> tuple[Complex, Complex, Complex]:
    """Centre, major and minor semi-axis of K E, complex (F,) each; factor (F,): K.

    ellipses: `centre`, `semi_major`, `semi_minor`, `direction` (F,). Shapes are not checked.
    """
    turned = factor * ellipses.direction
    centre = factor * ellipses.centre
    major = turned * ellipses.semi_major
    minor = 1j * turned * ellipses.semi_minor
    return centre, major, minor


def _centre(factor: Complex, ellipses: Ellipses) -> Complex:
    """Centres of K E, complex (F,); factor (F,): K.

    Shapes are not checked.
    """
    return np.asarray(factor * ellipses.centre, dtype=np.complex128)


class _MemberValues(NamedTuple):
    """Extremes over the members x of each of F ellipses, (F,); inf where no member is on the crossing.

    up: smallest 1/|x| of real members between -1 and 0. down: smallest |x| of real members beyond -1.
    rotation_rad, delay_s: smallest rotation and delay to -1 of members on the unit circle. off_axis,
    off_circle: by how much the ellipse misses the real axis and the unit circle, relative, 0 where it does
    not.
    """

    up: Real
    down: Real
    rotation_rad: Real
    delay_s: Real
    off_axis: Real
    off_circle: Real


def _members(factor: Complex, ellipses: Ellipses) -> _MemberValues:
    """Extremes over the members of every ellipse K E; factor (F,): K.

    ellipses: F of them, with `omega_rad_s`. Nothing is checked.
    """
    centre, major, minor = _axes(factor, ellipses)
    up, down = _real_axis(centre, major, minor)
    rotation_rad, delay_s = _unit_circle(centre, major, minor, ellipses.omega_rad_s)
    size = np.maximum(np.abs(centre), _TINY)
    to_axis = np.abs(centre.imag) - np.hypot(major.imag, minor.imag)
    off_axis = np.maximum(to_axis, 0.0) / size
    # At least so far from the circle; exact enough to know where to look.
    to_circle = np.abs(size - 1.0) - np.abs(major)
    off_circle = np.maximum(to_circle, 0.0) / np.maximum(size, 1.0)
    return _MemberValues(up, down, rotation_rad, delay_s, off_axis, off_circle)


def _real_axis(centre: Complex, major: Complex, minor: Complex) -> tuple[Real, Real]:
    """Ends of the segment that each ellipse cuts out of the real axis, (F,) each; inf where there is none.

    First 1/|x| at its end x between -1 and 0, then |x| at its end beyond -1 (-1 itself lies outside). The
    boundary is centre + major cos(f) + minor sin(f), centre and semi-axes complex (F,); its imaginary part is
    Im(centre) + reach cos(f - f0), zero at two angles f.

    All three are (F,); nan meets no axis. Nothing is checked.
    """
    up = np.full(centre.size, np.inf)
    down = np.full(centre.size, np.inf)
    reach = np.hypot(major.imag, minor.imag)
    meets_axis = np.logical_and(np.abs(centre.imag) <= reach, reach > 0)
    hit = np.flatnonzero(meets_axis)
    centre = centre[hit]
    major = major[hit]
    minor = minor[hit]
    cosine = -centre.imag / reach[hit]
    spread = np.arccos(np.clip(cosine, -1.0, 1.0))
    middle = np.arctan2(minor.imag, major.imag)
    first = middle + spread
    second = middle - spread
    first_end = centre.real + major.real * np.cos(first) + minor.real * np.sin(first)
    second_end = centre.real + major.real * np.cos(second) + minor.real * np.sin(second)
    low = np.minimum(first_end, second_end)
    high = np.maximum(first_end, second_end)
    reaches_between = np.logical_and(low < 0, low > -1)
    lies_beyond = high < -1
    up[hit[reaches_between]] = -1 / low[reaches_between]
    down[hit[lies_beyond]] = -high[lies_beyond]
    return up, down


def _unit_circle(centre: Complex, major: Complex, minor: Complex, omega: Real) -> tuple[Real, Real]:
    """Smallest rotation (rad) and delay (s) to -1 of each ellipse's points on the unit circle, (F,) each.

    Inf where the ellipse's boundary does not meet the circle, and at omega = 0. The boundary is c + a w + b/w
    with w = e^{jf}, a = (major - j minor)/2 and b = (major + j minor)/2. With conj(w) = 1/w the points of
    modulus 1 are roots of the quartic

        a b* w^4 + (a c* + c b*) w^3 + (|a|^2 + |b|^2 + |c|^2 - 1) w^2 + (a c* + c b*)* w + (a b*)* = 0,

    whose roots are the eigenvalues of a companion matrix (4 x 4 for four roots). omega (F,): rad/s. Nan meets
    no circle. Nothing is checked.
    """
    rotation_rad = np.full(centre.size, np.inf)
    delay_s = np.full(centre.size, np.inf)
    reach = np.abs(major)
    near_circle = np.abs(np.abs(centre) - 1.0) <= reach
    has_boundary = reach > _LEAST_AXIS
    has_delay = omega > 0
    hit = np.flatnonzero(near_circle & has_boundary & has_delay)
    if not hit.size:
        return rotation_rad, delay_s
    c = centre[hit]
    a = (major[hit] - 1j * minor[hit]) / 2
    b = (major[hit] + 1j * minor[hit]) / 2
    # Coefficients of w^4, w^3 and w^2, divided by w^2: of second, first and zeroth order.
    second = a * np.conj(b)
    first = a * np.conj(c) + c * np.conj(b)
    squares = np.abs(c) ** 2 + np.abs(a) ** 2 + np.abs(b) ** 2
    zeroth = squares - 1.0 + 0j
    # Circles (b = 0) have no second-order term; a tiny one keeps the companion form and sends two roots away.
    least_second = _LEAST_SECOND_ORDER * np.abs(first)
    second = np.where(np.abs(second) < least_second, least_second + _TINY, second)
    # One 4 x 4 companion matrix for each quartic: ones below the diagonal, coefficients in the last column.
    companion = np.zeros((c.size, 4, 4), dtype=np.complex128)
    for row in range(1, 4):
        companion[:, row, row - 1] = 1.0
    lower_coefficients = [np.conj(second), np.conj(first), zeroth, first]
    for row, coefficient in enumerate(lower_coefficients):
        companion[:, row, 3] = -coefficient / second
    w = np.linalg.eigvals(companion)

    # Roots on the circle are points of the boundary; their loop values are checked once more.
    size = np.abs(w)
    is_angle = np.abs(size - 1.0) < _ROOT_ON_CIRCLE
    w = np.where(is_angle, w / np.maximum(size, _TINY), 1.0)
    x = c[:, None] + a[:, None] * w + b[:, None] / w
    gives_crossing = np.abs(np.abs(x) - 1.0) < _ROOT_ON_CIRCLE
    is_crossing = is_angle & gives_crossing
    # Elsewhere a 1, whose turn is not used.
    safe_x = np.where(is_crossing, x, 1.0)
    rotations, delays = _turns(safe_x, omega[hit][:, None])
    rotation_rad[hit] = np.min(np.where(is_crossing, rotations, np.inf), axis=1)
    delay_s[hit] = np.min(np.where(is_crossing, delays, np.inf), axis=1)
    return rotation_rad, delay_s


def _refined(
    evaluate: Callable[[Real], tuple[Any, ...]],
    omega: Real,
    values: tuple[Any, ...],
    sought: tuple[int, ...],
) -> tuple[Real, tuple[Any, ...]]:
    """Grid and values with more points around the smallest local minima of some of the values.

    evaluate: the values (N,) at new frequencies (N,), rad/s. omega (F,), values (F,) each: the grid, and what
    holds there. sought: positions of the values whose minima count. `_ROUNDS` times, nine points are put
    between the neighbours of each of the `_MINIMA` smallest minima.

    What `evaluate` raises goes up. Nothing is checked; a nan is no minimum.
    """
    for _ in range(_ROUNDS):
        depths = [-values[which] for which in sought]
        new = around_maxima(omega, depths, _MINIMA)
        if not new.size:
            break
        omega, values = joined(omega, values, new, evaluate(new))
    return omega, values
