"""A model of several inputs and outputs on one set of poles, and its realisation mode by mode.

`MimoModel` puts models of one output each side by side; its response and its output are theirs. Its state
space is Gilbert's realisation (SIAM J. Control 1(2), 1963): the transfer matrix is written as partial
fractions, and a mode gets as many states as its residue matrix has rank. A mode of an arm moves every joint
and every sensor along one shape, so its residue has rank one, and an arm of any number of motors has two
states per mode instead of two per mode and output. Poles that repeat have no residue each: then every output
is realised by itself. The file assumes stable poles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ident.basis.functions import basis_response, basis_state_space
from ident.basis.model import MisoModel
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray

# Singular values of a residue below this fraction of its largest are rounding, which leaves 2e-16 of residues
# of rank one (measured at poles .1 to 1e-8 apart). A residue that was fitted freely has the share of noise in
# it, many decades above; so ten times more or less counts the same states.
_RANK = 1e-9
# Distance of two poles in the z plane below which they count as one, and have no residue each. Real poles
# that repeat come out of the eigenvalue solver exactly equal. Of a pair that repeats they may come out 1e-8
# apart, the root of rounding; it is then realised as two pairs, whose response is right to 1e-7 (measured).
_SAME_POLE = 1e-9
# In place of a largest singular value of zero: any positive number gives an empty residue rank 0.
_TINY = 1e-300


class Residues(NamedTuple):
    """Partial fractions of G without its delay: direct + at_one/(z - 1) + sum of pole/(z - p) and conjugates.

    poles (M,): real ones, and of each pair the one above the axis; pole (M, Y, U), complex; at_one (Y, U),
    zero without an integrator; direct (Y, U). Units of the outputs per unit of the inputs.
    """

    poles: ComplexArray
    pole: ComplexArray
    at_one: RealArray
    direct: RealArray


@dataclass(frozen=True, eq=False)
class MimoModel:
    """Y outputs of U inputs: `outputs` are the `MisoModel` of each, with the same poles and structure.

    Raises ValueError if they differ in anything but their coefficients and names, a name repeats, or there
    are unstable poles.
    """

    outputs: tuple[MisoModel, ...]

    def __post_init__(self) -> None:
        """Check that the outputs fit together. Raises ValueError as the class says."""
        object.__setattr__(self, "outputs", tuple(self.outputs))
        if not self.outputs or len(set(self.output_names)) != len(self.outputs):
            raise ValueError(f"need at least one output, distinct names; got {list(self.output_names)}")
        first = self.outputs[0]
        for output in self.outputs:
            same_poles = np.array_equal(output.poles.values, first.poles.values)
            same_inputs = output.input_names == first.input_names
            same_structure = (
                output.dt_s == first.dt_s
                and output.integrators == first.integrators
                and output.input_delay_samples == first.input_delay_samples
            )
            if not (same_poles and same_inputs and same_structure):
                raise ValueError(f"output {output.output_name!r} has other poles or another structure")
            if output.unstable.order:
                raise ValueError("unstable poles are fitted with one input and one output only")

    @property
    def poles(self) -> Poles:
        """Poles that all outputs share."""
        return self.outputs[0].poles

    @property
    def order(self) -> int:
        """Number of poles B, those at z = 0 that stand for integrators counted."""
        return self.poles.order

    @property
    def dt_s(self) -> float:
        """Sampling time, s."""
        return self.outputs[0].dt_s

    @property
    def integrators(self) -> int:
        """Number of poles at z = 1, as exact filters of the inputs."""
        return self.outputs[0].integrators

    @property
    def input_delay_samples(self) -> int:
        """Delay of every input in samples."""
        return self.outputs[0].input_delay_samples

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, (U,)."""
        return self.outputs[0].input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, (Y,)."""
        return tuple(output.output_name for output in self.outputs)

    @property
    def coefficients(self) -> RealArray:
        """Coefficients of the basis functions, (Y, U, B)."""
        return np.stack([output.coefficients for output in self.outputs])

    @property
    def feedthrough(self) -> RealArray:
        """Direct terms, (Y, U)."""
        return np.stack([output.feedthrough for output in self.outputs])

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Response matrix G (F, Y, U) at omega (F,) in rad/s.

        Units of the outputs per unit of the inputs. Raises ValueError for |omega| > pi / dt_s or NaN, another
        shape, and for omega = 0 with integrators.
        """
        return np.stack([output.frequency_response(omega_rad_s) for output in self.outputs], axis=1)

    def simulate(self, u: RealArray) -> RealArray:
        """Outputs (T, Y) for the inputs u (T, U), from rest, in their units; from a NaN on NaN.

        Raises ValueError for another shape of u.
        """
        return np.stack([output.simulate(u) for output in self.outputs], axis=1)

    def residues(self) -> Residues:
        """Partial fractions of the model without its delay.

        Returns
        -------
        Residues
            One residue (Y, U) per real pole and per pair, one at z = 1 with an integrator, the direct term.
            With an integrator the poles at z = 0 are left out: its zero cancels them.

        Raises
        ------
        ValueError
            More than one integrator, or poles that repeat.
        """
        if self.integrators > 1:
            raise ValueError(f"{self.integrators} integrators in a row have no residue each; expected 0 or 1")
        values, columns = residue_columns(self.poles)
        residue = np.einsum("yub,bm->myu", self.coefficients, columns)
        at_one = np.zeros(self.feedthrough.shape)
        is_listed = values.imag >= 0
        if self.integrators:
            # z/(z - 1) L(z): at p the factor p/(p - 1), at 1 the value of L there.
            at_unity = basis_response(self.poles, np.ones(1, complex))
            static_gains = np.real(at_unity[0])
            at_one = np.einsum("yub,b->yu", self.coefficients, static_gains) + self.feedthrough
            residue = residue * (values / (values - 1))[:, None, None]
            is_listed &= np.abs(values) > 0
        return Residues(values[is_listed], residue[is_listed], at_one, self.feedthrough)

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """State space (A, B, C, D): each mode with as many states as its residue has rank.

        Returns
        -------
        A, B, C, D : ndarray, shapes (n, n), (n, U), (Y, n), (Y, U)
            A pair whose residue has rank one has two states, whatever the numbers of inputs and outputs; an
            integrator has as many as its residue has rank. The delay has a state per sample and input, or
            output where there are fewer. Without residues (poles that repeat, several integrators), every
            output has states of its own. Nothing is refused: the model was checked when it was made.
        """
        try:
            residues = self.residues()
        except ValueError:
            # Poles repeat, or there are several integrators: every output by itself.
            realised = [output.state_space() for output in self.outputs]
            a_each, b_each, c_each, d_each = zip(*realised, strict=True)
            return block_diag(*a_each), np.vstack(b_each), block_diag(*c_each), np.vstack(d_each)

        # A residue is the sum of its singular directions; each gets a block of its own.
        blocks: list[tuple[RealArray, RealArray, RealArray]] = []
        integrator = (1.0 + 0j, residues.at_one + 0j)
        for pole, residue in [integrator, *zip(residues.poles, residues.pole, strict=True)]:
            left, sizes, right = np.linalg.svd(residue)
            smallest = _RANK * max(sizes[0], _TINY)
            rank = int(np.sum(sizes > smallest))
            for k in range(rank):
                # Half of the size on either side, so that inputs and outputs move the state alike.
                c = left[:, k] * np.sqrt(sizes[k])
                b = right[k] * np.sqrt(sizes[k])
                blocks.append(_mode(complex(pole), c, b))

        # The blocks side by side.
        n_outputs, n_inputs = self.feedthrough.shape
        n_states = sum(len(a) for a, _, _ in blocks)
        A = np.zeros((n_states, n_states))
        B = np.zeros((n_states, n_inputs))
        C = np.zeros((n_outputs, n_states))
        start = 0
        for a, b, c in blocks:
            states = slice(start, start + len(a))
            A[states, states] = a
            B[states] = b
            C[:, states] = c
            start = states.stop
        D = residues.direct.copy()
        for _ in range(self.input_delay_samples):
            A, B, C, D = _delayed(A, B, C, D)
        return A, B, C, D

    def to_control(self) -> Any:
        """This model as a `control.StateSpace` with dt = dt_s, U inputs and Y outputs.

        Raises ImportError without python-control.
        """
        # Here and not above: it brings its plotting along, which nobody else needs.
        import control

        names: dict[str, Any] = {"inputs": list(self.input_names), "outputs": list(self.output_names)}
        return control.ss(*self.state_space(), self.dt_s, **names, remove_useless_states=False)


def residue_columns(poles: Poles) -> tuple[ComplexArray, ComplexArray]:
    """Poles (B,) of a basis and the residues (B, B) of its functions there.

    Parameters
    ----------
    poles : Poles
        Poles of the basis, B of them, inside the circle; without any both results are empty.

    Returns
    -------
    values : ndarray of complex, shape (B,)
        All poles, both of each pair, in the order of the eigenvalue solver.
    residues : ndarray of complex, shape (B, B)
        [b, m]: residue of basis function b at pole m.

    Raises
    ------
    ValueError
        Poles repeat: two are nearer than `_SAME_POLE`.

    Notes
    -----
    With A V = V diag(p), the basis functions are (zI - A)^-1 B = V diag(1 / (z - p)) V^-1 B.
    """
    basis = basis_state_space(poles)
    values, vectors = np.linalg.eig(basis.A)
    # A pole's distance to itself counts as 1, which is never the least that matters.
    distances = np.abs(values[:, None] - values[None, :]) + np.eye(values.size)
    if np.min(distances, initial=1.0) < _SAME_POLE:
        raise ValueError("poles repeat: they have no residue each")
    weights = np.linalg.solve(vectors, basis.B[:, 0])
    return values, np.asarray(vectors * weights)


def _mode(pole: complex, c: ComplexArray, b: ComplexArray) -> tuple[RealArray, RealArray, RealArray]:
    """Real (A, B, C) of c b/(z - pole), with its conjugate where the pole is complex.

    c (Y,) and b (U,): column and row of a residue of rank one. A (n, n), B (n, U), C (Y, n), with n = 1 for a
    real pole and 2 for a pair. c is not zero; of a real pole c b is real, which is not checked: an imaginary
    part is dropped.
    """
    if pole.imag == 0:
        # The singular vectors of a real residue are real up to a common turn.
        largest = c[np.argmax(np.abs(c))]
        turn = np.exp(-1j * np.angle(largest))
        a_real = np.array([[pole.real]])
        return a_real, np.real(b / turn)[None, :], np.real(c * turn)[:, None]
    # States: real and imaginary part of x+ = pole x + b u; y = 2 Re(c x).
    a_pair = np.array([[pole.real, -pole.imag], [pole.imag, pole.real]])
    b_pair = np.stack([b.real, b.imag])
    c_pair = 2 * np.stack([c.real, -c.imag], axis=1)
    return a_pair, b_pair, c_pair


def _delayed(
    A: RealArray, B: RealArray, C: RealArray, D: RealArray
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """State space of the system (A, B, C, D) followed, or preceded, by a delay of one sample.

    A (n, n), B (n, U), C (Y, n), D (Y, U). The new states hold the inputs where there are no more of them
    than outputs, else the outputs: min(U, Y) states more. Shapes that do not fit numpy refuses.
    """
    n_states = len(A)
    n_outputs, n_inputs = D.shape
    no_direct = np.zeros_like(D)
    if n_inputs <= n_outputs:
        # New states: the inputs of the sample before.
        held_inputs = np.zeros((n_inputs, n_states + n_inputs))
        delayed_a = np.block([[A, B], [held_inputs]])
        delayed_b = np.vstack([np.zeros((n_states, n_inputs)), np.eye(n_inputs)])
        delayed_c = np.hstack([C, D])
        return delayed_a, delayed_b, delayed_c, no_direct
    # New states: the outputs of the sample before.
    no_feedback = np.zeros((n_states, n_outputs))
    delayed_a = np.block([[A, no_feedback], [C, np.zeros((n_outputs, n_outputs))]])
    delayed_b = np.vstack([B, D])
    delayed_c = np.hstack([np.zeros((n_outputs, n_states)), np.eye(n_outputs)])
    return delayed_a, delayed_b, delayed_c, no_direct
