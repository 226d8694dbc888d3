"""Gain, phase and delay margins of one loop and over ellipses of the loop gain.

A crossing is a member x of the ellipse K E on the negative real axis (gain) or on the unit circle (phase,
delay). Between the points of the grid crossings are sought where a quantity is smallest and, of one loop,
where it changes sign; at zero frequency (without integrators) and at Nyquist the loop is real, and its gain
limit may lie there without any change of sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from control_design.plants.ellipses import Complex, Ellipses, Real
from control_design.plants.frequency_grid import around_maxima, joined

_TOUCHES = 1e-9  # relative distance from the real axis or the unit circle that counts as a crossing without
# a change of sign: the finest the search between the points resolves
# Rounds of the search between grid points. Nine new points between the two neighbours of a minimum leave it
# two neighbours a fifth as far apart: after four rounds, a 625th.
_ROUNDS = 4
# Minima that are searched, the smallest: more of them than a loop of any order here has near -1.
_MINIMA = 16
_ROUNDED = 1e-6  # relative; what the search may miss of a smallest value, taken off the margins of ellipses


@dataclass(frozen=True)
class Margins:
    """Margins of a loop; infinity where there is no crossing.

    gain_up: factor the gain may rise (> 1). gain_down: factor it may fall to (< 1; 0 = no lower limit).
    phase_rad: smallest rotation to -1 either way. delay_s: smallest extra delay to -1. modulus: smallest
    distance from -1.
    """

    gain_up: float
    gain_down: float
    phase_rad: float
    delay_s: float
    modulus: float

    def worse(self, other: Margins) -> Margins:
        """The smaller of each."""
        return Margins(
            min(self.gain_up, other.gain_up),
            max(self.gain_down, other.gain_down),
            min(self.phase_rad, other.phase_rad),
            min(self.delay_s, other.delay_s),
            min(self.modulus, other.modulus),
        )


def crossing_margins(x: Complex, omega_rad_s: Real, modulus: float) -> Margins:
    """Margins of loop values x already on a crossing: real negative ones count for gain, those of size 1 for
    phase."""
    real = np.real(x[np.abs(np.imag(x)) <= 1e-7 * np.abs(x)])
    inside = -real[(real < 0) & (real > -1)]
    beyond = -real[real < -1]
    unit = np.abs(np.abs(x) - 1.0) <= 1e-6
    either, delay = _turns(x[unit], omega_rad_s[unit])
    return Margins(
        gain_up=float(1 / np.max(inside)) if inside.size else np.inf,
        gain_down=float(1 / np.min(beyond)) if beyond.size else 0.0,
        phase_rad=float(np.min(either)) if either.size else np.inf,
        delay_s=float(np.min(delay)) if delay.size else np.inf,
        modulus=modulus,
    )


def _turns(x: Complex, omega_rad_s: Real) -> tuple[Real, Real]:
    """Smallest rotation to -1 either way, and extra delay to it, of loop values on the unit circle."""
    angle = np.mod(np.angle(-x), 2 * np.pi)
    return np.minimum(angle, 2 * np.pi - angle), angle / omega_rad_s


def nominal_margins(
    loop_gain: Callable[[Real], Complex],
    omega_rad_s: Real,
    *,
    refinable: bool = True,
    at_zero: float | None = None,
) -> Margins:
    """Margins of one loop on a grid (F,) that ends at Nyquist, and between its points.

    at_zero: the loop gain at zero frequency, None where it integrates (no finite gain moves a pole through
    z = 1 then). If refinable the crossings are found to rounding; else they are interpolated.
    """
    found, modulus = _crossings(loop_gain, omega_rad_s, refinable, loop_gain(omega_rad_s))
    last = loop_gain(omega_rad_s[-1:])[0]
    if last.real < 0 and abs(last.imag) <= 1e-9 * abs(last):
        found.append((float(omega_rad_s[-1]), complex(last.real, 0.0)))
    if at_zero is not None:
        modulus = min(modulus, abs(1.0 + at_zero))
        found.append((0.0, complex(at_zero, 0.0)))
    ends = [x for omega, x in found if omega == 0.0 and x.real < 0 and abs(x) != 1.0]
    places = np.array([omega for omega, _ in found if omega > 0.0])
    inner = crossing_margins(np.array([x for omega, x in found if omega > 0.0], complex), places, modulus)
    return inner.worse(
        Margins(
            min((-1 / x.real for x in ends if x.real > -1), default=np.inf),
            max((-1 / x.real for x in ends if x.real < -1), default=0.0),
            np.inf,
            np.inf,
            np.inf,
        )
    )


def _off_axis(value: Complex) -> Real:
    """Relative distance from the real axis."""
    return np.abs(np.imag(value)) / np.maximum(np.abs(value), 1e-300)


def _crossings(
    loop_gain: Callable[[Real], Complex], omega_rad_s: Real, refinable: bool, value: Complex
) -> tuple[list[tuple[float, complex]], float]:
    """(frequency, value) of the crossings of one loop, value (F,) on a grid, between the ends of the grid;
    its least |1 + L|."""
    omega = omega_rad_s
    if refinable:

        def sizes(x: Complex) -> tuple[Real, ...]:
            return x.real, x.imag, _off_axis(x), np.abs(np.log(np.maximum(np.abs(x), 1e-300))), np.abs(1 + x)

        omega, parts = _refined(lambda w: sizes(loop_gain(w)), omega, sizes(value), (2, 3, 4))
        value = parts[0] + 1j * parts[1]

    def refine(function: Callable[[complex], float], k: int) -> tuple[float, complex]:
        low, high = float(omega[k]), float(omega[k + 1])
        if refinable:

            def at(w: float) -> complex:
                return complex(loop_gain(np.array([w]))[0])

            ends = function(at(low)), function(at(high))
            if not ends[0] * ends[1] < 0:  # a sign that rounding makes: one of the ends is the crossing
                return low, complex(value[k])
            place = float(brentq(lambda w: function(at(w)), low, high, xtol=1e-13 * high, rtol=1e-14))
            return place, at(place)
        a, b = function(complex(value[k])), function(complex(value[k + 1]))
        share = a / (a - b)
        return low + share * (high - low), complex(value[k] + share * (value[k + 1] - value[k]))

    imag, size = np.imag(value), np.abs(value) - 1.0
    turns = np.flatnonzero(np.sign(imag[:-1]) * np.sign(imag[1:]) < 0)
    turns = turns[np.minimum(value.real[turns], value.real[turns + 1]) < 0]
    on_axis = [refine(lambda v: v.imag, int(k)) for k in turns]
    on_axis += [(float(omega[k]), value[k]) for k in np.flatnonzero(_off_axis(value)[1:-1] <= _TOUCHES) + 1]
    on_circle = [refine(lambda v: abs(v) - 1.0, int(k)) for k in np.flatnonzero(size[:-1] * size[1:] < 0)]
    on_circle += [(float(omega[k]), value[k]) for k in np.flatnonzero(np.abs(size[1:-1]) <= _TOUCHES) + 1]
    found = [(place, complex(x.real, 0.0)) for place, x in on_axis]
    found += [(place, complex(x / abs(x))) for place, x in on_circle]
    return found, float(np.min(np.abs(1 + value)))


def ellipse_margins(
    loop_gain: Complex,
    ellipses: Ellipses,
    distance: Real,
    *,
    between: Callable[[Real], tuple[Complex, Ellipses]] | None = None,
    at_zero: bool = False,
) -> Margins:
    """Smallest margins over all members of K E; distance (F,) is dist(-1, K E) at the grid's frequencies.

    loop_gain (F,): what multiplies the member. between: the same and the ellipses at other frequencies, with
    which the smallest values are sought between the points and rounded to the safe side by `_ROUNDED`; None
    where nothing is known there. at_zero: the members are finite at zero frequency, which `between` (or the
    first point) then answers for.
    """
    modulus = float(np.min(distance))
    if modulus <= 0:
        return Margins(1.0, 1.0, 0.0, 0.0, 0.0)
    grid = ellipses.omega_rad_s
    if between is None:
        values = _members(loop_gain, ellipses)
    else:
        centre = _centre(loop_gain, ellipses)
        crossings, _ = _crossings(lambda w: _centre(*between(w)), grid, True, centre)
        crossed = np.setdiff1d([w for w, _ in crossings], grid)
        values = _members(loop_gain, ellipses)
        if crossed.size:
            grid, values = joined(grid, values, crossed, _members(*between(crossed)))
        grid, values = _refined(lambda w: _members(*between(w)), grid, values, (0, 1, 2, 3, 4, 5))
    up, down, phase, delay = (float(np.min(value)) for value in values[:4])
    ends = [(loop_gain[-1:], ellipses.subset(np.array([-1])))]
    if at_zero and between is not None:
        ends.append(between(np.zeros(1)))
    for factor, members in ends:
        # Where the loop is real the ellipse lies along the axis, and its imaginary part is rounding.
        centre, major, minor = _axes(factor, members)
        if members.omega_rad_s[0] > 0 and abs(centre[0].imag) > 1e-6 * abs(centre[0]):
            continue  # no Nyquist frequency: the own grid ends before it
        reach = np.hypot(major.real, minor.real)
        low, high = float(centre.real[0] - reach[0]), float(centre.real[0] + reach[0])
        up = min(up, -1 / low) if -1 < low < 0 else up
        down = min(down, -high) if high < -1 else down
        modulus = min(modulus, max(low + 1.0, -1.0 - high, 0.0))
    if modulus <= 0:
        return Margins(1.0, 1.0, 0.0, 0.0, 0.0)
    less = 1.0 if between is None else 1.0 - _ROUNDED
    return Margins(
        max(1.0, up * less), min(1.0, 1 / (down * less)) if np.isfinite(down) else 0.0, phase * less,
        delay * less, modulus,
    )  # fmt: skip


def _axes(factor: Complex, ellipses: Ellipses) -> tuple[Complex, Complex, Complex]:
    """Centre, major and minor semi-axis of K E, complex (F,)."""
    turned = factor * ellipses.direction
    return factor * ellipses.centre, turned * ellipses.semi_major, 1j * turned * ellipses.semi_minor


def _centre(factor: Complex, ellipses: Ellipses) -> Complex:
    return np.asarray(factor * ellipses.centre, dtype=np.complex128)


def _members(factor: Complex, ellipses: Ellipses) -> tuple[Real, ...]:
    """Per frequency (F,), inf where no member crosses: smallest 1/|x| of real members between -1 and 0 and
    |x| of those beyond -1, smallest rotation and delay to -1 on the unit circle; and by how much the ellipse
    misses the real axis and the unit circle."""
    centre, major, minor = _axes(factor, ellipses)
    up, down = _real_axis(centre, major, minor)
    rotation, delay = _unit_circle(centre, major, minor, ellipses.omega_rad_s)
    size = np.maximum(np.abs(centre), 1e-300)
    off_axis = np.maximum(np.abs(centre.imag) - np.hypot(major.imag, minor.imag), 0.0) / size
    # At least so far from the circle; exact enough to know where to look.
    off_circle = np.maximum(np.abs(size - 1.0) - np.abs(major), 0.0) / np.maximum(size, 1.0)
    return up, down, rotation, delay, off_axis, off_circle


def _real_axis(centre: Complex, major: Complex, minor: Complex) -> tuple[Real, Real]:
    """Of the segment each ellipse cuts out of the real axis: 1/|x| at its end between -1 and 0, |x| at the
    end beyond -1 (-1 itself lies outside), (F,) each."""
    p, q = major.imag, minor.imag
    reach = np.hypot(p, q)
    up, down = np.full(centre.size, np.inf), np.full(centre.size, np.inf)
    hit = np.flatnonzero((np.abs(centre.imag) <= reach) & (reach > 0))
    c, p, q, reach = centre[hit], p[hit], q[hit], reach[hit]
    # Im = c.imag + reach cos(f - f0) = 0
    spread = np.arccos(np.clip(-c.imag / reach, -1.0, 1.0))
    middle = np.arctan2(q, p)
    ends = [
        c.real + major.real[hit] * np.cos(f) + minor.real[hit] * np.sin(f)
        for f in (middle + spread, middle - spread)
    ]
    low, high = np.minimum(*ends), np.maximum(*ends)
    inside, beyond = (low < 0) & (low > -1), high < -1
    up[hit[inside]], down[hit[beyond]] = -1 / low[inside], -high[beyond]
    return up, down


def _unit_circle(centre: Complex, major: Complex, minor: Complex, omega: Real) -> tuple[Real, Real]:
    """Smallest rotation and delay to -1, (F,) each, from points of each ellipse's boundary on the unit
    circle: roots w = e^{jf} of |c + a w + b/w|^2 = 1 (quartic)."""
    reach = np.abs(major)
    rotation, delay = np.full(centre.size, np.inf), np.full(centre.size, np.inf)
    hit = np.flatnonzero((np.abs(np.abs(centre) - 1.0) <= reach) & (reach > 1e-12) & (omega > 0))
    if not hit.size:
        return rotation, delay
    c = centre[hit]
    a, b = (major[hit] - 1j * minor[hit]) / 2, (major[hit] + 1j * minor[hit]) / 2
    second = a * np.conj(b)
    first = a * np.conj(c) + c * np.conj(b)
    zeroth = np.abs(c) ** 2 + np.abs(a) ** 2 + np.abs(b) ** 2 - 1.0 + 0j
    # Circles (b = 0) have no second-order term; a tiny one keeps the companion form and sends two roots away.
    second = np.where(np.abs(second) < 1e-14 * np.abs(first), 1e-14 * np.abs(first) + 1e-300, second)
    companion = np.zeros((c.size, 4, 4), dtype=np.complex128)
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    for row, coefficient in enumerate([np.conj(second), np.conj(first), zeroth, first]):
        companion[:, row, 3] = -coefficient / second
    w = np.linalg.eigvals(companion)
    on = np.abs(np.abs(w) - 1.0) < 1e-5  # a tangent crossing is a double root: half the digits
    w = np.where(on, w / np.maximum(np.abs(w), 1e-300), 1.0)
    x = c[:, None] + a[:, None] * w + b[:, None] / w
    good = on & (np.abs(np.abs(x) - 1.0) < 1e-5)
    either, late = _turns(np.where(good, x, 1.0), omega[hit][:, None])
    rotation[hit] = np.min(np.where(good, either, np.inf), axis=1)
    delay[hit] = np.min(np.where(good, late, np.inf), axis=1)
    return rotation, delay


def _refined(
    evaluate: Callable[[Real], tuple[Real, ...]],
    omega: Real,
    values: tuple[Real, ...],
    sought: tuple[int, ...],
) -> tuple[Real, tuple[Real, ...]]:
    """Grid and values with more points between the neighbours of the smallest local minima of the values
    sought."""
    for _ in range(_ROUNDS):
        new = around_maxima(omega, [-values[which] for which in sought], _MINIMA)
        if not new.size:
            break
        omega, values = joined(omega, values, new, evaluate(new))
    return omega, values
