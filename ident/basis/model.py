"""A model of one output in the basis of given poles: `GobfModel` with one input, `MisoModel` with several.

The transfer function is a sum of generalised orthonormal basis functions (Ziaei and Wang, 2006, (3) and (5)),
which fixes the poles and leaves one coefficient per basis function to a fit. Integrators and a delay of whole
samples are exact factors in front of it. A plant with unstable poles is written as a stable model over the
all-pass of these poles, so that the coefficients still belong to a stable basis. Each model answers with its
frequency response, its state space and its output; a `MisoModel` is answered channel by channel, but realised
with the common poles once. The models are the results of a fit: nothing in this file reads data.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

from ident.basis.functions import (
    all_pass_response,
    basis_response,
    basis_state_space,
    inverse_all_pass,
    regressor,
)
from ident.basis.poles import NO_POLES, Poles
from ident.basis.structure import filter_input
from ident.data.arrays import ComplexArray, RealArray, lock
from ident.data.keywords import clear_constructor, refuse_rate
from ident.data.shown import Shown, front_door

# Most integrators, and most samples of delay, that a model may have. Each is a state, so a damaged file that
# says 10^9 would fill the memory. Arms have at most 3 integrators and tens of samples; 2000 would do as well.
_MOST_STAGES = 1000
# How far above the Nyquist frequency, as a share of it, a frequency may lie: the rounding of a caller who
# computed pi / dt himself, which is 1e-16, with room for a few operations.
_NYQUIST_ROUNDING = 1e-12
# Largest modulus of a finite zero. A strictly proper model has zeros at infinity, which the pencil returns as
# numbers near the inverse of rounding, 1e15. Zeros that sampling brings are far below: 51 at relative degree
# 6 (Astrom, Hagander and Sternby, Automatica 20(1), 1984). Ten times more or less moves no zero of either.
_LARGEST_ZERO = 1e4


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class GobfModel(Shown):
    r"""A linear model of one input and one output on generalised orthonormal basis functions (GOBF).

    Parameters
    ----------
    poles : Poles
        Of the B basis functions, inside the unit circle.
    coefficients : (B,) array
        One per basis function, real poles first, then two per pair; output units per input unit.
    dt_s : float
        Sampling period in seconds, positive.
    feedthrough : float
        Direct term, output units per input unit.
    integrators : int
        Poles at z = 1.
    input_delay_samples : int
        Dead time.
    input_name, output_name : str
        Columns of the records.
    unstable : Poles
        Mirror images 1 / conj(p) of poles p outside the circle, each among `poles`.

    Raises
    ------
    ValueError
        If the shapes do not fit, a number is not finite or dt_s is not positive.

    Notes
    -----
    With basis functions L_i, integrators n and dead time d

    .. math::

        G(z) = \Bigl[\sum_i c_i L_i(z) + c_0\Bigr] \Bigl(\frac{z}{z - 1}\Bigr)^{n} z^{-d},

    divided by the all-pass of `unstable` where there are any (Ziaei and Wang 2006, (3) and (5)).

    Examples
    --------
    >>> poles = flexlink.Poles.from_continuous(omega_rad_s=[20.0], zeta=[0.05], dt_s=0.01)
    >>> flexlink.GobfModel(poles, [0.1, 0.2], dt_s=0.01)
    GobfModel of order 2, u -> y, dt = 0.01 s
      mode at 20 rad/s (3.18 Hz), damping ratio 0.05
    """

    table_in_notebook = True

    poles: Poles
    coefficients: RealArray
    dt_s: float
    feedthrough: float = 0.0
    integrators: int = 0
    input_delay_samples: int = 0
    input_name: str = "u"
    output_name: str = "y"
    unstable: Poles = field(default=NO_POLES, metadata={"since": 2})

    def __post_init__(self) -> None:
        """Lock the coefficients and check all fields. Raises ValueError as the class says."""
        lock(self, "coefficients")
        if self.coefficients.shape != (self.poles.order,):
            raise ValueError(
                f"need one coefficient per basis function, shape ({self.poles.order},); got "
                f"{self.coefficients.shape}"
            )
        if not (np.all(np.isfinite(self.coefficients)) and np.isfinite(self.feedthrough)):
            raise ValueError("the coefficients and the direct term must be finite")
        if not (np.isfinite(self.dt_s) and self.dt_s > 0):
            raise ValueError(f"dt_s must be positive; got {self.dt_s}")
        refuse_rate(self.dt_s)
        stage_counts = (self.integrators, self.input_delay_samples)
        if not all(0 <= count <= _MOST_STAGES for count in stage_counts):
            raise ValueError(
                f"integrators and input_delay_samples must not be negative, nor above {_MOST_STAGES}; "
                f"got {self.integrators} and {self.input_delay_samples}"
            )
        # Raises ValueError where a mirror image is not among the poles.
        self.poles.without(self.unstable)

    @property
    def order(self) -> int:
        """Number of basis functions B (integrators and delay not counted)."""
        return self.poles.order

    @property
    def stable_poles(self) -> Poles:
        """Poles of G inside the circle: the basis without the mirror images of the unstable ones."""
        return self.poles.without(self.unstable)

    @property
    def stable_part(self) -> GobfModel:
        """Stable model B G: G times the all-pass of its unstable poles; equal to G where it has none."""
        return replace(self, unstable=NO_POLES)

    @property
    def unstable_poles(self) -> ComplexArray:
        """Poles of G outside the circle, (n,), both of each pair; (0,) for a stable model.

        Infinite for a mirror image at zero, which `IdentOptions` cannot state and nothing here refuses.
        """
        return np.asarray(1 / self.unstable.values.conj())

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Frequency response G(exp(j omega dt)).

        Parameters
        ----------
        omega_rad_s : ndarray, shape (F,)
            Frequencies in rad/s, |omega| <= pi / dt_s, in any order.

        Returns
        -------
        ndarray of complex, shape (F,)
            Units of the output per unit of the input.

        Raises
        ------
        ValueError
            A frequency beyond pi / dt_s or NaN, another shape, or omega = 0 in a model with integrators.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        nyquist_rad_s = np.pi / self.dt_s
        if omega.ndim != 1 or not np.all(np.abs(omega) <= nyquist_rad_s * (1 + _NYQUIST_ROUNDING)):
            raise ValueError(f"omega_rad_s must be (F,) and stop at pi/dt = {nyquist_rad_s:.6g} rad/s")
        if self.integrators and not np.all(omega != 0):
            raise ValueError("a model with integrators has no finite response at omega = 0")

        z = np.exp(1j * omega * self.dt_s)
        basis_part = basis_response(self.poles, z) @ self.coefficients + self.feedthrough
        over_all_pass = basis_part / all_pass_response(self.unstable, z)

        # 1 - 1/z without cancellation at low frequency: 2j sin(w dt/2) exp(-j w dt/2).
        half_angle = omega * self.dt_s / 2
        difference = 2j * np.sin(half_angle) * np.exp(-1j * half_angle)
        integrated = over_all_pass * difference ** (-self.integrators)
        response = integrated * z ** (-self.input_delay_samples)
        return np.asarray(response, dtype=np.complex128)

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """State space (A, B, C, D) of the cascade delay -> integrators -> lossless basis.

        Returns
        -------
        A, B, C, D : ndarray, shapes (n, n), (n, 1), (1, n), (1, 1)
            n = input_delay_samples + integrators + order, in the order of the cascade. With unstable poles
            the states are mixed by an orthogonal matrix, and n stays the same. D alone without states (n =
            0). Raises TypeError for numbers of integrators or samples that are not whole, which the class
            lets pass.

        Notes
        -----
        The cascade is built as it stands. Over one polynomial each for numerator and denominator, models of
        order 12 would lose their digits.
        """
        delay = self.input_delay_samples
        n_front = delay + self.integrators
        size = n_front + self.order
        A = np.zeros((size, size))
        B = np.zeros((size, 1))

        # signal_c x + signal_d u is the signal that leaves the stages built so far; at first it is u.
        signal_c = np.zeros((1, size))
        signal_d = np.ones((1, 1))
        for i in range(delay):
            # The state holds the signal of the sample before, and is what leaves this stage.
            A[i] = signal_c
            B[i] = signal_d
            signal_c = np.zeros((1, size))
            signal_c[0, i] = 1.0
            signal_d = np.zeros((1, 1))
        for i in range(delay, n_front):
            # w = s + v, s(k+1) = s + v: the sum that includes the present sample, z/(z - 1).
            signal_c = signal_c.copy()
            signal_c[0, i] = 1.0
            A[i] = signal_c
            B[i] = signal_d

        # The basis is driven by that signal; the direct term adds a multiple of it to the output.
        basis = basis_state_space(self.poles)
        basis_states = slice(n_front, size)
        A[basis_states] += basis.B @ signal_c
        A[basis_states, basis_states] += basis.A
        B[basis_states] = basis.B @ signal_d
        C = self.feedthrough * signal_c
        C[0, basis_states] += self.coefficients
        D = self.feedthrough * signal_d
        return _unmirrored(A, B, C, D, self.unstable)

    def zeros(self) -> ComplexArray:
        """Finite zeros (Z,) of the basis part, by growing modulus.

        Returns
        -------
        ndarray of complex, shape (Z,)
            Z is at most the order. A model that is zero everywhere has NaN among them, which nothing refuses.
            Zeros of delay and integrators, which are at z = 0, are left out, as are
            those beyond a modulus of 1e4, which are at infinity but for rounding.

        Notes
        -----
        Zeros are where the system pencil [[A - z I, B], [C, D]] is singular: generalised eigenvalues, which
        need no inverse of D and no polynomial.
        """
        basis = basis_state_space(self.poles)
        output_row = self.coefficients[None, :]
        direct = np.full((1, 1), self.feedthrough)
        pencil = np.block([[basis.A, basis.B], [output_row, direct]])
        unit = np.diag(np.concatenate([np.ones(self.order), np.zeros(1)]))

        # As quotients alpha/beta, so that a zero at infinity is beta = 0 and no division by zero.
        alpha, beta = scipy.linalg.eigvals(pencil, unit, homogeneous_eigvals=True)
        is_finite = np.abs(alpha) <= _LARGEST_ZERO * np.abs(beta)
        values = np.asarray(alpha[is_finite] / beta[is_finite], dtype=np.complex128)
        return values[np.argsort(np.abs(values), kind="stable")]

    def to_control(self) -> Any:
        """This model as a `control.StateSpace` with dt = dt_s, one input and one output.

        Raises ImportError without python-control.
        """
        return _as_control(self, [self.input_name])

    def save(self, path: str | Path) -> None:
        """Write poles, coefficients and state space to a .json or .mat file, as `identify --export` does.

        Another suffix, or a path that cannot be written, is refused by the function that writes it.
        """
        front_door("shown").save(self, Path(path))

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the input u (T,) or (T, 1), from rest, in units of the output; from a NaN on NaN.

        Raises
        ------
        ValueError
            The model is unstable: its output would grow without end; or u has another shape.
        """
        refuse_unstable(self.unstable)
        filtered = filter_input(u, self.integrators, self.input_delay_samples)
        through_basis = regressor(self.poles, filtered) @ self.coefficients
        return np.asarray(through_basis + self.feedthrough * filtered)


@dataclass(frozen=True, eq=False)
class MisoModel:
    """y = sum_i G_i u_i, every G_i a `GobfModel` with the same poles, integrators and delay.

    coefficients (U, B), feedthrough (U,): row i belongs to input i, output units per unit of that input. dt_s
    in s. Raises ValueError as `GobfModel` (shapes, numbers not finite, dt_s), or if names repeat or there is
    none.
    """

    poles: Poles
    coefficients: RealArray
    feedthrough: RealArray
    dt_s: float
    input_names: tuple[str, ...]
    output_name: str = "y"
    integrators: int = 0
    input_delay_samples: int = 0
    unstable: Poles = field(default=NO_POLES, metadata={"since": 2})

    def __post_init__(self) -> None:
        """Lock the arrays and check all fields. Raises ValueError as the class says."""
        lock(self, "coefficients", "feedthrough")
        object.__setattr__(self, "input_names", tuple(self.input_names))
        n_inputs = len(self.input_names)
        if not n_inputs or len(set(self.input_names)) != n_inputs:
            raise ValueError(f"need at least one input, distinct names; got {list(self.input_names)}")
        if self.coefficients.shape != (n_inputs, self.poles.order) or self.feedthrough.shape != (n_inputs,):
            raise ValueError(
                f"need coefficients ({n_inputs}, {self.poles.order}) and feedthrough ({n_inputs},); got "
                f"{self.coefficients.shape} and {self.feedthrough.shape}"
            )
        # The remaining checks are those of its channels: each is made, and refused by `GobfModel`.
        for i in range(n_inputs):
            self.channel(i)

    @property
    def n_inputs(self) -> int:
        """Number of inputs U."""
        return len(self.input_names)

    @property
    def order(self) -> int:
        """Number of poles B, those at z = 0 that stand for integrators counted."""
        return self.poles.order

    def channel(self, index: int) -> GobfModel:
        """Model from input `index` (0 .. U - 1) to the output. Raises ValueError for another index."""
        if not 0 <= index < self.n_inputs:
            raise ValueError(f"there are inputs 0 to {self.n_inputs - 1}; got {index}")
        return GobfModel(
            poles=self.poles,
            coefficients=self.coefficients[index],
            dt_s=self.dt_s,
            feedthrough=float(self.feedthrough[index]),
            integrators=self.integrators,
            input_delay_samples=self.input_delay_samples,
            input_name=self.input_names[index],
            output_name=self.output_name,
            unstable=self.unstable,
        )

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Frequency response from every input to the output.

        Parameters
        ----------
        omega_rad_s : ndarray, shape (F,)
            Frequencies in rad/s, |omega| <= pi / dt_s, not 0 with integrators.

        Returns
        -------
        ndarray of complex, shape (F, U)
            Units of the output per unit of each input.

        Raises
        ------
        ValueError
            A frequency outside that range or NaN, or another shape.
        """
        channels = [self.channel(i).frequency_response(omega_rad_s) for i in range(self.n_inputs)]
        return np.stack(channels, axis=1)

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the inputs u (T, U), from rest, in units of the output; from a NaN on NaN.

        Raises
        ------
        ValueError
            u has another shape, or the model is unstable.
        """
        signals = np.asarray(u, dtype=np.float64)
        if signals.ndim != 2 or signals.shape[1] != self.n_inputs:
            raise ValueError(f"u must be (T, {self.n_inputs}); got shape {signals.shape}")
        outputs = [self.channel(i).simulate(signals[:, i]) for i in range(self.n_inputs)]
        return np.asarray(np.sum(outputs, axis=0))

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """State space (A, B, C, D) with the shared poles realised once.

        Returns
        -------
        A, B, C, D : ndarray, shapes (n, n), (n, U), (1, n), (1, U)
            n = order + input_delay_samples, and the integrators where they have states of their own.

        Notes
        -----
        The transposed cascade: the channels c_i (zI - A)^-1 B + d_i share B, so that B^T (zI - A^T)^-1 [c_1^T
        ... c_U^T] + d is all of them. An integrator takes the place of a pole at z = 0 if the first ones are
        there, else it has a state of its own. Each sample of delay is one more state, at the output.
        """
        basis = basis_state_space(self.poles)
        A = np.array(basis.A.T)
        B = np.array(self.coefficients.T)
        C = np.array(basis.B.T)
        D = self.feedthrough[None, :].copy()

        k = self.integrators
        zeros_come_first = self.poles.real.size >= k and np.all(self.poles.real[:k] == 0)
        if k and zeros_come_first:
            # The first k states are then the delay line z^-1 .. z^-k at the end of the chain, and (z/(z-1))^k
            # turns z^-j into sum_m binom(k - j, k - m) (z - 1)^-m: sums instead of delays.
            direct_and_delayed = np.vstack([D, B[:k]])
            for m in range(1, k + 1):
                A[m - 1, m - 1] = 1.0
                weights = [comb(k - j, k - m) for j in range(m + 1)]
                B[m - 1] = sum(weights[j] * direct_and_delayed[j] for j in range(m + 1))
        else:
            for _ in range(k):
                # s(k+1) = s + w, out = s + w: the sum that includes the present sample.
                no_feedback = np.zeros((A.shape[0], 1))
                A = np.block([[A, no_feedback], [C, np.ones((1, 1))]])
                B = np.vstack([B, D])
                C = np.hstack([C, np.ones((1, 1))])

        for _ in range(self.input_delay_samples):
            # The new state holds the output of the sample before, and is the output now.
            no_feedback = np.zeros((A.shape[0], 1))
            A = np.block([[A, no_feedback], [C, np.zeros((1, 1))]])
            B = np.vstack([B, D])
            C = np.hstack([np.zeros_like(C), np.ones((1, 1))])
            D = np.zeros_like(D)
        return _unmirrored(A, B, C, D, self.unstable)

    def to_control(self) -> Any:
        """This model as a `control.StateSpace` with dt = dt_s, U inputs and one output.

        Raises ImportError without python-control.
        """
        return _as_control(self, list(self.input_names))


def refuse_unstable(unstable: Poles) -> None:
    """Raise ValueError where `unstable`, mirror images of poles outside the circle, holds any."""
    if unstable.order:
        raise ValueError("an unstable model has no free run: simulate it in a loop (to_control)")


def _unmirrored(
    A: RealArray, B: RealArray, C: RealArray, D: RealArray, unstable: Poles
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """State space of B(z)^-1 [C (zI - A)^-1 B + D], B(z) the all-pass of the unstable poles, still (n, n).

    A (n, n), B (n, U), C (1, n), D (1, U) have the mirror images of the unstable poles among their poles.
    1/B(z) adds the unstable poles behind the output and has zeros at the mirror images, which so become
    unobservable: their eigenvectors are left out, which takes away as many states as were added. Without
    unstable poles the matrices come back as they are. That the mirror images are among the poles is checked
    by the models, not here; one at zero gives numbers that are not finite (`inverse_all_pass`).
    """
    for block in unstable.blocks():
        # The stage 1/B of one real pole or one pair, driven by the output.
        stage_a, stage_b, stage_c, stage_d = inverse_all_pass(block)
        no_feedback = np.zeros((len(A), block.order))
        A = np.block([[A, no_feedback], [stage_b @ C, stage_a]])
        B = np.vstack([B, stage_b @ D])
        C = np.hstack([stage_d @ C, stage_c])
        D = stage_d @ D

        # The null space of A - p, or of (A - p)(A - conj p), are the eigenvectors of the mirror image p; the
        # first right singular vectors are what is orthogonal to it.
        shifted = A - block.values[0] * np.eye(len(A))
        annihilator = shifted.real if block.real.size else (shifted @ shifted.conj()).real
        right_vectors = np.linalg.svd(annihilator)[2]
        observable = right_vectors[: len(A) - block.order]
        A = observable @ A @ observable.T
        B = observable @ B
        C = C @ observable.T
    return A, B, C, D


def _as_control(model: GobfModel | MisoModel, inputs: list[str]) -> Any:
    """A `control.StateSpace` of the model with these names of its inputs (U) and the name of its output.

    States that do nothing stay, so that the matrices are those of `state_space`.
    """
    # Here and not above: it brings its plotting along, which nobody else needs.
    import control

    names: dict[str, Any] = {"inputs": inputs, "outputs": [model.output_name]}
    return control.ss(*model.state_space(), model.dt_s, **names, remove_useless_states=False)
