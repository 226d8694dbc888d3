"""The nonlinear programme of the synthesis: angle form of the exact conditions on the ellipses, CasADi and
IPOPT.

Distance from -1 to the convex set K E is the largest value over unit normals e^{jt} of
    m(t) = Re(e^{-jt} c) - sqrt(s1^2 Re(q)^2 + s2^2 Im(q)^2 + eps),   c = 1 + G K,  q = e^{-jt} K u1,
so |W S| <= 1/g for every G in E  <=>  there is t with m(t) >= g |W|, likewise g |W K| for K S and g |W Gp|
for an independent Gp. Functions with the member itself as a factor have no row: the descent takes them up.
Variables: controller parameters, g, one t per frequency. Maximise log g.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.plants.ellipses import Complex, Ellipses, Real
from control_design.specification.requirement import LoopFunction
from control_design.synthesis.interrupts import interrupts_kept
from control_design.synthesis.synthesis_result import StartReport

Symbol = Any  # casadi.SX; its stubs disagree with its own arithmetic on numpy arrays

_EPS = 1e-10  # under the root, relative to the row: errs on the safe side by at most 1e-5 of |1 + L|


@dataclass(frozen=True, eq=False)
class Rows:
    """Everything the programme needs of one plant (or delayed copy) on its grid; all arrays (F,).

    delay : z^-d times a delay copy, multiplies K. weights : magnitude (F,) of the weights on functions of the
    members, 0 = no row; those with the member as a factor are rows of the descent only. start_window : range
    of the first angle for a stable loop.
    """

    ellipses: Ellipses
    delay: Complex
    weights: tuple[tuple[LoopFunction, Real], ...]
    row_scale: Real
    start_window: tuple[float, float]
    reaches_nyquist: bool


class AngleProgram:
    """One NLP for fixed structure and grid; `solve` may be called from many starts."""

    def __init__(
        self,
        cascade: Cascade,
        plants: Sequence[Rows],
        *,
        controller_damping: float | None = None,
        max_iterations: int = 250,
        tolerance: float = 1e-6,
    ) -> None:
        self.cascade = cascade
        self.plants = tuple(plants)
        x = ca.SX.sym("x", cascade.parameters)
        g = ca.SX.sym("g")
        low, high = parameter_bounds(cascade)
        variables, lower, upper = [x, g], [*low, 1e-4], [*high, 1e4]
        rows: list[Symbol] = []
        row_lower: list[Real] = []
        row_upper: list[Real] = []

        def add(expression: Symbol, low: float, high: float) -> None:
            rows.append(expression)
            row_lower.append(np.full(expression.numel(), low))
            row_upper.append(np.full(expression.numel(), high))

        if controller_damping is not None:
            # p^2 + e^a p + e^b has damping e^(a - b/2)/2: a straight line in the parameters.
            for at in cascade.pair_positions:
                add(x[at] - 0.5 * x[at + 1], float(np.log(2 * controller_damping)), np.inf)

        for plant in self.plants:
            e = plant.ellipses
            n = e.omega_rad_s.size
            k_re, k_im = self._response(x, e.omega_rad_s)
            d = plant.delay
            k_re, k_im = k_re * d.real - k_im * d.imag, k_re * d.imag + k_im * d.real
            t: Symbol = ca.SX.sym("t", n)
            variables.append(t)
            low, high = np.full(n, -np.inf), np.full(n, np.inf)
            low[0], high[0] = plant.start_window
            if plant.reaches_nyquist:
                low[-1], high[-1] = -0.6, 0.6
            lower += list(low)
            upper += list(high)
            if n > 1:
                add(t[1:] - t[:-1], -1.0, 1.0)
            cos_t, sin_t = ca.cos(t), ca.sin(t)
            c_re = 1 + e.centre.real * k_re - e.centre.imag * k_im
            c_im = e.centre.real * k_im + e.centre.imag * k_re
            v_re = e.direction.real * k_re - e.direction.imag * k_im
            v_im = e.direction.real * k_im + e.direction.imag * k_re
            q_re = cos_t * v_re + sin_t * v_im
            q_im = cos_t * v_im - sin_t * v_re
            scale = plant.row_scale
            eps = _EPS / scale**2
            reach = ca.sqrt(e.semi_major**2 * q_re**2 + e.semi_minor**2 * q_im**2 + eps)
            margin = scale * (cos_t * c_re + sin_t * c_im - reach)
            for function, weight in plant.weights:
                use = np.flatnonzero(weight > 0).tolist()
                if function.of_plant or not use:
                    continue
                row = g * (scale * weight)
                if function.of_controller:
                    row = row * ca.sqrt(k_re**2 + k_im**2 + 1e-16)
                add((margin - row)[use], 0.0, np.inf)
        nlp: dict[str, Any] = {"x": ca.vertcat(*variables), "f": -ca.log(g), "g": ca.vertcat(*rows)}
        self._bounds = np.array(lower), np.array(upper)
        self._row_bounds = np.concatenate(row_lower), np.concatenate(row_upper)
        options: dict[str, Any] = {
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": max_iterations,
                "tol": tolerance,
                "acceptable_tol": 1e-4,
                "acceptable_iter": 8,
                "mu_strategy": "adaptive",
            },
            "print_time": False,
            "error_on_fail": False,
        }
        with interrupts_kept():
            self._solver = ca.nlpsol("angle_program", "ipopt", nlp, options)

    def _response(self, x: Symbol, omega: Real) -> tuple[Symbol, Symbol]:
        """Real and imaginary part of K on the grid; sections in p or, above |p| = 1, in 1/p."""
        v = tustin_frequency(omega, self.cascade.dt_s) / self.cascade.scale_rad_s
        v = np.minimum(v, 1e12)
        size = np.maximum(1.0, v)
        re: Symbol = ca.SX.ones(omega.size)
        im: Symbol = ca.SX.zeros(omega.size)
        for numerator, denominator in self.cascade.split_with(x, ca.exp):
            # Of degree 2 or 1, both divided by the same power of max(1, |p|).
            (n_re, n_im), (d_re, d_im) = (_over(part, v, size) for part in (numerator, denominator))
            square = d_re**2 + d_im**2
            f_re = (n_re * d_re + n_im * d_im) / square
            f_im = (n_im * d_re - n_re * d_im) / square
            re, im = re * f_re - im * f_im, re * f_im + im * f_re
        return re, im

    def solve(self, parameters: Real, gamma: float) -> tuple[Real, StartReport]:
        """Maximise log g from controller parameters and their gamma; KeyboardInterrupt if one came meanwhile
        (IPOPT would end early).

        The angles start along the nearest unwrapped phase of 1 + L.
        """
        initial: list[Real] = [parameters, np.array([1.0 / min(max(gamma, 1e-3), 1e3)])]
        for plant in self.plants:
            loop = self.cascade.response(parameters, plant.ellipses.omega_rad_s) * plant.delay
            phase = np.unwrap(np.angle(1.0 + plant.ellipses.centre * loop))
            middle = 0.5 * (plant.start_window[0] + plant.start_window[1])
            initial.append(phase - 2 * np.pi * np.round((phase[0] - middle) / (2 * np.pi)))
        with interrupts_kept():
            answer = self._solver(
                x0=np.clip(np.concatenate(initial), *self._bounds),
                lbx=self._bounds[0],
                ubx=self._bounds[1],
                lbg=self._row_bounds[0],
                ubg=self._row_bounds[1],
            )
        values, stats, n = np.asarray(answer["x"]).ravel(), self._solver.stats(), self.cascade.parameters
        gamma = 1.0 / float(values[n])
        return values[:n], StartReport(str(stats["return_status"]), int(stats["iter_count"]), gamma, None)


def _over(coefficients: Sequence[Symbol], v: Real, size: Real) -> tuple[Symbol, Symbol]:
    """Real and imaginary part of a polynomial at p = jv, highest power first, over size^degree."""
    if len(coefficients) == 2:
        return coefficients[1] * (1 / size), coefficients[0] * (v / size)
    two, one, zero = coefficients
    return -two * (v / size) ** 2 + zero * (1 / size**2), one * (v / size**2)


def parameter_bounds(cascade: Cascade) -> tuple[Real, Real]:
    """Logarithms kept within a few decades of the scale: exp() never overflows in a wild step."""
    low: list[float] = []
    for kind in cascade.sections:
        low += {
            "integrator": [-np.inf] * 2,
            "first_order": [-np.inf] * 2 + [-12.0],
            "second_order": [-np.inf] * 3 + [-12.0, -20.0],
            "notch": [-12.0, -12.0, -20.0],
        }[kind]
    return np.array(low), -np.array(low)
