"""Structured controllers: a cascade of first- and second-order sections in the Tustin plane.

With p = (2/dt)(z - 1)/(z + 1)/scale, on the unit circle p = j (2/dt) tan(omega dt/2)/scale, a section is

    second order  (n2 p^2 + n1 p + n0)/(p^2 + e^a p + e^b)
    first order   (n1 p + n0)/(p + e^a)
    integrator    (n1 p + n0)/p
    a part        PID, notch or low-pass in an engineer's parameters (`parts`)

and the controller is their product. Denominators are searched by their logarithms, so that every parameter
vector gives a stable controller (but for an integrator). `Cascade` is the structure; its methods read a
parameter vector: as coefficients, as a frequency response, as roots, and as a discrete state space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from control_design.controllers.parts import Part
from control_design.plants.ellipses import Complex, Real

SectionKind = Literal["integrator", "first_order", "second_order"]
Section = SectionKind | Part

# How many parameters of each kind of section belong to its numerator and to its denominator.
_NUMERATORS: dict[SectionKind, int] = {"integrator": 2, "first_order": 2, "second_order": 3}
_DENOMINATORS: dict[SectionKind, int] = {"integrator": 0, "first_order": 1, "second_order": 2}

# Relative amount by which a bound on the denominators may be missed before a controller is refused: a
# thousand times the 1e-6 by which a step of a descent may leave its programme, and no damping ratio is stated
# to 1e-3.
SOLVER_SLACK = 1e-3

# A root of h p nearer to 1 than this is at infinity in z: what a missing zero becomes, but for rounding.
_INFINITE_ROOT_DISTANCE = 1e-12


@dataclass(frozen=True)
class Cascade:
    """Structure of a controller; the values are a parameter vector x that its methods take.

    Parameters
    ----------
    sections : tuple of Section
        In the order of the parameter vector and of the signal; without any the controller is 1.
    dt_s : float
        Sampling period in seconds, positive.
    scale_rad_s : float
        Frequency, positive, at which p = j, about that of the controller's corners: parameters are of size
        one. Parts hold what is fixed of them in its units.

    Notes
    -----
    Nothing is checked but the length of parameter vectors; a kind that is no `SectionKind` is a KeyError.
    """

    sections: tuple[Section, ...]
    dt_s: float
    scale_rad_s: float

    @property
    def order(self) -> int:
        """Number of states: of a section of second order two, of a part its own, of each other section
        one."""
        order = 0
        for section in self.sections:
            if isinstance(section, Part):
                order += section.order
            else:
                order += 2 if section == "second_order" else 1
        return order

    @property
    def parameters(self) -> int:
        """Length of the parameter vector: section by section the numerator, then logarithms of the
        denominator; of a part what is free."""
        return sum(_parameters_of(section) for section in self.sections)

    @property
    def has_parts(self) -> bool:
        """Whether the controller is made of parts, whose zeros are not free."""
        return any(isinstance(section, Part) for section in self.sections)

    def starts(self) -> list[tuple[Section, int]]:
        """Every section with the place in the parameter vector at which its own parameters start."""
        places = []
        start = 0
        for section in self.sections:
            places.append((section, start))
            start += _parameters_of(section)
        return places

    def damping_rows(self) -> tuple[Real, Real]:
        """Damping ratios of the pairs of poles that are free, as log zeta = rows x - log factor.

        Returns
        -------
        rows : (L, P) array
            One for each section of second order (a - b/2) and each part whose damping ratio is free.
        factor : (L,) array
            2 of a section of second order, zeta = e^a/(2 e^(b/2)), 1 of a part.
        """
        rows = []
        factors = []
        for section, start in self.starts():
            row = np.zeros(self.parameters)
            if isinstance(section, Part):
                place = section.log_damping()
                if place is None:
                    continue
                row[start + place] = 1.0
                factors.append(1.0)
            elif section == "second_order":
                a = start + _NUMERATORS[section]
                row[a] = 1.0
                row[a + 1] = -0.5
                factors.append(2.0)
            else:
                continue
            rows.append(row)
        return np.array(rows).reshape(len(rows), self.parameters), np.array(factors)

    def pairs(self, x: Sequence[float] | Real) -> list[tuple[float, float]]:
        """Damping ratio and corner (units of the scale) of each pair of poles in p, above 1 for two real
        poles. x (P,): a longer one passes, a shorter one is an IndexError."""
        values = np.asarray(x, dtype=np.float64)
        pairs = []
        for section, start in self.starts():
            if isinstance(section, Part):
                pair = section.pair(values[start : start + section.parameters])
                if pair is not None:
                    pairs.append(pair)
            elif section == "second_order":
                a = values[start + _NUMERATORS[section]]
                b = values[start + _NUMERATORS[section] + 1]
                pairs.append((float(0.5 * np.exp(a - 0.5 * b)), float(np.exp(0.5 * b))))
        return pairs

    def least_damping(self, x: Sequence[float] | Real) -> float:
        """Smallest damping ratio of `pairs`; infinite without any. x (P,) as there."""
        return min((damping for damping, _ in self.pairs(x)), default=np.inf)

    def split(self, x: Sequence[float] | Real) -> list[tuple[Real, Real]]:
        """Numerator and denominator of every section: coefficients of p, highest power first, of one length.

        x : (P,) parameter vector. Raises ValueError for another length; nan or infinite parameters pass.
        """
        values = np.asarray(x, dtype=np.float64)
        if values.shape != (self.parameters,):
            raise ValueError(f"need {self.parameters} parameters for {self.sections}; got {values.shape}")
        sections = []
        for numerator, denominator in self.split_with(values, np.exp):
            sections.append((np.array(numerator), np.array(denominator)))
        return sections

    def split_with(self, x: Any, exp: Callable[[Any], Any]) -> list[tuple[list[Any], list[Any]]]:
        """Numerator and denominator of every section as lists, for a vector x of numbers or symbols.

        exp : the exponential of such an element. Nothing is checked; see `split`.
        """
        sections = []
        for section, start in self.starts():
            if isinstance(section, Part):
                own = [x[i] for i in range(start, start + section.parameters)]
                sections.append(section.coefficients(own, exp))
                continue
            logarithms_start = start + _NUMERATORS[section]
            section_end = logarithms_start + _DENOMINATORS[section]
            numerator = [x[i] for i in range(start, logarithms_start)]
            tail = [exp(x[i]) for i in range(logarithms_start, section_end)]
            # An integrator has no parameter in its denominator p.
            if not tail:
                tail = [0.0]
            sections.append((numerator, [1.0, *tail]))
        return sections

    def response(self, x: Sequence[float] | Real, omega_rad_s: Real) -> Complex:
        """K(e^{j omega dt}), (F,) complex, for parameters x (P,) and omega (F,) in rad/s up to pi/dt. At
        Nyquist p is infinite, and the limit is used. At 0 an integrator is nan (numpy warns). Raises
        ValueError for another length of x."""
        p = 1j * tustin_frequency(omega_rad_s, self.dt_s) / self.scale_rad_s
        value = np.ones(p.shape, dtype=np.complex128)
        for numerator, denominator in self.split(x):
            # Where |p| > 1 both polynomials are divided by their leading power and evaluated in q = 1/p, so
            # that p ~ 1e16 at Nyquist stays exact. Each form is fed harmless values where the other one
            # counts.
            big = np.abs(p) > 1.0
            q = np.where(big, 1.0 / np.where(big, p, 1.0), 0.0)
            direct_denominator = np.polyval(denominator, np.where(big, 1.0, p))
            direct_denominator = np.where(big, 1.0, direct_denominator)
            direct = np.polyval(numerator, np.where(big, 0.0, p)) / direct_denominator
            inverted = np.polyval(numerator[::-1], q) / np.polyval(denominator[::-1], q)
            value = value * np.where(big, inverted, direct)
        return value

    def roots(self, x: Sequence[float] | Real) -> Complex:
        """Zeros and poles of all sections in z, (N,) complex together, for parameters x (P,); those at
        infinity are left out. z = (1 + h p)/(1 - h p) with h = dt scale/2. A parameter that is not finite is
        numpy's LinAlgError, another length of x a ValueError."""
        h = self.dt_s * self.scale_rad_s / 2.0
        roots = []
        for numerator, denominator in self.split(x):
            roots.append(np.roots(numerator))
            roots.append(np.roots(denominator))
        p = np.concatenate(roots)
        is_finite = np.abs(1.0 - h * p) > _INFINITE_ROOT_DISTANCE
        p = p[is_finite]
        return np.asarray((1.0 + h * p) / (1.0 - h * p), dtype=np.complex128)

    def state_space(self, x: Sequence[float] | Real) -> tuple[Real, Real, Real, Real]:
        """Discrete state space A (n, n), B (n, 1), C (1, n), D (1, 1) of the cascade, for parameters x (P,).

        Every section is taken to z by the trapezoidal rule: x' = F x + g u becomes A = (I - F h)^-1 (I + F
        h), with h = dt scale/2. The states are those of the sections in their order. Raises ValueError for
        another length of x.
        """
        h = self.dt_s * self.scale_rad_s / 2.0
        order = self.order
        a = np.zeros((order, order))
        b = np.zeros((order, 1))
        c = np.zeros((1, order))
        d = 1.0
        before = 0
        for numerator, denominator in self.split(x):
            section_a, section_b, section_c, section_d = _tustin_section(numerator, denominator, h)
            # The output of the cascade so far drives the section.
            end = before + len(section_a)
            a[before:end, before:end] = section_a
            a[before:end, :before] = section_b * c[:, :before]
            b[before:end] = section_b * d
            direct = section_d[0, 0]
            c[0, :before] *= direct
            c[0, before:end] = section_c[0]
            d *= direct
            before = end
        return a, b, c, np.array([[d]])


def _parameters_of(section: Section) -> int:
    """Number of parameters of a section; KeyError for a kind that is none."""
    if isinstance(section, Part):
        return section.parameters
    return _NUMERATORS[section] + _DENOMINATORS[section]


def tustin_frequency(omega_rad_s: Real, dt_s: float) -> Real:
    """v = (2/dt) tan(omega dt/2) in rad/s, (F,): where omega (F,) in rad/s lies on the imaginary axis of the
    Tustin plane. Some 1e16/dt at Nyquist, by rounding; beyond it the sign turns (not checked)."""
    return np.asarray(2.0 / dt_s * np.tan(np.asarray(omega_rad_s) * dt_s / 2.0), dtype=np.float64)


def imaginary_axis(omega_rad_s: Real, dt_s: float) -> Complex:
    """s = j (2/dt) tan(omega dt/2), (F,) complex in rad/s, where weights and sections are evaluated at omega
    (F,) in rad/s, up to Nyquist as of `tustin_frequency`."""
    return np.asarray(1j * tustin_frequency(omega_rad_s, dt_s), dtype=np.complex128)


def _tustin_section(numerator: Real, denominator: Real, h: float) -> tuple[Real, Real, Real, Real]:
    """Discrete state space (A, B, C, D) of a section numerator/denominator in p, with up to two states.

    numerator, denominator : (1,), (2,) or (3,) coefficients, highest power first, the denominator's first one
    is 1. It is a balanced companion form, mapped by the trapezoidal rule with step 2 h. The rule needs (I - h
    F)^-1; for one or two states it is written out, since searches build many loops. The symmetric split
    sqrt(2 h) on input and output keeps both of one size. h : half a sample in units of 1/scale, dt scale/2,
    positive. Coefficients are those of `Cascade.split`: of a denominator of degree two the last one is
    positive, or 0 of a PID, whose filter's corner then takes the place of w0.
    """
    direct = float(numerator[0])
    if denominator.size == 1:
        return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[direct]])
    # Numerator of what is left beside the direct term.
    tail = [float(value) for value in numerator[1:] - direct * denominator[1:]]
    root = float(np.sqrt(2.0 * h))
    if denominator.size == 2:
        f = -float(denominator[1])
        inverse = 1.0 / (1.0 - h * f)
        return (
            np.array([[(1.0 + h * f) * inverse]]),
            np.array([[root * inverse]]),
            np.array([[root * tail[0] * inverse]]),
            np.array([[direct + h * tail[0] * inverse]]),
        )
    # States (w0 x, x') with w0 = sqrt(e^b): both of one size around the section's own frequency.
    # F = [[0, w0], [-w0, -d]], g = (0, 1)', row = (tail1/w0, tail0).
    d = float(denominator[1])
    if denominator[2] == 0.0:
        # An integrator and a lag: F = [[0, d], [0, -d]], states (d x, x').
        inverse_matrix = np.array([[1.0, h * d / (1.0 + h * d)], [0.0, 1.0 / (1.0 + h * d)]])
        output_row = np.array([[tail[1] / d, tail[0]]]) @ inverse_matrix
        a = 2.0 * inverse_matrix - np.eye(2)
        feedthrough = np.array([[direct + h * float(output_row[0, 1])]])
        return a, root * inverse_matrix[:, 1:], root * output_row, feedthrough
    w0 = float(np.sqrt(denominator[2]))
    v = h * w0
    determinant_inverse = 1.0 / (1.0 + h * d + v * v)
    inverse_matrix = np.array(
        [
            [(1.0 + h * d) * determinant_inverse, v * determinant_inverse],
            [-v * determinant_inverse, determinant_inverse],
        ]
    )
    output_row = np.array([[tail[1] / w0, tail[0]]]) @ inverse_matrix
    # (I - hF)^-1 (I + hF) = 2 (I - hF)^-1 - I
    a = 2.0 * inverse_matrix
    a[0, 0] -= 1.0
    a[1, 1] -= 1.0
    feedthrough = np.array([[direct + h * float(output_row[0, 1])]])
    return a, root * inverse_matrix[:, 1:], root * output_row, feedthrough
