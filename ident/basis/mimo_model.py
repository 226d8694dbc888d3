"""A model of several inputs and outputs on one set of poles, and its realisation mode by mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ident.basis.functions import basis_response, basis_state_space
from ident.basis.model import MisoModel
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray

# Singular values of a residue below this fraction of its largest are rounding.
_RANK = 1e-9


class Residues(NamedTuple):
    """Partial fractions of G without its delay: direct + at_one/(z - 1) + sum of pole/(z - p) and conjugates.

    poles (M,): real ones, and of each pair the one above the axis; pole (M, Y, U); at_one (Y, U), zero
    without an integrator; direct (Y, U).
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
        object.__setattr__(self, "outputs", tuple(self.outputs))
        if not self.outputs or len(set(self.output_names)) != len(self.outputs):
            raise ValueError(f"need at least one output, distinct names; got {list(self.output_names)}")
        first = self.outputs[0]
        for one in self.outputs:
            if not (
                np.array_equal(one.poles.values, first.poles.values)
                and one.input_names == first.input_names
                and (one.dt_s, one.integrators, one.input_delay_samples)
                == (first.dt_s, first.integrators, first.input_delay_samples)
            ):
                raise ValueError(f"output {one.output_name!r} has other poles or another structure")
            if one.unstable.order:
                raise ValueError("unstable poles are fitted with one input and one output only")

    @property
    def poles(self) -> Poles:
        return self.outputs[0].poles

    @property
    def order(self) -> int:
        """Number of poles, those at z = 0 that stand for integrators counted."""
        return self.poles.order

    @property
    def dt_s(self) -> float:
        return self.outputs[0].dt_s

    @property
    def integrators(self) -> int:
        return self.outputs[0].integrators

    @property
    def input_delay_samples(self) -> int:
        return self.outputs[0].input_delay_samples

    @property
    def input_names(self) -> tuple[str, ...]:
        return self.outputs[0].input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(one.output_name for one in self.outputs)

    @property
    def coefficients(self) -> RealArray:
        """(Y, U, B)."""
        return np.stack([one.coefficients for one in self.outputs])

    @property
    def feedthrough(self) -> RealArray:
        """(Y, U)."""
        return np.stack([one.feedthrough for one in self.outputs])

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """omega (F,) in rad/s, |omega| <= pi/dt (and not 0 with integrators) -> G (F, Y, U)."""
        return np.stack([one.frequency_response(omega_rad_s) for one in self.outputs], axis=1)

    def simulate(self, u: RealArray) -> RealArray:
        """Outputs (T, Y) for the inputs u (T, U), from rest."""
        return np.stack([one.simulate(u) for one in self.outputs], axis=1)

    def residues(self) -> Residues:
        """Partial fractions. Raises ValueError with more than one integrator, or where poles repeat."""
        if self.integrators > 1:
            raise ValueError(f"{self.integrators} integrators in a row have no residue each; expected 0 or 1")
        values, columns = residue_columns(self.poles)
        kept = values.imag >= 0
        pole = np.einsum("yub,bm->myu", self.coefficients, columns)
        at_one = np.zeros(self.feedthrough.shape)
        if self.integrators:
            # z/(z - 1) L(z): at p the factor p/(p - 1), at 1 the value of L there.
            static = np.real(basis_response(self.poles, np.ones(1, complex))[0])
            at_one = np.einsum("yub,b->yu", self.coefficients, static) + self.feedthrough
            pole = pole * (values / (values - 1))[:, None, None]
        seen = kept & (np.abs(values) > 0 if self.integrators else True)
        return Residues(values[seen], pole[seen], at_one, self.feedthrough)

    def state_space(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """(A, B, C, D): each mode with as many states as its residue has rank (Gilbert's realisation).

        A pair whose residue has rank one has two states, whatever the numbers of inputs and outputs; an
        integrator as many as its residue has rank. The delay has a state per sample and input, or output
        where there are fewer. Without residues, every output has states of its own.
        """
        try:
            found = self.residues()
        except ValueError:  # every output by itself
            a_each, b_each, c_each, d_each = zip(*(one.state_space() for one in self.outputs), strict=True)
            return block_diag(*a_each), np.vstack(b_each), block_diag(*c_each), np.vstack(d_each)
        blocks: list[tuple[RealArray, RealArray, RealArray]] = []
        for pole, residue in [(1.0 + 0j, found.at_one + 0j), *zip(found.poles, found.pole, strict=True)]:
            left, sizes, right = np.linalg.svd(residue)
            for k in range(int(np.sum(sizes > _RANK * max(sizes[0], 1e-300)))):
                c, b = left[:, k] * np.sqrt(sizes[k]), right[k] * np.sqrt(sizes[k])
                blocks.append(_mode(complex(pole), c, b))
        n = sum(len(a) for a, _, _ in blocks)
        shape = self.feedthrough.shape
        A, B, C = np.zeros((n, n)), np.zeros((n, shape[1])), np.zeros((shape[0], n))
        at = 0
        for a, b, c in blocks:
            here = slice(at, at + len(a))
            A[here, here], B[here], C[:, here] = a, b, c
            at = here.stop
        D = found.direct.copy()
        for _ in range(self.input_delay_samples):
            A, B, C, D = _delayed(A, B, C, D)
        return A, B, C, D

    def to_control(self) -> Any:
        """The same model as a `control.StateSpace` with dt = dt_s, U inputs and Y outputs."""
        import control  # here: it brings its plotting along

        names: dict[str, Any] = {"inputs": list(self.input_names), "outputs": list(self.output_names)}
        return control.ss(*self.state_space(), self.dt_s, **names, remove_useless_states=False)


def residue_columns(poles: Poles) -> tuple[ComplexArray, ComplexArray]:
    """Poles (B,) and residues (B, B) of every basis function at each: [b, m]. ValueError where poles
    repeat."""
    basis = basis_state_space(poles)
    values, vectors = np.linalg.eig(basis.A)
    apart = np.abs(values[:, None] - values[None, :]) + np.eye(values.size)
    if np.min(apart, initial=1.0) < 1e-9:
        raise ValueError("poles repeat: they have no residue each")
    return values, np.asarray(vectors * np.linalg.solve(vectors, basis.B[:, 0]))


def _mode(pole: complex, c: ComplexArray, b: ComplexArray) -> tuple[RealArray, RealArray, RealArray]:
    """(A, B, C) of c b/(z - pole), with its conjugate where the pole is complex."""
    if pole.imag == 0:
        # A real residue's singular vectors are real up to a common turn.
        turn = np.exp(-1j * np.angle(c[np.argmax(np.abs(c))]))
        return np.array([[pole.real]]), np.real(b / turn)[None, :], np.real(c * turn)[:, None]
    # States: real and imaginary part of x+ = pole x + b u; y = 2 Re(c x).
    a = np.array([[pole.real, -pole.imag], [pole.imag, pole.real]])
    return a, np.stack([b.real, b.imag]), 2 * np.stack([c.real, -c.imag], axis=1)


def _delayed(
    A: RealArray, B: RealArray, C: RealArray, D: RealArray
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """One sample later, at whichever side is smaller."""
    n, (n_outputs, n_inputs) = len(A), D.shape
    if n_inputs <= n_outputs:
        return (
            np.block([[A, B], [np.zeros((n_inputs, n + n_inputs))]]),
            np.vstack([np.zeros((n, n_inputs)), np.eye(n_inputs)]),
            np.hstack([C, D]),
            np.zeros_like(D),
        )
    return (
        np.block([[A, np.zeros((n, n_outputs))], [C, np.zeros((n_outputs, n_outputs))]]),
        np.vstack([B, D]),
        np.hstack([np.zeros((n_outputs, n)), np.eye(n_outputs)]),
        np.zeros_like(D),
    )
