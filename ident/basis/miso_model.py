"""A GOBF model with several inputs and one output: one set of poles, one row of coefficients per input."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from ident.basis.functions import basis_state_space
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray, lock


@dataclass(frozen=True, eq=False)
class MisoModel:
    """y = sum_i G_i u_i, every G_i a `GobfModel` with the same poles, integrators and delay.

    poles : Poles
    coefficients : (U, B) array. Row i belongs to input i.
    feedthrough : (U,) array
    dt_s : float. Sampling time in seconds.
    input_names : tuple of str. U distinct names.
    output_name : str
    integrators, input_delay_samples : int

    Raises ValueError if the shapes do not fit, names repeat, a number is not finite or dt_s is not positive.
    """

    poles: Poles
    coefficients: RealArray
    feedthrough: RealArray
    dt_s: float
    input_names: tuple[str, ...]
    output_name: str = "y"
    integrators: int = 0
    input_delay_samples: int = 0

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

        The transposed cascade: the channels c_i (zI - A)^-1 B + d_i of one lossless cascade share B, so
        B^T (zI - A^T)^-1 [c_1^T ... c_U^T] + d is all of them on n states instead of U n. Integrators and
        delay, common as well, act on the output. Each integrator takes the place of a pole at z = 0 if the
        first ones are there (`identify_miso` puts them there), so that the zero of z/(z - 1) cancels nothing
        and the realisation stays minimal; else it has a state of its own.
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
        return A, B, C, D

    def to_control(self) -> Any:
        """The same model as a `control.StateSpace` with dt = dt_s, U inputs and one output."""
        import control

        return control.ss(
            *self.state_space(),
            self.dt_s,
            inputs=list(self.input_names),
            outputs=[self.output_name],
            remove_useless_states=False,
        )
