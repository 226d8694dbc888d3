"""Dry friction, and a linear arm on given poles stepped between the samples with it at its shaft."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import expm

from ident.basis.functions import all_pass_response, basis_response
from ident.basis.poles import Poles
from ident.basis.structure import Structure, filter_input, front_response
from ident.data.arrays import BoolArray, ComplexArray, RealArray, kernel_array, real_rows
from ident.data.record import Record
from ident.friction.kernel import STEPS, STRIDES, ArmSteps, step_through

# A pole at zero is a delay, which no motion in continuous time has: the fastest rate that is stepped.
FASTEST_POLE = 2e-3


# Ten microradians: what a stiff bearing or gear deflects before it slips.
PRESLIDING = 1e-5


@dataclass(frozen=True)
class FrictionLaw:
    """Dry friction at a shaft: level + excess exp(-|speed| / fall) while it slips, in units of the arm's
    input. presliding: deflection before slipping; fall: in units of the position per second. Raises
    ValueError."""

    level: float
    presliding: float = PRESLIDING
    excess: float = 0.0
    fall: float = np.inf

    def __post_init__(self) -> None:
        if not (self.level >= 0 and self.presliding > 0 and self.breakaway >= 0 and self.fall > 0):
            raise ValueError(f"no dry friction is like {self}")

    @property
    def breakaway(self) -> float:
        """What it takes to move from rest."""
        return self.level + self.excess

    @property
    def n_logs(self) -> int:
        """Parameters that are estimated as their logarithms: deflection, and speed of a Stribeck excess."""
        return 1 + int(np.isfinite(self.fall))

    @property
    def array(self) -> RealArray:
        """(4,) for the kernel."""
        return np.array([self.level, self.presliding, self.excess, self.fall])


@dataclass(frozen=True, eq=False)
class SteppedArm:
    """Poles of an arm, each taken twice, as states in continuous time behind a zero-order hold.

    poles: each once. A state j with rate s_j (1/s) obeys x' = s_j x + e, e the effort, or, where chain[j] is
    true, x' = s_j x + x_before with x_before the state before it (a pole taken twice). The position is the
    real part of the sum of weights x; weights (N, P) complex map the P = 2 order coefficients on the basis
    functions of the doubled poles to the states.
    """

    poles: Poles
    structure: Structure
    dt_s: float
    rates: ComplexArray
    chain: BoolArray
    weights: ComplexArray

    @classmethod
    def of(cls, poles: Poles, structure: Structure, dt_s: float) -> SteppedArm:
        """Raises ValueError for more than one integrator or a direct term: friction needs a speed."""
        if structure.integrators > 1 or structure.feedthrough:
            raise ValueError(
                "dry friction is identified for an output that is the position of the shaft: at most one "
                "integrator and no direct term"
            )
        # Taken twice, a pole moved that little still spans the same responses to a few parts in a million.
        real = np.maximum(poles.real, FASTEST_POLE).astype(np.complex128)
        single = np.concatenate([np.log(real), np.log(poles.pairs)]) / dt_s
        # Of the mirror image of an unstable pole one is that pole itself.
        mirrored = np.concatenate([structure.unstable.real, structure.unstable.pairs])
        images = np.isin(np.concatenate([poles.real, poles.pairs]), mirrored)
        both = np.column_stack([np.where(images, -single.conj(), single), single]).ravel()
        rates = np.concatenate([np.zeros(structure.integrators, np.complex128), both])
        second = np.column_stack([np.zeros(single.size, np.bool_), ~images]).ravel()
        chain = np.concatenate([np.zeros(structure.integrators, np.bool_), second])
        # Coefficients of both forms agree where responses do: they span the same space.
        omega = np.concatenate([np.geomspace(1e-4, 0.05, 60), np.linspace(0.05, 3.1, 300)]) / dt_s
        z = np.exp(1j * omega * dt_s)
        states = _state_responses(z, rates, chain, dt_s)
        # The position is the real part of the sum, so that a pair stands for itself and its conjugate.
        mirrored = _state_responses(z, rates.conj(), chain, dt_s)
        twofold = np.abs(rates.imag) > 0
        columns = np.hstack([(states + mirrored) / 2, 1j * (states - mirrored)[:, twofold] / 2])
        front = front_response(omega, dt_s, structure.integrators, 0)
        front = front / all_pass_response(structure.unstable, z)
        basis = basis_response(poles.doubled(), z) * front[:, None]
        scale = 1 / np.linalg.norm(basis, axis=1)[:, None]
        a, b = (real_rows(scale * part) for part in (columns, basis))
        length = np.linalg.norm(a, axis=0)
        solved = np.linalg.lstsq(a / length, b, rcond=None)[0] / length[:, None]
        weights = solved[: rates.size].astype(np.complex128)
        weights[twofold] += 1j * solved[rates.size :]
        return cls(poles, structure, dt_s, rates, chain, weights)

    def parts(self, states: ComplexArray | BoolArray) -> RealArray:
        """(M,) real parts of a number of each state (N,), and imaginary ones of those that swing."""
        return np.concatenate([states.real, states.imag[self.rates.imag != 0]]).astype(np.float64)

    @property
    def once(self) -> BoolArray:
        """(M,) real states of each pole taken once."""
        return np.concatenate([~self.chain, ~self.chain[self.rates.imag != 0]])

    @cached_property
    def _flow(self) -> RealArray:
        """(M + 1, M + 1) derivative of the real states, and of a held effort behind them."""
        rates = np.diag(self.rates) + np.diag(self.chain[1:], -1)
        kept = np.append(np.full(self.rates.size, True), self.rates.imag != 0)
        both = np.block([[rates.real, -rates.imag], [rates.imag, rates.real]])[np.ix_(kept, kept)]
        onto = np.column_stack([both, self.parts(~self.chain)])
        return np.vstack([onto, np.zeros(len(onto) + 1)])

    def over(self, length_s: float) -> RealArray:
        """(M + 1, M + 1) what a time makes of the real states and a held effort."""
        return np.asarray(expm(self._flow * length_s))

    @cached_property
    def _powers(self) -> RealArray:
        """(S + 1, M + 1, M + 1) after no step, and after each of a stride."""
        step = self.over(self.dt_s / STEPS)
        return np.array([np.linalg.matrix_power(step, k) for k in range(STEPS // STRIDES + 1)])

    def stepped(self, weights: ComplexArray) -> ArmSteps:
        """What the kernels ask of an arm with weights (N,) of its states."""
        out, powers = self.parts(weights.conj()), self._powers
        pulses = powers[:-1, :-1, :-1] @ powers[1, :-1, -1]
        return ArmSteps(
            stride=powers[-1, :-1, :-1].copy(),
            held=powers[-1, :-1, -1].copy(),
            pushes=pulses[::-1].copy(),
            ahead=out @ powers[1:, :-1, :-1],
            pulse=pulses @ out,
            slope=out @ self._flow[:-1],
        )

    def run(
        self,
        coefficients: RealArray,
        voltage: RealArray,
        law: FrictionLaw,
        measured: RealArray | None = None,
        correction: ComplexArray | None = None,
    ) -> tuple[RealArray, RealArray]:
        """Position (T,) and friction held over each sample (T,), in units of the input (T,), from rest; with
        a correction (N,) that of an observer of the measured position (T,): the one it predicts."""
        weights = self.weights @ coefficients
        position, friction = np.empty(voltage.size), np.empty(voltage.size)
        gain = np.zeros(0)
        if correction is not None:
            gain = np.append(self.parts(correction), (weights * correction).real.sum())
        step_through(
            kernel_array(filter_input(voltage, 0, self.structure.input_delay_samples)),
            self.stepped(weights),
            self.dt_s,
            law.array,
            kernel_array(voltage if measured is None else measured),
            gain,
            position,
            friction,
        )
        return position, friction


def less_friction(record: Record, friction: RealArray, delay_samples: int) -> Record:
    """The record with its input smaller by the friction (T,), which the input's delay does not delay."""
    shifted = np.concatenate([friction[delay_samples:], np.full(delay_samples, friction[-1])])
    return replace(record, input=record.input - shifted[:, None])


def _state_responses(z: ComplexArray, rates: ComplexArray, chain: BoolArray, dt_s: float) -> ComplexArray:
    """(F, N) responses of the sampled states to a held input."""
    out = np.empty((z.size, rates.size), dtype=np.complex128)
    for j, s in enumerate(rates):
        decay = np.exp(s * dt_s)
        onto = dt_s if s == 0 else (decay - 1) / s
        if chain[j]:
            out[:, j] = (dt_s * decay * out[:, j - 1] + (dt_s * decay - onto) / s) / (z - decay)
        else:
            out[:, j] = onto / (z - decay)
    return out
