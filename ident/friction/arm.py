"""Dry friction, and a linear arm on given poles stepped between the samples with it at its shaft.

A sampled model does not say where its arm is between two samples, which decides how long a shaft sticks. Here
the poles are taken to continuous time, s = log(p) / dt, behind a zero-order hold, each twice, so that the
coefficients may also move the poles, to first order. Coefficients on the basis functions become weights of
these states by least squares over frequencies; the compiled stepper (`ident.friction.kernel`) then runs the
arm with its friction, freely or corrected by an observer.
"""

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
from ident.friction.kernel import STRIDES, ArmSteps, step_through, steps_of

# A pole at zero is a delay, which no motion in continuous time has: the fastest rate that is stepped, as a
# pole z. Chosen; it is gone within a sample.
FASTEST_POLE = 2e-3
# Deflection before a shaft slips, rad: ten microradians, what a stiff bearing or gear deflects. A fit begins
# with it and may move it by a factor of twenty.
PRESLIDING = 1e-5


@dataclass(frozen=True)
class FrictionLaw:
    """Dry friction at a shaft: level + excess exp(-|speed| / fall) while it slips.

    Attributes
    ----------
    level : float
        Coulomb friction, units of the arm's input.
    presliding : float
        Deflection before slipping, units of the position.
    excess : float
        Of the friction at rest over the level (Stribeck), units of the input.
    fall : float
        Speed over which the excess falls, units of the position per second; inf: no such excess is fitted.

    Raises
    ------
    ValueError
        A negative level or breakaway force, a deflection or speed that is not positive.
    """

    level: float
    presliding: float = PRESLIDING
    excess: float = 0.0
    fall: float = np.inf

    def __post_init__(self) -> None:
        """Raise ValueError where no dry friction is like this."""
        if not (self.level >= 0 and self.presliding > 0 and self.breakaway >= 0 and self.fall > 0):
            raise ValueError(f"no dry friction is like {self}")

    @property
    def breakaway(self) -> float:
        """Force that it takes to move from rest, units of the input."""
        return self.level + self.excess

    @property
    def n_logs(self) -> int:
        """Number of parameters estimated as logarithms: the deflection, and a Stribeck excess's speed."""
        return 2 if np.isfinite(self.fall) else 1

    @property
    def array(self) -> RealArray:
        """Numbers (4,) for the kernel: level, presliding, excess, fall."""
        return np.array([self.level, self.presliding, self.excess, self.fall])


@dataclass(frozen=True, eq=False)
class SteppedArm:
    """Poles of an arm, each taken twice, as N states in continuous time behind a zero-order hold.

    A state j obeys x' = s_j x + e, e the effort (input less friction), or, where chain[j] is true,
    x' = s_j x + x_before with x_before the state before it (a pole taken twice). The position is the real
    part of the sum of weights x. M real states are the real parts of all N and the imaginary ones of those
    that swing.

    Attributes
    ----------
    poles : Poles
        Each once.
    structure : Structure
        Integrators, dead time and unstable poles of the arm.
    dt_s : float
        Step of the records, s.
    rates : ndarray of complex, shape (N,)
        s_j, 1/s; an integrator comes first.
    chain : ndarray of bool, shape (N,)
    weights : ndarray of complex, shape (N, P)
        From the P = 2 order coefficients on the basis functions of the doubled poles to the states.
    """

    poles: Poles
    structure: Structure
    dt_s: float
    rates: ComplexArray
    chain: BoolArray
    weights: ComplexArray

    @classmethod
    def of(cls, poles: Poles, structure: Structure, dt_s: float, *, doubled: bool = True) -> SteppedArm:
        """States of an arm on given poles, and their weights.

        Parameters
        ----------
        poles : Poles
            Of the arm, sampled at dt_s, each once; mirror images of unstable ones among them.
        structure : Structure
        dt_s : float
        doubled : bool
            Each pole twice. Otherwise once: half of the states, for an arm whose poles a fit moves by itself.

        Returns
        -------
        SteppedArm

        Raises
        ------
        ValueError
            More than one integrator or a direct term: friction needs a speed. No pole: nothing moves.

        Notes
        -----
        Weights are those by which the sampled responses of the states agree with the basis functions, by
        least squares over 360 frequencies, relative to the size of the basis there.
        """
        if structure.integrators > 1 or structure.feedthrough:
            raise ValueError(
                "dry friction is identified for an output that is the position of the shaft: at most one "
                "integrator and no direct term"
            )
        if poles.order == 0:
            raise ValueError(
                "dry friction is identified for an arm with at least one pole (expected n_real >= 1)"
            )
        # Taken twice, a pole moved that little still spans the same responses to a few parts in a million.
        real = np.maximum(poles.real, FASTEST_POLE).astype(np.complex128)
        single = np.concatenate([np.log(real), np.log(poles.pairs)]) / dt_s
        # Of the mirror image of an unstable pole one is that pole itself.
        unstable = np.concatenate([structure.unstable.real, structure.unstable.pairs])
        images = np.isin(np.concatenate([poles.real, poles.pairs]), unstable)
        of_poles = np.where(images, -single.conj(), single)
        of_chain = np.zeros(single.size, np.bool_)
        if doubled:
            # The second state of a pole is driven by its first one, but for mirror images.
            of_poles = np.column_stack([of_poles, single]).ravel()
            of_chain = np.column_stack([of_chain, ~images]).ravel()
        rates = np.concatenate([np.zeros(structure.integrators, np.complex128), of_poles])
        chain = np.concatenate([np.zeros(structure.integrators, np.bool_), of_chain])

        # Coefficients of both forms agree where responses do: they span the same space. Frequencies in
        # radians a sample, close to each other where the integrator and slow poles are.
        slow = np.geomspace(1e-4, 0.05, 60)
        fast = np.linspace(0.05, 3.1, 300)
        omega = np.concatenate([slow, fast]) / dt_s
        z = np.exp(1j * omega * dt_s)
        states = _state_responses(z, rates, chain, dt_s)
        # The position is the real part of the sum, so that a pair stands for itself and its conjugate.
        conjugates = _state_responses(z, rates.conj(), chain, dt_s)
        twofold = np.abs(rates.imag) > 0
        columns = np.hstack([(states + conjugates) / 2, 1j * (states - conjugates)[:, twofold] / 2])
        front = front_response(omega, dt_s, structure.integrators, 0)
        front = front / all_pass_response(structure.unstable, z)
        basis_poles = poles.doubled() if doubled else poles
        basis = basis_response(basis_poles, z) * front[:, None]

        # Every frequency counts alike, and every state: both differ by decades.
        scale = 1 / np.linalg.norm(basis, axis=1)[:, None]
        state_rows = real_rows(scale * columns)
        basis_rows = real_rows(scale * basis)
        length = np.linalg.norm(state_rows, axis=0)
        solved = np.linalg.lstsq(state_rows / length, basis_rows, rcond=None)[0] / length[:, None]
        weights = solved[: rates.size].astype(np.complex128)
        weights[twofold] += 1j * solved[rates.size :]
        return cls(poles, structure, dt_s, rates, chain, weights)

    def continuous_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Responses (F, P) of the position to the effort in continuous time, of a unit of each coefficient,
        at omega_rad_s (F,), which is not zero where the arm integrates."""
        s = 1j * omega_rad_s
        states = np.empty((s.size, self.rates.size), np.complex128)
        conjugates = np.empty_like(states)
        for j, rate in enumerate(self.rates):
            states[:, j] = 1 / (s - rate)
            conjugates[:, j] = 1 / (s - rate.conj())
            if self.chain[j]:
                states[:, j] *= states[:, j - 1]
                conjugates[:, j] *= conjugates[:, j - 1]
        # The position is the real part of the sum, so that a pair stands for itself and its conjugate.
        return np.asarray((states @ self.weights + conjugates @ self.weights.conj()) / 2)

    @property
    def swings(self) -> BoolArray:
        """Mask (N,) of the states that swing: their imaginary parts are real states, too."""
        return np.asarray(self.rates.imag != 0)

    def parts(self, states: ComplexArray | BoolArray) -> RealArray:
        """Real parts of a number of each state (N,), then imaginary ones of those that swing: (M,)."""
        return np.concatenate([states.real, states.imag[self.swings]]).astype(np.float64)

    @property
    def once(self) -> BoolArray:
        """Mask (M,) of the real states that belong to poles taken once."""
        return np.concatenate([~self.chain, ~self.chain[self.swings]])

    @cached_property
    def _flow(self) -> RealArray:
        """Derivative (M + 1, M + 1), 1/s, of the real states and of a held effort, whose own row is 0."""
        rates = np.diag(self.rates) + np.diag(self.chain[1:], -1)
        # Of states that do not swing the imaginary part stays zero and is left out.
        has_part = np.append(np.full(self.rates.size, True), self.swings)
        real_form = np.block([[rates.real, -rates.imag], [rates.imag, rates.real]])
        among_states = real_form[np.ix_(has_part, has_part)]
        with_effort = np.column_stack([among_states, self.parts(~self.chain)])
        return np.vstack([with_effort, np.zeros(len(with_effort) + 1)])

    def over(self, length_s: float) -> RealArray:
        """Transition matrix (M + 1, M + 1) of the real states and a held effort over a time, s."""
        return np.asarray(expm(self._flow * length_s))

    @cached_property
    def _powers(self) -> RealArray:
        """Transition matrices (S + 1, M + 1, M + 1) after no step, and after each step of a stride."""
        n_steps = steps_of(self.dt_s)
        step = self.over(self.dt_s / (STRIDES * n_steps))
        powers = [np.eye(len(step))]
        for _ in range(n_steps):
            powers.append(powers[-1] @ step)
        return np.array(powers)

    def stepped(self, weights: ComplexArray) -> ArmSteps:
        """Matrices by which the kernels step an arm, for weights (N,) of its states in the position."""
        out = self.parts(weights.conj())
        powers = self._powers
        # States at the end of a step that had unit effort, and so many steps later.
        pulses = powers[:-1, :-1, :-1] @ powers[1, :-1, -1]
        return ArmSteps(
            stride=powers[-1, :-1, :-1].copy(),
            held=powers[-1, :-1, -1].copy(),
            pushes=pulses[::-1].copy(),
            ahead=(out @ powers[1:, :-1, :-1]).T.copy(),
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
        """Motion of the arm with friction, from rest, freely or as an observer predicts it.

        Parameters
        ----------
        coefficients : ndarray, shape (P,)
            On the basis functions of the doubled poles.
        voltage : ndarray, shape (T,)
            Input, held over each sample.
        law : FrictionLaw
        measured : ndarray, shape (T,), optional
            Position that an observer is corrected by.
        correction : ndarray of complex, shape (N,), optional
            Gain of the observer (`ident.friction.observer.correction_of`); None: a free run.

        Returns
        -------
        tuple of ndarray, shape (T,) each
            Position, with a correction the one that the observer predicts; friction held over each sample, in
            units of the input.
        """
        weights = self.weights @ coefficients
        position = np.empty(voltage.size)
        friction = np.empty(voltage.size)
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
    """A record with its input smaller by the friction (T,), in units of the input.

    Friction is not delayed as the input is (`delay_samples`), so it is subtracted so many samples earlier;
    its last value is repeated.
    """
    shifted = np.concatenate([friction[delay_samples:], np.full(delay_samples, friction[-1])])
    return replace(record, input=record.input - shifted[:, None])


def _state_responses(z: ComplexArray, rates: ComplexArray, chain: BoolArray, dt_s: float) -> ComplexArray:
    """Responses (F, N) of the sampled states (`SteppedArm`) to a held input, at z (F,) on the unit circle.

    A chained state is the derivative of the one before it with respect to its rate.
    """
    responses = np.empty((z.size, rates.size), dtype=np.complex128)
    for j, rate in enumerate(rates):
        decay = np.exp(rate * dt_s)
        # What a unit input that is held over a sample adds to the state.
        pulse = dt_s if rate == 0 else (decay - 1) / rate
        if chain[j]:
            driven = dt_s * decay * responses[:, j - 1]
            direct = (dt_s * decay - pulse) / rate
            responses[:, j] = (driven + direct) / (z - decay)
        else:
            responses[:, j] = pulse / (z - decay)
    return responses
