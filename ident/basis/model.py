"""A GOBF model: poles, coefficients and the fixed structure around them; with one input or several."""

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
from ident.data.shown import Shown

# Each is a state; a file that says more is damaged, and would fill the memory.
_MOST_STAGES = 1000


@dataclass(frozen=True, eq=False, repr=False)
class GobfModel(Shown):
    """G(z) = [sum_i c_i L_i(z) + feedthrough] (z/(z-1))^integrators z^-input_delay_samples, paper (3) and
    (5).

    coefficients (B,): one per basis function, real poles first, then two per pair. unstable: mirror images 1
    / conj(p) of poles p outside the circle, each among the poles: G is the above divided by their all-pass
    B(z). Raises ValueError if the shapes do not fit, a number is not finite or dt_s is not positive.

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
        if not all(0 <= n <= _MOST_STAGES for n in (self.integrators, self.input_delay_samples)):
            raise ValueError(
                f"integrators and input_delay_samples must not be negative, nor above {_MOST_STAGES}; "
                f"got {self.integrators} and {self.input_delay_samples}"
            )
        self.poles.without(self.unstable)

    @property
    def order(self) -> int:
        """Number of basis functions (integrators and delay not counted)."""
        return self.poles.order

    @property
    def stable_poles(self) -> Poles:
        """Poles of G inside the circle."""
        return self.poles.without(self.unstable)

    @property
    def stable_part(self) -> GobfModel:
        """B G, without the unstable poles."""
        return replace(self, unstable=NO_POLES)

    @property
    def unstable_poles(self) -> ComplexArray:
        """Poles of G outside the circle, (n,)."""
        return np.asarray(1 / self.unstable.values.conj())

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """omega (F,) in rad/s, |omega| <= pi/dt (and not 0 with integrators) -> G (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        if omega.ndim != 1 or not np.all(np.abs(omega) <= np.pi / self.dt_s * (1 + 1e-12)):
            raise ValueError(f"omega_rad_s must be (F,) and stop at pi/dt = {np.pi / self.dt_s:.6g} rad/s")
        if self.integrators and not np.all(omega != 0):
            raise ValueError("a model with integrators has no finite response at omega = 0")
        z = np.exp(1j * omega * self.dt_s)
        inner = basis_response(self.poles, z) @ self.coefficients + self.feedthrough
        # 1 - 1/z without cancellation at low frequency: 2j sin(w dt/2) exp(-j w dt/2).
        half = omega * self.dt_s / 2
        difference = 2j * np.sin(half) * np.exp(-1j * half)
        inner = inner / all_pass_response(self.unstable, z)
        return np.asarray(
            inner * difference ** (-self.integrators) * z ** (-self.input_delay_samples), dtype=np.complex128
        )

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """(A, B, C, D) of the cascade delay -> integrators -> lossless basis; (n, n), (n, 1), (1, n), (1, 1).
        Polynomials would lose models of order 12."""
        # Front end as scalar stages in series; the state vector is [delay line, integrators, basis].
        delay, k, n = self.input_delay_samples, self.integrators, self.order
        size = delay + k + n
        A, B = np.zeros((size, size)), np.zeros((size, 1))
        # signal_c x + signal_d u is the signal that leaves the stages built so far.
        signal_c, signal_d = np.zeros((1, size)), np.ones((1, 1))
        for i in range(delay):
            A[i], B[i] = signal_c, signal_d
            signal_c, signal_d = np.zeros((1, size)), np.zeros((1, 1))
            signal_c[0, i] = 1.0
        for i in range(delay, delay + k):
            # w = s + v, s(k+1) = s + v: the sum that includes the present sample, z/(z - 1).
            signal_c = signal_c.copy()
            signal_c[0, i] = 1.0
            A[i], B[i] = signal_c, signal_d
        basis = basis_state_space(self.poles)
        here = slice(delay + k, size)
        A[here] += basis.B @ signal_c
        A[here, here] += basis.A
        B[here] = basis.B @ signal_d
        C = self.feedthrough * signal_c
        C[0, here] += self.coefficients
        return _unmirrored(A, B, C, self.feedthrough * signal_d, self.unstable)

    def zeros(self) -> ComplexArray:
        """Finite zeros (Z,) of the basis part, by magnitude, from the system pencil; those of delay and
        integrators are at 0 and left out, as are those beyond 1e4, which are at infinity but for rounding."""
        basis = basis_state_space(self.poles)
        n = self.order
        pencil = np.block(
            [[basis.A, basis.B], [self.coefficients[None, :], np.full((1, 1), self.feedthrough)]]
        )
        unit = np.diag(np.concatenate([np.ones(n), np.zeros(1)]))
        alpha, beta = scipy.linalg.eigvals(pencil, unit, homogeneous_eigvals=True)
        finite = np.abs(alpha) <= 1e4 * np.abs(beta)
        values = np.asarray(alpha[finite] / beta[finite], dtype=np.complex128)
        return values[np.argsort(np.abs(values), kind="stable")]

    def to_control(self) -> Any:
        """The same model as a `control.StateSpace` with dt = dt_s."""
        return _as_control(self, [self.input_name])

    def save(self, path: str | Path) -> None:
        """Write poles, coefficients and state space to a .json or .mat file, as `identify --export` does."""
        self.front.shown.save(self, Path(path))

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the input u (T,) or (T, 1), from rest. Raises ValueError for an unstable model."""
        refuse_unstable(self.unstable)
        filtered = filter_input(u, self.integrators, self.input_delay_samples)
        return np.asarray(regressor(self.poles, filtered) @ self.coefficients + self.feedthrough * filtered)


@dataclass(frozen=True, eq=False)
class MisoModel:
    """y = sum_i G_i u_i, every G_i a `GobfModel` with the same poles, integrators and delay.

    coefficients (U, B), feedthrough (U,): row i belongs to input i. Raises ValueError as `GobfModel`, or if
    names repeat.
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
        for i in range(n_inputs):
            self.channel(i)  # the remaining checks are those of its channels

    @property
    def n_inputs(self) -> int:
        return len(self.input_names)

    @property
    def order(self) -> int:
        """Number of poles, those at z = 0 that stand for integrators counted."""
        return self.poles.order

    def channel(self, index: int) -> GobfModel:
        """The model from input `index` (0 .. U - 1) to the output."""
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
        """omega (F,) in rad/s, |omega| <= pi/dt (and not 0 with integrators) -> G (F, U)."""
        channels = [self.channel(i).frequency_response(omega_rad_s) for i in range(self.n_inputs)]
        return np.stack(channels, axis=1)

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the inputs u (T, U), from rest."""
        signals = np.asarray(u, dtype=np.float64)
        if signals.ndim != 2 or signals.shape[1] != self.n_inputs:
            raise ValueError(f"u must be (T, {self.n_inputs}); got shape {signals.shape}")
        outputs = [self.channel(i).simulate(signals[:, i]) for i in range(self.n_inputs)]
        return np.asarray(np.sum(outputs, axis=0))

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """(A, B, C, D) with the shared poles realised once; (n, n), (n, U), (1, n), (1, U).

        The transposed cascade: the channels c_i (zI - A)^-1 B + d_i share B, so that B^T (zI - A^T)^-1 [c_1^T
        ... c_U^T] + d is all of them. An integrator takes the place of a pole at z = 0 if the first ones are
        there, else it has a state of its own.
        """
        basis = basis_state_space(self.poles)
        A, C = np.array(basis.A.T), np.array(basis.B.T)
        B, D = np.array(self.coefficients.T), self.feedthrough[None, :].copy()
        k = self.integrators
        if k and self.poles.real.size >= k and np.all(self.poles.real[:k] == 0):
            # The first k states are then the delay line z^-1 .. z^-k at the end of the chain, and (z/(z-1))^k
            # turns z^-j into sum_m binom(k - j, k - m) (z - 1)^-m: sums instead of delays.
            direct_and_delayed = np.vstack([D, B[:k]])
            for m in range(1, k + 1):
                A[m - 1, m - 1] = 1.0
                B[m - 1] = sum(comb(k - j, k - m) * direct_and_delayed[j] for j in range(m + 1))
        else:
            for _ in range(k):
                # s(k+1) = s + w, out = s + w: the sum that includes the present sample.
                A = np.block([[A, np.zeros((A.shape[0], 1))], [C, np.ones((1, 1))]])
                B, C = np.vstack([B, D]), np.hstack([C, np.ones((1, 1))])
        for _ in range(self.input_delay_samples):
            A = np.block([[A, np.zeros((A.shape[0], 1))], [C, np.zeros((1, 1))]])
            B, C = np.vstack([B, D]), np.hstack([np.zeros_like(C), np.ones((1, 1))])
            D = np.zeros_like(D)
        return _unmirrored(A, B, C, D, self.unstable)

    def to_control(self) -> Any:
        """The same model as a `control.StateSpace` with dt = dt_s, U inputs and one output."""
        return _as_control(self, list(self.input_names))


def refuse_unstable(unstable: Poles) -> None:
    """Raises ValueError where there are unstable poles."""
    if unstable.order:
        raise ValueError("an unstable model has no free run: simulate it in a loop (to_control)")


def _unmirrored(
    A: RealArray, B: RealArray, C: RealArray, D: RealArray, unstable: Poles
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """The state space behind 1/B of the all-pass, its states orthogonal to the eigenvectors of the mirrored
    poles."""
    for block in unstable.blocks():
        a, b, c, d = inverse_all_pass(block)
        A = np.block([[A, np.zeros((len(A), block.order))], [b @ C, a]])
        B, C, D = np.vstack([B, b @ D]), np.hstack([d @ C, c]), d @ D
        first = A - block.values[0] * np.eye(len(A))
        mirrored = first.real if block.real.size else (first @ first.conj()).real
        kept = np.linalg.svd(mirrored)[2][: len(A) - block.order]
        A, B, C = kept @ A @ kept.T, kept @ B, C @ kept.T
    return A, B, C, D


def _as_control(model: GobfModel | MisoModel, inputs: list[str]) -> Any:
    import control  # here: it brings its plotting along

    names: dict[str, Any] = {"inputs": inputs, "outputs": [model.output_name]}
    return control.ss(*model.state_space(), model.dt_s, **names, remove_useless_states=False)
