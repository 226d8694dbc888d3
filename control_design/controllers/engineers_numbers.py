"""A controller in an engineer's numbers: Kp, Ti, Td, Tf, notches, low-passes, read off its state space.

`engineers_numbers` factors a controller of one loop in the Tustin plane, s = (2/dt)(z - 1)/(z + 1), where
every discrete controller is a rational function of s:

    K = Kp (1 + 1/(Ti s) + Td s/(Tf s + 1)) x notches x low-passes         where it has such a structure,
    K = gain/s^i x (zeros over poles, each of static gain 1)               else.

Both are exact: the record reproduces the controller's response within `LARGEST_ERROR`, or there is no record.
Frequencies in Hz are those of the discrete controller, f = atan(w dt/2)/(pi dt): a notch at f has its depth
at f. Times are those of s: Ti and Td are what a PID has that is discretised by the trapezoidal rule. All is
about the law that the processor runs, without the computational delay.

The factors are found as roots (eigenvalues), sharpened by Gauss-Newton steps on the logarithm of the
response, and put together: a pair of zeros and one of poles at the same frequency are a notch; what is left
is a PID if it has no more than its zeros and poles; poles without zeros are low-passes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from control_design.controllers.law import Law
from control_design.controllers.parts import (
    DERIVATIVE_RATIOS,
    NOTCH_DAMPING,
    Structure,
    frequency_of_corner,
    width_of_damping,
)
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import count_integrators

# Largest relative difference of the responses of record and controller: far below what any number is shown
# with, far above the rounding of a state space of sixteen states.
LARGEST_ERROR = 1e-9

# Frequencies of the Tustin plane at which the two are compared and the roots sharpened: some forty a decade
# of a usual controller. Chosen.
_POINTS = 240
# How far below the slowest and above the fastest root they reach, a factor.
_BEYOND = 10.0
# Highest of them, tan(.45 pi), 90 % of Nyquist: above, zeros at Nyquist leave only rounding.
_HIGHEST = 6.3
# Lowest of them, half radians per sample: below, an integrator is all there is.
_LOWEST = 1e-7
# Gauss-Newton steps on the roots: from eigenvalues that are right to 1e-4 the third reaches rounding.
_SHARPENINGS = 6
# Modulus of a zero in t = s dt/2 from which on it is at infinity: one at z = -1, of which rounding has made
# two that are 1e-7 apart.
_INFINITE = 1e5
# Relative difference of frequencies up to which zeros and poles are those of one notch; notches of a design
# have it within rounding.
_SAME_FREQUENCY = 1e-6
# Ratio of frequencies of a pair of zeros and one of poles up to which a general controller is said to have a
# notch there, an octave. It decides a word and no number.
_NEAR = 2.0
# Imaginary part over modulus from which on a root is one of a pair.
_COMPLEX = 1e-9
# Ratio up to which a number counts as ended at its lower limit: descents end within their tolerance of it.
# Chosen.
_AT_LIMIT = 1.0 + 1e-4
# Least quotient; keeps logarithms finite.
_TINY = 1e-300


@dataclass(frozen=True)
class PidNumbers:
    """Kp (1 + 1/(Ti s) + Td s/(Tf s + 1)); None: not of this structure.

    Attributes
    ----------
    structure : "p", "pi", "pd" or "pid"
    kp : float
        Command per error.
    ti_s, td_s, tf_s : float or None
        Seconds. A Tf of 0: the derivative has no filter but the low-pass.
    """

    structure: Structure
    kp: float
    ti_s: float | None = None
    td_s: float | None = None
    tf_s: float | None = None


@dataclass(frozen=True)
class NotchNumbers:
    """(s^2 + 2 zeta/depth w s + w^2)/(s^2 + 2 zeta w s + w^2).

    Attributes
    ----------
    frequency_hz : float
        Middle, at which the discrete controller has the depth.
    depth_db : float
        Gain beside it over gain in it.
    width_hz : float
        Between the frequencies at which half of its power is taken off.
    damping : float
        zeta, of the poles; that of the zeros is zeta/depth.
    """

    frequency_hz: float
    depth_db: float
    width_hz: float
    damping: float


@dataclass(frozen=True)
class LowPassNumbers:
    """w/(s + w), or w^2/(s^2 + 2 zeta w s + w^2): corner in Hz, order, and damping ratio of order 2."""

    frequency_hz: float
    order: int
    damping: float | None = None


@dataclass(frozen=True)
class CornerNumbers:
    """A real root, or a pair: its corner in Hz (negative of a real zero in the right half plane) and the
    damping ratio of a pair (negative there)."""

    frequency_hz: float
    damping: float | None = None


@dataclass(frozen=True)
class FactorNumbers:
    """Zeros over poles of static gain 1.

    Attributes
    ----------
    kind : str
        "notch" or "resonance" (a pair over a pair at neighbouring frequencies), "lead", "lag" (one over one),
        else "zeros and poles".
    zeros, poles : tuple of CornerNumbers
    depth_db : float or None
        Of a notch: how much its gain at the zeros' frequency is below 1; negative of a resonance.
    """

    kind: str
    zeros: tuple[CornerNumbers, ...]
    poles: tuple[CornerNumbers, ...]
    depth_db: float | None = None


@dataclass(frozen=True)
class ControllerNumbers:
    """A controller's factors.

    Attributes
    ----------
    dt_s : float
        Its period, s.
    pid : PidNumbers or None
        None where the rest is no PID: then gain and integrators count.
    gain : float
        Without a PID the limit of s^integrators K at s = 0; with one Kp.
    integrators : int
        Poles at s = 0, with and without a PID.
    notches, low_passes : tuple
        By frequency.
    factors : tuple of FactorNumbers
        What is none of these; by frequency.
    response_error : float
        Largest relative difference to the controller's response, at most `LARGEST_ERROR`.
    gain_unit : str
        Unit of Kp and gain, "V/rad", of the command over that of the error; "": not known.
    """

    dt_s: float
    pid: PidNumbers | None
    gain: float
    integrators: int
    notches: tuple[NotchNumbers, ...] = ()
    low_passes: tuple[LowPassNumbers, ...] = ()
    factors: tuple[FactorNumbers, ...] = ()
    response_error: float = field(default=0.0, compare=False)
    gain_unit: str = field(default="", compare=False)

    @property
    def structure(self) -> str:
        """What it is in a few words: "PID, 1 notch, low-pass"."""
        words = []
        if self.pid is not None:
            words.append(self.pid.structure.upper())
        else:
            words.append("gain")
            if self.integrators == 1:
                words.append("integrator")
            elif self.integrators:
                words.append(f"{self.integrators} integrators")
        for count, one, several in (
            (len(self.notches), "notch", "notches"),
            (len(self.low_passes), "low-pass", "low-passes"),
            (len(self.factors), "other factor", "other factors"),
        ):
            if count == 1:
                words.append(f"1 {one}" if one != "low-pass" else one)
            elif count:
                words.append(f"{count} {several}")
        return ", ".join(words)

    def response(self, omega_rad_s: Real) -> Complex:
        """K(e^{j omega dt}) without delay, (F,) complex, of the numbers alone; omega (F,), rad/s, above 0 and
        below Nyquist (not checked)."""
        t = 1j * np.tan(np.asarray(omega_rad_s) * self.dt_s / 2.0)
        s = 2.0 / self.dt_s * t
        if self.pid is not None:
            form = np.ones(t.size, dtype=np.complex128)
            if self.pid.ti_s is not None:
                form = form + 1.0 / (self.pid.ti_s * s)
            if self.pid.td_s is not None and self.pid.tf_s is not None:
                form = form + self.pid.td_s * s / (self.pid.tf_s * s + 1.0)
            value = self.pid.kp * form
        else:
            value = self.gain / s**self.integrators
        for notch in self.notches:
            w = np.tan(np.pi * notch.frequency_hz * self.dt_s)
            swing = 2.0 * notch.damping * w * t
            depth = 10.0 ** (notch.depth_db / 20.0)
            value = value * (t**2 + swing / depth + w**2) / (t**2 + swing + w**2)
        for low_pass in self.low_passes:
            value = value / self._corner_polynomial(CornerNumbers(low_pass.frequency_hz, low_pass.damping), t)
        for factor in self.factors:
            for zero in factor.zeros:
                value = value * self._corner_polynomial(zero, t)
            for pole in factor.poles:
                value = value / self._corner_polynomial(pole, t)
        return np.asarray(value, dtype=np.complex128)

    def _corner_polynomial(self, corner: CornerNumbers, t: Complex) -> Complex:
        """1 + t/w or 1 + 2 zeta t/w + (t/w)^2 at t (F,)."""
        ratio = t / np.tan(np.pi * corner.frequency_hz * self.dt_s)
        if corner.damping is None:
            return np.asarray(1.0 + ratio)
        return np.asarray(1.0 + 2.0 * corner.damping * ratio + ratio**2)

    def constants(self) -> dict[str, float]:
        """Every number by a name in capitals, `KP`, `TI_S`, `NOTCH_1_HZ` ..., as the C header has them: to
        thirteen digits, behind which there is rounding."""
        constants: dict[str, float] = {}
        if self.pid is not None:
            constants["KP"] = self.pid.kp
            for name in ("ti_s", "td_s", "tf_s"):
                value = getattr(self.pid, name)
                if value is not None:
                    constants[name.upper()] = value
        else:
            constants["GAIN"] = self.gain
            constants["INTEGRATORS"] = float(self.integrators)
        for number, notch in enumerate(self.notches, 1):
            constants[f"NOTCH_{number}_HZ"] = notch.frequency_hz
            constants[f"NOTCH_{number}_DEPTH_DB"] = notch.depth_db
            constants[f"NOTCH_{number}_WIDTH_HZ"] = notch.width_hz
            constants[f"NOTCH_{number}_DAMPING"] = notch.damping
        for number, low_pass in enumerate(self.low_passes, 1):
            constants[f"LOW_PASS_{number}_HZ"] = low_pass.frequency_hz
            if low_pass.damping is not None:
                constants[f"LOW_PASS_{number}_DAMPING"] = low_pass.damping
        for number, factor in enumerate(self.factors, 1):
            for role, corners in (("ZERO", factor.zeros), ("POLE", factor.poles)):
                for place, corner in enumerate(corners, 1):
                    name = f"FACTOR_{number}_{role}_{place}"
                    constants[f"{name}_HZ"] = corner.frequency_hz
                    if corner.damping is not None:
                        constants[f"{name}_DAMPING"] = corner.damping
        return {name: float(f"{value:.13g}") for name, value in constants.items()}

    def to_dict(self) -> dict[str, Any]:
        """All fields with the words of `structure`, as numbers, words and lists for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return {"structure": self.structure, **plain}

    def rows(self) -> list[tuple[str, str]]:
        """Name and values of each factor in plain ASCII, for a terminal, a table or a comment."""
        rows = []
        if self.pid is not None:
            values = [f"Kp = {self.pid.kp:.5g} {self.gain_unit}".rstrip()]
            for name, seconds in (("Ti", self.pid.ti_s), ("Td", self.pid.td_s), ("Tf", self.pid.tf_s)):
                if seconds is not None:
                    values.append(f"{name} = {seconds:.5g} s")
            td_s, tf_s = self.pid.td_s, self.pid.tf_s
            if td_s is not None and tf_s and td_s <= DERIVATIVE_RATIOS[0] * tf_s * _AT_LIMIT:
                values.append(f"Td/Tf at the least of a free one, {DERIVATIVE_RATIOS[0]:g}")
            rows.append((self.pid.structure.upper(), ", ".join(values)))
        else:
            integral = {0: "", 1: " over s"}.get(self.integrators, f" over s^{self.integrators}")
            gain = f"{self.gain:.5g} {self.gain_unit}".rstrip()
            rows.append(("gain", f"{gain}{integral}"))
        for notch in self.notches:
            middle = f"{notch.frequency_hz:.5g} Hz, {notch.depth_db:.4g} dB deep"
            least = ""
            if notch.damping <= NOTCH_DAMPING[0] * _AT_LIMIT:
                least = ", the least of a free one"
            width = f"{notch.width_hz:.4g} Hz wide (damping {notch.damping:.4g}{least})"
            rows.append(("notch", f"{middle}, {width}"))
        for low_pass in self.low_passes:
            words = f"{low_pass.frequency_hz:.5g} Hz, order {low_pass.order}"
            if low_pass.damping is not None:
                words += f", damping {low_pass.damping:.4g}"
            rows.append(("low-pass", words))
        for factor in self.factors:
            parts = []
            if factor.zeros:
                parts.append(f"zeros {_corner_words(factor.zeros)}")
            if factor.poles:
                parts.append(f"poles {_corner_words(factor.poles)}")
            words = "; ".join(parts)
            if factor.depth_db is not None and factor.depth_db >= 0:
                words += f"; {factor.depth_db:.4g} dB deep at the zeros"
            elif factor.depth_db is not None:
                words += f"; {-factor.depth_db:.4g} dB high at the zeros"
            rows.append((factor.kind, words))
        return rows


def _corner_words(corners: Sequence[CornerNumbers]) -> str:
    """Corners with their damping ratios, in Hz, for `ControllerNumbers.rows`."""
    words = []
    for corner in corners:
        if corner.damping is None and corner.frequency_hz < 0:
            words.append(f"{-corner.frequency_hz:.5g} Hz (right half plane)")
        elif corner.damping is None:
            words.append(f"{corner.frequency_hz:.5g} Hz")
        else:
            words.append(f"{corner.frequency_hz:.5g} Hz (damping {corner.damping:.4g})")
    return ", ".join(words)


class _Roots(NamedTuple):
    """Roots in t = s dt/2: real ones (t + r) as r, pairs (t^2 + a t + b) as rows (a, b)."""

    real: Real
    pairs: Real

    @classmethod
    def of(cls, roots: Complex) -> _Roots:
        """Of roots (n,) that come in conjugates."""
        is_pair = np.abs(roots.imag) > _COMPLEX * np.abs(roots)
        upper = roots[is_pair & (roots.imag > 0)]
        pairs = np.column_stack([-2.0 * upper.real, np.abs(upper) ** 2])
        return cls(-roots[~is_pair].real, pairs)

    @property
    def number(self) -> int:
        """Number of roots."""
        return self.real.size + 2 * len(self.pairs)


def engineers_numbers(controller: Law) -> ControllerNumbers | None:
    """Engineer's numbers of a controller of one error and one command.

    Parameters
    ----------
    controller : Law
        A controller of any order; its limits, delay and feed-forward do not count.

    Returns
    -------
    ControllerNumbers or None
        None for several loops, a gain of zero, a pole at z = -1 (which the Tustin plane does not hold), or
        roots so close together that rounding hides them: the record would not reproduce the controller within
        `LARGEST_ERROR`.

    Notes
    -----
    With t = s dt/2, K = gain prod(t + zeros)/(t^i prod(t + poles)); zeros at z = -1 are at infinity.
    """
    if controller.D.size != 1:
        return None
    roots = _roots_of(controller)
    if roots is None:
        return None
    zeros, poles, integrators = roots

    # Where the two are compared: around all corners, up to 90 % of Nyquist.
    sizes = np.concatenate(
        [np.abs(zeros.real), np.sqrt(zeros.pairs[:, 1]), np.abs(poles.real), np.sqrt(poles.pairs[:, 1])]
    )
    sizes = sizes[sizes > 0]
    lowest = max(float(np.min(sizes, initial=1e-2)) / _BEYOND, _LOWEST)
    highest = min(float(np.max(sizes, initial=1.0)) * _BEYOND, _HIGHEST)
    v = np.geomspace(min(lowest, highest / _BEYOND), highest, _POINTS)
    omega = 2.0 / controller.dt_s * np.arctan(v)
    try:
        # As a law: without the delay that a controller adds to its response.
        wanted = Law.response(controller, omega)
    except np.linalg.LinAlgError:
        return None
    if not np.all(np.isfinite(wanted)) or not np.all(np.abs(wanted) > 0):
        return None

    gain, zeros, poles = _sharpened(
        np.asarray(1j * v, dtype=np.complex128), wanted, zeros, poles, integrators
    )
    found = _put_together(controller.dt_s, gain, zeros, poles, integrators)
    error = float(np.max(np.abs(found.response(omega) / wanted - 1.0)))
    if not error <= LARGEST_ERROR:
        return None
    values = {name: getattr(found, name) for name in ("dt_s", "pid", "gain", "integrators", "notches")}
    return ControllerNumbers(
        **values,
        low_passes=found.low_passes,
        factors=found.factors,
        response_error=error,
        # Laws without machine signals, as multivariable ones, state no unit.
        gain_unit=getattr(controller, "gain_unit", ""),
    )


def _roots_of(controller: Law) -> tuple[_Roots, _Roots, int] | None:
    """Zeros, poles but for the integrators, and number of integrators, in t; None where there is no such
    factorisation (see `engineers_numbers`)."""
    from scipy.linalg import eigvals

    poles_z = controller.poles
    n = controller.order
    if np.any(np.abs(poles_z + 1.0) < 1.0 / _INFINITE):
        return None
    # Zeros make the pencil [A - z I, B; C, D] singular; its infinite eigenvalues are no zeros.
    pencil = np.block([[controller.A, controller.B], [controller.C, controller.D]])
    identity = np.zeros_like(pencil)
    identity[:n, :n] = np.eye(n)
    zeros_z = np.asarray(eigvals(pencil, identity), dtype=np.complex128) if n else np.zeros(0, complex)
    zeros_z = zeros_z[np.isfinite(zeros_z)]
    with np.errstate(divide="ignore", invalid="ignore"):
        zeros_t = (zeros_z - 1.0) / (zeros_z + 1.0)
    zeros_t = zeros_t[np.abs(zeros_t) < _INFINITE]

    integrators = count_integrators(poles_z)
    poles_t = (poles_z - 1.0) / (poles_z + 1.0)
    poles_t = poles_t[np.argsort(np.abs(poles_t))][integrators:]
    return _Roots.of(zeros_t), _Roots.of(poles_t), integrators


def _sharpened(
    t: Complex, wanted: Complex, zeros: _Roots, poles: _Roots, integrators: int
) -> tuple[float, _Roots, _Roots]:
    """Gain, zeros and poles with which gain prod(t + zeros)/(t^i prod(t + poles)) is the wanted response.

    t, wanted (F,): j v and K there. Gauss-Newton on log K, whose slope in a real root r is 1/(t + r), in a
    pair t/q and 1/q. A step that does not bring the two nearer is not taken.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        quotient = wanted / _product(t, 1.0, zeros, poles, integrators)
        gain = float(np.real(np.mean(quotient[np.isfinite(quotient)])))
        best = _mismatch(t, wanted, gain, zeros, poles, integrators)
        for _ in range(_SHARPENINGS):
            residual = wanted / _product(t, gain, zeros, poles, integrators) - 1.0
            columns = [np.ones_like(t)]
            scales = [1.0]
            for roots, sign in ((zeros, 1.0), (poles, -1.0)):
                for r in roots.real:
                    columns.append(sign * r / (t + r))
                    scales.append(r)
                for a, b in roots.pairs:
                    q = t**2 + a * t + b
                    columns += [sign * np.sqrt(b) * t / q, sign * b / q]
                    scales += [np.sqrt(b), b]
            matrix = np.column_stack(columns)
            rows = np.concatenate([matrix.real, matrix.imag])
            right = np.concatenate([residual.real, residual.imag])
            if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(right))):
                break
            step = np.linalg.lstsq(rows, right, rcond=1e-13)[0] * np.array(scales)
            new_gain = gain * (1.0 + float(step[0]))
            new_zeros = _moved(zeros, step[1 : 1 + zeros.number])
            new_poles = _moved(poles, step[1 + zeros.number :])
            mismatch = _mismatch(t, wanted, new_gain, new_zeros, new_poles, integrators)
            if not mismatch < best:
                break
            gain, zeros, poles, best = new_gain, new_zeros, new_poles, mismatch
    return gain, zeros, poles


def _moved(roots: _Roots, step: Real) -> _Roots:
    """Roots after a step (count,): of the real ones, then of (a, b) of each pair."""
    n_real = roots.real.size
    return _Roots(roots.real + step[:n_real], roots.pairs + step[n_real:].reshape(-1, 2))


def _product(t: Complex, gain: float, zeros: _Roots, poles: _Roots, integrators: int) -> Complex:
    """gain prod(t + zeros)/(t^i prod(t + poles)) at t (F,)."""
    value = gain / t**integrators
    for r in zeros.real:
        value = value * (t + r)
    for a, b in zeros.pairs:
        value = value * (t**2 + a * t + b)
    for r in poles.real:
        value = value / (t + r)
    for a, b in poles.pairs:
        value = value / (t**2 + a * t + b)
    return np.asarray(value)


def _mismatch(
    t: Complex, wanted: Complex, gain: float, zeros: _Roots, poles: _Roots, integrators: int
) -> float:
    """Largest relative difference of `_product` to the wanted response (F,); inf where one is not finite."""
    largest = float(np.max(np.abs(_product(t, gain, zeros, poles, integrators) / wanted - 1.0)))
    return largest if np.isfinite(largest) else np.inf


def _put_together(
    dt_s: float, gain: float, zeros: _Roots, poles: _Roots, integrators: int
) -> ControllerNumbers:
    """Record of the factors: notches first, then what is left as PID and low-passes, else as leads and lags.

    gain: of `_product`. Nothing is approximated.
    """
    # Static gain of the rest, lim t^i K, to which every factor but the PID contributes 1.
    static = gain
    static *= float(np.prod(zeros.real)) * float(np.prod(zeros.pairs[:, 1]))
    static /= float(np.prod(poles.real)) * float(np.prod(poles.pairs[:, 1]))

    zero_pairs = [(float(a), float(b)) for a, b in zeros.pairs]
    pole_pairs = [(float(a), float(b)) for a, b in poles.pairs]
    notches: list[NotchNumbers] = []
    factors: list[FactorNumbers] = []

    # Notches: zeros and poles at one frequency.
    for zero in sorted(zero_pairs, key=lambda pair: pair[1]):
        pole = _nearest(zero, pole_pairs, 1.0 + _SAME_FREQUENCY)
        if pole is not None and 0 < zero[0] <= pole[0] * (1.0 + _SAME_FREQUENCY):
            notches.append(_notch(zero, pole, dt_s))
            zero_pairs.remove(zero)
            pole_pairs.remove(pole)

    # What is left is a PID, or would be one without its notches of different frequencies.
    real_zeros = sorted((float(r) for r in zeros.real), key=abs)
    real_poles = sorted((float(r) for r in poles.real), key=abs)
    pid = _pid(static, real_zeros, zero_pairs, real_poles, pole_pairs, integrators, dt_s)
    if pid is None:
        for zero in sorted(zero_pairs, key=lambda pair: pair[1]):
            pole = _nearest(zero, pole_pairs, _NEAR)
            if pole is not None:
                factors.append(_pair_over_pair(zero, pole, dt_s))
                zero_pairs.remove(zero)
                pole_pairs.remove(pole)
        pid = _pid(static, real_zeros, zero_pairs, real_poles, pole_pairs, integrators, dt_s)
    if pid is not None:
        # The filter of the derivative is the slowest real pole; the others are low-passes.
        real_zeros = []
        zero_pairs = []
        if pid.tf_s:
            real_poles = real_poles[1:]

    # What zeros are left stand over the poles that are nearest.
    for zero in zero_pairs:
        over: list[CornerNumbers] = []
        if pole_pairs:
            over.append(_corner_of_pair(pole_pairs.pop(0), dt_s))
        else:
            over = [CornerNumbers(_hertz(r, dt_s)) for r in real_poles[:2]]
            real_poles = real_poles[2:]
        factors.append(FactorNumbers("zeros and poles", (_corner_of_pair(zero, dt_s),), tuple(over)))
    while real_zeros:
        if not real_poles:
            # Two real zeros stand over a pair of poles.
            over = [_corner_of_pair(pole, dt_s) for pole in pole_pairs[:1]]
            top = tuple(CornerNumbers(_hertz(r, dt_s)) for r in real_zeros[:2])
            factors.append(FactorNumbers("zeros and poles", top, tuple(over)))
            pole_pairs = pole_pairs[1:]
            real_zeros = real_zeros[2:]
            continue
        r = real_zeros.pop(0)
        zero_size = abs(r)
        nearest = min(real_poles, key=lambda pole: abs(np.log(abs(pole) / zero_size)))
        real_poles.remove(nearest)
        kind = "lead" if r < nearest else "lag"
        if r < 0 or nearest < 0:
            kind = "zeros and poles"
        bottom = CornerNumbers(_hertz(nearest, dt_s))
        factors.append(FactorNumbers(kind, (CornerNumbers(_hertz(r, dt_s)),), (bottom,)))

    # Poles without zeros.
    low_passes: list[LowPassNumbers] = []
    for r in real_poles:
        if r > 0:
            low_passes.append(LowPassNumbers(_hertz(r, dt_s), 1))
        else:
            factors.append(FactorNumbers("zeros and poles", (), (CornerNumbers(_hertz(r, dt_s)),)))
    for pole in pole_pairs:
        corner = _corner_of_pair(pole, dt_s)
        if pole[0] > 0:
            low_passes.append(LowPassNumbers(corner.frequency_hz, 2, corner.damping))
        else:
            factors.append(FactorNumbers("zeros and poles", (), (corner,)))
    return ControllerNumbers(
        dt_s=dt_s,
        pid=pid,
        gain=static * (2.0 / dt_s) ** integrators if pid is None else pid.kp,
        integrators=integrators,
        notches=tuple(sorted(notches, key=lambda notch: notch.frequency_hz)),
        low_passes=tuple(sorted(low_passes, key=lambda low_pass: low_pass.frequency_hz)),
        factors=tuple(
            sorted(factors, key=lambda factor: abs((*factor.zeros, *factor.poles)[0].frequency_hz))
        ),
    )


def _pid(
    static: float,
    real_zeros: Sequence[float],
    zero_pairs: Sequence[tuple[float, float]],
    real_poles: Sequence[float],
    pole_pairs: Sequence[tuple[float, float]],
    integrators: int,
    dt_s: float,
) -> PidNumbers | None:
    """The PID whose zeros are these, with the slowest real pole as its filter; None where there is none.

    static: lim t^i K. With 1 + c1 t + c2 t^2 the zeros' polynomial and s = 2 t/dt,

        pid  Kp/Ti = static 2/dt,   Kp (1 + Tf/Ti) = static c1,   Kp (Tf + Td) = static c2 dt/2

    and likewise for what is left of it. Times have to be positive (Tf may be 0).
    """
    polynomial: Real = np.ones(1)
    for r in real_zeros:
        polynomial = np.asarray(np.polymul([1.0 / r, 1.0], polynomial), dtype=np.float64)
    for a, b in zero_pairs:
        polynomial = np.asarray(np.polymul([1.0 / b, a / b, 1.0], polynomial), dtype=np.float64)
    n_zeros = polynomial.size - 1
    if integrators > 1 or n_zeros > integrators + 1:
        return None
    half = dt_s / 2.0
    c1 = float(polynomial[-2]) if n_zeros >= 1 else 0.0
    has_derivative = n_zeros == integrators + 1
    tf_s = 0.0
    if has_derivative and real_poles:
        tf_s = half / real_poles[0]
        if tf_s < 0:
            return None
    elif has_derivative and not pole_pairs:
        return None
    if not integrators:
        if not has_derivative:
            return PidNumbers("p", static)
        td_s = c1 * half - tf_s
        return PidNumbers("pd", static, td_s=td_s, tf_s=tf_s) if td_s > 0 else None
    # Without zeros it is an I, which has no Kp.
    if n_zeros == 0:
        return None
    kp = static * c1
    if has_derivative:
        kp = static * (c1 - tf_s / half)
    if not kp * static > 0:
        return None
    ti_s = kp / static * half
    if not has_derivative:
        return PidNumbers("pi", kp, ti_s=ti_s)
    c2 = float(polynomial[0])
    td_s = static * c2 * half / kp - tf_s
    return PidNumbers("pid", kp, ti_s=ti_s, td_s=td_s, tf_s=tf_s) if td_s > 0 else None


def _nearest(
    zero: tuple[float, float], pole_pairs: Sequence[tuple[float, float]], ratio: float
) -> tuple[float, float] | None:
    """The pair of poles whose frequency is nearest to that of a pair of zeros, (a, b) each, within a ratio;
    None where there is none."""
    near = []
    for pole in pole_pairs:
        if max(zero[1], pole[1]) <= ratio**2 * min(zero[1], pole[1]):
            near.append(pole)
    return min(near, key=lambda pair: abs(np.log(pair[1] / zero[1])), default=None)


def _notch(zero: tuple[float, float], pole: tuple[float, float], dt_s: float) -> NotchNumbers:
    """Notch of a pair of zeros and one of poles, (a, b) each, at one frequency."""
    corner = float(np.sqrt(pole[1]))
    damping = pole[0] / (2.0 * corner)
    return NotchNumbers(
        frequency_hz=frequency_of_corner(corner, dt_s),
        depth_db=20.0 * float(np.log10(pole[0] / max(zero[0], _TINY))),
        width_hz=width_of_damping(damping, corner, dt_s),
        damping=damping,
    )


def _pair_over_pair(zero: tuple[float, float], pole: tuple[float, float], dt_s: float) -> FactorNumbers:
    """Pair of zeros over a pair of poles, (a, b) each, of static gain 1, with its depth at the zeros."""
    t = 1j * np.sqrt(zero[1])
    gain = abs((t**2 + zero[0] * t + zero[1]) / (t**2 + pole[0] * t + pole[1])) * pole[1] / zero[1]
    depth_db = -20.0 * float(np.log10(max(gain, _TINY)))
    return FactorNumbers(
        kind="notch" if depth_db >= 0 else "resonance",
        zeros=(_corner_of_pair(zero, dt_s),),
        poles=(_corner_of_pair(pole, dt_s),),
        depth_db=depth_db,
    )


def _corner_of_pair(pair: tuple[float, float], dt_s: float) -> CornerNumbers:
    """Corner and damping ratio of t^2 + a t + b, b positive."""
    corner = float(np.sqrt(pair[1]))
    return CornerNumbers(frequency_of_corner(corner, dt_s), pair[0] / (2.0 * corner))


def _hertz(r: float, dt_s: float) -> float:
    """Corner in Hz of a real root t = -r; negative of a root in the right half plane."""
    return frequency_of_corner(r, dt_s)
