"""Rows of the synthesis: logarithms of the weighted worst cases, as CasADi states and differentiates them.

A row is log |w F(K, G)| of one requirement at one frequency, with the member G of the ellipse for which it is
largest:

    G = c + cos(a) major + sin(a) minor,   F = G^i K^j / (1 + G K z^-d),   i, j in {0, 1}.

Members are looked for in compiled code (`_worst_members`), on points of each ellipse's boundary, refined by a
parabola and Newton's method: good for a direction, not for a certificate. There the angle a is one more
unknown: a row is the largest psi(x, a), its slope psi_x (envelope theorem), its second derivative psi_xx -
psi_xa psi_xa' / psi_aa, for a long ellipse bends the row although its worst member moves only along it.

`row_functions` builds the CasADi functions of one structure, `_Mapped` calls them at many frequencies at
once, and `LoopRows` puts the rows of all plants and requirements together. In shapes: F frequencies of all
plants, R rows, n parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np

from control_design.controllers.biquads import Cascade, Section, tustin_frequency
from control_design.plants.ellipses import Complex, Ellipses, Integer, Real
from control_design.specification.requirement import LoopFunction
from ident.data.arrays import COMPILED, INSIDE

# Points of a boundary, every 9 degrees; parabola and Newton steps go on from the worst. Chosen: with the two
# refinements below they are enough for the 1e-3 stated there.
_BOUNDARY = 40
# Newton steps from the vertex of the parabola to the worst member. With two, the worst case agrees with the
# exact geometry to 1e-3 or better (tests of the descent).
_REFINEMENTS = 2
# Second derivative of a row along its boundary (by the angle) above minus which it is no maximum, and share
# of the largest multiplier up to which a row does not enter the curvature: rounding, in both.
_NOTHING = 1e-9
# Rows whose curvature is taken in one call: more are not often active, and a row of multiplier 0 that fills
# up a call costs as much as another. Decides time only.
_ROWS_PER_CALL = 8
# No logarithm of zero; far below any value of a row.
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Rows:
    """What is asked of one plant, or of a copy of it with more delay, on its grid.

    Attributes
    ----------
    ellipses : Ellipses
        Frequencies (F,), rad/s, and the plant's ellipses there.
    delay : ndarray, shape (F,)
        z^-d, times a delay copy's own; multiplies K.
    weights : tuple of (LoopFunction, ndarray of shape (F,))
        Magnitude of the weights on functions of the members (S, K S, G S, T); 0: no row. Not negative; no
        shape is checked.
    """

    ellipses: Ellipses
    delay: Complex
    weights: tuple[tuple[LoopFunction, Real], ...]


@lru_cache(maxsize=64)
def row_functions(sections: tuple[Section, ...]) -> tuple[Any, Any, Any]:
    """CasADi functions of one row for controllers of one structure.

    Parameters
    ----------
    sections : tuple of Section
        With a free parameter, else n = 0. Kept for the 64 structures used last, as building takes longer than
        a descent step.

    Returns
    -------
    response : casadi.Function
        Real and imaginary part of K without delay, of parameters x (n,) and p (2,).
    slope : casadi.Function
        Slope (n,) of the row, of x, the angle a of the member, p and plant (10,).
    bend : casadi.Function
        Second derivative (n, n) times a multiplier; the multiplier is the last argument.

    Notes
    -----
    p (2,) states the Tustin frequency as (v, 1) / max(v, 1). plant (10,) holds real and imaginary parts of
    centre, major axis, minor axis and delay, then the powers i of G and j of K in F. The order in which
    expressions are built decides the last digits of every design: keep it.
    """
    import casadi as ca  # here: results, which nobody designs from, load without it

    cascade = Cascade(sections, 1.0, 1.0)
    x = ca.SX.sym("x", cascade.parameters)
    angle = ca.SX.sym("angle")
    multiplier = ca.SX.sym("share")
    # p = jv as far and near: v and 1, both over the larger; 1e16 at Nyquist stays exact.
    p = ca.SX.sym("p", 2)
    plant = ca.SX.sym("plant", 10)
    far = p[0]
    near = p[1]

    # K, section by section: numerator times the conjugate of the denominator, over its square.
    k_re = ca.SX(1.0)
    k_im = ca.SX(0.0)
    for numerator, denominator in cascade.split_with(x, ca.exp):
        n_re, n_im = _polynomial(numerator, far, near)
        d_re, d_im = _polynomial(denominator, far, near)
        square = d_re**2 + d_im**2
        product_re = n_re * d_re + n_im * d_im
        f_re = product_re / square
        product_im = n_im * d_re - n_re * d_im
        f_im = product_im / square
        new_re = k_re * f_re - k_im * f_im
        new_im = k_re * f_im + k_im * f_re
        k_re = new_re
        k_im = new_im

    # psi = i log|G| + j log|K| - log|1 + G K z^-d|.
    centre = plant[0:2]
    major = plant[2:4]
    minor = plant[4:6]
    late = plant[6:8]
    late_re = k_re * late[0] - k_im * late[1]
    late_im = k_re * late[1] + k_im * late[0]
    g = centre + ca.cos(angle) * major + ca.sin(angle) * minor
    back_re = 1 + g[0] * late_re - g[1] * late_im
    back_im = g[0] * late_im + g[1] * late_re
    distance = ca.vertcat(back_re, back_im)
    tiny = np.finfo(np.float64).tiny
    log_g = ca.log(ca.sumsqr(g) + tiny)
    log_k = ca.log(k_re**2 + k_im**2 + tiny)
    log_distance = ca.log(ca.sumsqr(distance) + tiny)
    value = 0.5 * (plant[8] * log_g + plant[9] * log_k - log_distance)

    # psi_xx - psi_xa psi_xa' / psi_aa where the angle is at a maximum, psi_aa < 0; elsewhere psi_xx.
    full = ca.hessian(value, ca.vertcat(x, angle))[0]
    psi_aa = full[-1, -1]
    along = ca.fmin(psi_aa, -_NOTHING)
    across = full[:-1, -1]
    at_maximum = psi_aa < -_NOTHING
    weight = ca.if_else(at_maximum, 1 / along, 0)
    bend = full[:-1, :-1] - weight * across @ across.T
    response = ca.Function("response", [x, p], [k_re, k_im])
    arguments = [x, angle, p, plant]
    dense_slope = ca.densify(ca.gradient(value, x))
    slope = ca.Function("slope", arguments, [dense_slope])
    dense_bend = ca.densify(multiplier * bend)
    return response, slope, ca.Function("bend", [*arguments, multiplier], [dense_bend])


def _polynomial(coefficients: list[Any], far: Any, near: Any) -> tuple[Any, Any]:
    """Real and imaginary part of a section's polynomial in p = j far / near, times near^degree.

    coefficients: one to three numbers or symbols, highest power first; another count is not a section's.
    """
    if len(coefficients) == 1:
        return coefficients[0], 0.0
    *highest, linear, constant = coefficients
    if not highest:
        return constant * near, linear * far
    real_part = constant * near**2 - highest[0] * far**2
    imaginary_part = linear * near * far
    return real_part, imaginary_part


class _Mapped:
    """A CasADi function at n columns at once, between arrays of its own.

    Converting arrays to CasADi's matrices would take longer than the function. All columns share the first
    input; the others have a row a column in `inputs`. `outputs` have a row a column, too.

    Parameters
    ----------
    function : casadi.Function
    n : int
        Columns of each call; at least 1.
    summed : bool
        The outputs of all columns are added, into one row.
    """

    def __init__(self, function: Any, n: int, *, summed: bool = False) -> None:
        """Allocate the arrays that the function reads from and writes to."""
        reduced_outputs = [0] if summed else []
        mapped = function.map(function.name(), "serial", n, [0], reduced_outputs)
        # CasADi's matrices are stored by columns: the transposed shape in numpy's order.
        self.inputs = [np.zeros(mapped.size_in(i)[::-1]) for i in range(mapped.n_in())]
        self.outputs = [np.zeros(mapped.size_out(i)[::-1]) for i in range(mapped.n_out())]
        self._buffer, self._run = mapped.buffer()
        for number, array in enumerate(self.inputs):
            self._buffer.set_arg(number, array.data)
        for number, array in enumerate(self.outputs):
            self._buffer.set_res(number, array.data)

    def __call__(self, *values: Real) -> list[Real]:
        """Outputs, each (n, entries) or (1, entries) where summed, for the first few inputs; the others stay.

        Shapes have to be those of `inputs`, or broadcast to them (numpy's ValueError). The next call writes
        over the outputs.
        """
        for array, value in zip(self.inputs, values, strict=False):
            array[...] = value
        self._run()
        return self.outputs


class _EllipseArrays(NamedTuple):
    """Ellipses of all plants, (F,) each: centre and semi-axes, output per input, and direction of the major
    axis, complex of modulus one. `Ellipses` has checked the axes."""

    centre: Complex
    direction: Complex
    semi_major: Real
    semi_minor: Real


class _Point(NamedTuple):
    """What was computed last: parameters x (n,), K with its delay (F,), worst angles and rows (R,)."""

    x: Real
    k: Complex
    angles: Real
    logs: Real


class LoopRows:
    """Rows of one cascade for all plants, on grids that stay.

    Parameters
    ----------
    cascade : Cascade
    plants : sequence of Rows
        All sampled as the cascade is (not checked); at least one, with a weight above 0 somewhere, else
        numpy's ValueError of nothing to concatenate.

    Notes
    -----
    Several weights of one plant on the same closed-loop function make one row, of the largest. Rows are
    ordered by function, then plant, then frequency; there is none where the weight is 0.
    """

    def __init__(self, cascade: Cascade, plants: Sequence[Rows]) -> None:
        """Put all frequencies into one array (F,), all rows into one (R,), and build their functions; refuses
        nothing by itself (see the class)."""
        ellipses = [rows.ellipses for rows in plants]
        self._ellipses = _EllipseArrays(
            centre=np.concatenate([each.centre for each in ellipses]),
            direction=np.concatenate([each.direction for each in ellipses]),
            semi_major=np.concatenate([each.semi_major for each in ellipses]),
            semi_minor=np.concatenate([each.semi_minor for each in ellipses]),
        )
        self._delay = np.concatenate([rows.delay for rows in plants])
        omega = np.concatenate([each.omega_rad_s for each in ellipses])
        v = tustin_frequency(omega, cascade.dt_s) / cascade.scale_rad_s

        # For each closed-loop function: frequencies that have a row, log weights, and powers i, j of G and K.
        self._of_plant: list[slice] = []
        indices = []
        log_weights = []
        power_arrays = []
        start = 0
        for function in LoopFunction:
            sizes = []
            for rows in plants:
                of_function = [size for asked, size in rows.weights if asked is function]
                sizes.append(np.max(of_function, axis=0) if of_function else np.zeros(rows.delay.size))
            weight = np.concatenate(sizes)
            index = np.flatnonzero(weight > 0)
            if not index.size:
                continue
            indices.append(index)
            log_weights.append(np.log(weight[index]))
            powers = [[float(function.of_plant)], [float(function.of_controller)]]
            power_arrays.append(np.tile(powers, index.size))
            if function.of_plant:
                self._of_plant.append(slice(start, start + index.size))
            start += index.size
        self._index = np.concatenate(indices, axis=-1)
        self._weight = np.concatenate(log_weights, axis=-1)
        powers_of_rows = np.concatenate(power_arrays, axis=-1)
        self._of_k = powers_of_rows[1] > 0

        # What `row_functions` takes for p and plant, one line a row: it never changes.
        centre, direction, major, minor = self._ellipses
        complex_values = (centre, direction * major, 1j * direction * minor, self._delay)
        real_values = np.concatenate([[each.real, each.imag] for each in complex_values])
        far_and_near = np.stack([v, np.ones(v.size)], axis=1)
        larger = np.maximum(v, 1.0)
        p = far_and_near / larger[:, None]
        plant_of_rows = np.hstack([real_values.T[self._index], powers_of_rows.T])
        self._fixed = (p[self._index], plant_of_rows)
        response, slope, bend = row_functions(cascade.sections)
        self._response = _Mapped(response, v.size)
        self._response.inputs[1][...] = p
        self._slope = _Mapped(slope, self._index.size)
        self._slope.inputs[2][...] = self._fixed[0]
        self._slope.inputs[3][...] = self._fixed[1]
        self._bend = _Mapped(bend, _ROWS_PER_CALL, summed=True)
        self._latest: _Point | None = None

    def covers_minus_one(self, x: Real) -> bool:
        """Whether some ellipse contains -1/K under x (n,); the rows, of its boundary, would not show it.

        One without extent (a semi-axis of zero) contains nothing.
        """
        centre, direction, semi_major, semi_minor = self._ellipses
        k = self._at(x).k
        # 1/K + centre in the ellipse's own axes, times |K|^2: no division by a K that vanishes.
        turned = (1.0 + k * centre) * np.conj(k * direction)
        size = np.abs(k) ** 2
        along_major = turned.real * semi_minor
        along_minor = turned.imag * semi_major
        inside = np.hypot(along_major, along_minor) < size * semi_major * semi_minor
        return bool(np.any(inside))

    def rows(self, x: Real) -> Real:
        """Logarithms (R,) of all weighted values under x (n,); log 1e-300 for a value of 0.

        Of boundaries only, and without regard to stability: see `covers_minus_one`.
        """
        return self._at(x).logs

    def slopes(self, x: Real) -> Real:
        """Slopes (R, n) of the rows in the parameters x (n,), the worst members held; a copy.

        x of another length is numpy's ValueError here and in the other methods.
        """
        angles = self._at(x).angles
        (slope,) = self._slope(x, angles[:, None])
        return slope.reshape(-1, x.size).copy()

    def curvature(self, x: Real, multipliers: Real) -> Real:
        """Second derivative (n, n) of the rows' sum weighted by multipliers (R,), at x (n,).

        Multipliers below `_NOTHING` of the largest are left out; all zero give a zero matrix.
        """
        angles = self._at(x).angles
        total = np.zeros((x.size, x.size))
        active = np.flatnonzero(multipliers > _NOTHING * np.max(multipliers))
        for start in range(0, active.size, _ROWS_PER_CALL):
            # The last call is filled up with a row of multiplier 0.
            use = active[start : start + _ROWS_PER_CALL]
            missing = _ROWS_PER_CALL - use.size
            share = np.append(multipliers[use], np.zeros(missing))
            use = np.append(use, np.repeat(use[:1], missing))
            p, plant = self._fixed
            (bend,) = self._bend(x, angles[use, None], p[use], plant[use], share[:, None])
            total += bend
        return total

    def _at(self, x: Real) -> _Point:
        """K, worst members and rows under x (n,); computed once for successive calls with the same x."""
        if self._latest is None or not np.array_equal(self._latest.x, x):
            re, im = self._response(x)
            bare = (re + 1j * im)[:, 0]
            k = bare * self._delay
            # Angles and values of |1/(1 + G K)| at all frequencies, dealt to the rows; of |G/(1 + G K)| where
            # the row's function has G.
            worst = _worst_members(k, np.arange(k.size), *self._ellipses, False)[:, self._index]
            for rows in self._of_plant:
                worst[:, rows] = _worst_members(k, self._index[rows], *self._ellipses, True)
            angles = worst[0]
            k_sizes = np.abs(bare[self._index])
            sizes = worst[1] * np.where(self._of_k, k_sizes, 1.0)
            logs = self._weight + np.log(np.maximum(sizes, _TINY))
            self._latest = _Point(x.copy(), k, angles, logs)
        return self._latest


@numba.njit(**COMPILED)
def _worst_members(
    k: Complex,
    index: Integer,
    centre: Complex,
    direction: Complex,
    semi_major: Real,
    semi_minor: Real,
    of_plant: bool,
) -> Real:
    """Angles (first row) and values (second row), (2, D), of the worst members at D of the frequencies.

    The worst member has the largest |1/(1 + G K)|, or |G/(1 + G K)| if of_plant; k (F,) is K with its delay,
    index (D,) says which frequencies, and the ellipses are (F,) each. Best boundary point, vertex of the
    parabola through it and its neighbours, Newton from there. A point that does not gain on the boundary's
    best is not taken. A loop on -1 has the value 1 / sqrt(1e-300); nothing is checked.
    """
    width = 2 * np.pi / _BOUNDARY
    cos = np.empty(_BOUNDARY)
    sin = np.empty(_BOUNDARY)
    for j in range(_BOUNDARY):
        cos[j] = np.cos(j * width)
        sin[j] = np.sin(j * width)
    worst = np.empty((2, index.size))
    values = np.empty(_BOUNDARY)
    for number in range(index.size):
        i = index[number]
        major = direction[i] * semi_major[i]
        minor = 1j * direction[i] * semi_minor[i]

        # Best point of the boundary; index -1 is the last one, which is a neighbour of the first.
        top = 0
        for j in range(_BOUNDARY):
            member = centre[i] + cos[j] * major + sin[j] * minor
            values[j] = _size(member, k[i], of_plant)
            if values[j] > values[top]:
                top = j
        best_value = values[top]
        before = values[top - 1]
        after = values[(top + 1) % _BOUNDARY]
        best_angle = top * width

        # Vertex of the parabola through three points, at most half a step (width) away: beyond it a neighbour
        # would have been the best. Newton's steps keep within half a width for the same reason.
        change = _vertex(0.5 * (after - before), before - 2 * best_value + after)
        angle = best_angle + width * min(max(change, -0.5), 0.5)
        for _ in range(_REFINEMENTS + 1):
            # g1 and g2: first and second derivative of the member g in the angle.
            g1 = np.cos(angle) * minor - np.sin(angle) * major
            g2 = -np.cos(angle) * major - np.sin(angle) * minor
            g = centre[i] - g2
            value = _size(g, k[i], of_plant)
            if value > best_value:
                best_value = value
                best_angle = angle
            # Slope and bend of the logarithm along the boundary.
            back = 1.0 + g * k[i]
            if back == 0:
                break
            first = -g1 * k[i] / back
            second = -g2 * k[i] / back
            second += first * first
            if of_plant and g != 0:
                first = first + g1 / g
                second = second + g2 / g - (g1 / g) ** 2
            change = _vertex(first.real, second.real)
            angle += min(max(change, -0.5 * width), 0.5 * width)
        worst[0, number] = best_angle
        worst[1, number] = best_value
    return worst


@numba.njit(**INSIDE)
def _size(g: complex, k: complex, of_plant: bool) -> Any:
    """|1/(1 + g k)|, or |g/(1 + g k)| if of_plant; in squares, since a modulus costs more than all the rest.

    g: a member of the plant, k: the controller with its delay. At most 1e150 (|g| times), where g k = -1.
    """
    back = 1.0 + g * k
    above = g.real * g.real + g.imag * g.imag if of_plant else 1.0
    return np.sqrt(above / max(back.real * back.real + back.imag * back.imag, _TINY))


@numba.njit(**INSIDE)
def _vertex(slope: float, bend: float) -> float:
    """Step to the maximum of a parabola with this slope and second derivative; 0 where it has none."""
    return slope / -bend if bend < 0 else 0.0
