"""One shape for every mode: a residue c b of rank one in place of a free one, where the records let it.

The likelihood ratio of both fits is chi-squared, with (Y - 1)(U - 1) degrees for a real pole and twice as
many for a pair. Mode after mode is tried, those nearest to one shape first. Two modes that lie together, or
an input that acts past the structure, keep a free residue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.special import expit, logit

from ident.basis.mimo_model import residue_columns
from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import ComplexArray, RealArray
from ident.fit.least_squares import project
from ident.fit.several_outputs import OutputRegressions

_MOST_EVALUATIONS = 40  # limit of work: it begins at the best free residues, near its end
# Relative change of the residual's power: a thousandth of a degree of freedom in 10 000 samples.
_ENOUGH = 1e-7
_LOG_DECAY = -25.0, 6.0  # of a sample: poles stay inside the circle, and off zero
Refused = Callable[[float, int], bool]


@dataclass(frozen=True, eq=False)
class Shaped:
    """The fit with one shape per mode where `rank_one` says so: poles, coefficients (Y, U, B), direct terms
    (Y, U), residual (Y, N), its sum of squares, and how many free numbers the shapes saved."""

    poles: Poles
    coefficients: RealArray
    direct: RealArray
    residual: RealArray
    rss: float
    rank_one: tuple[bool, ...]
    saved: int


@dataclass(frozen=True, eq=False)
class ShapedMode:
    """A pole (the upper one of a pair) and its residue (Y, U); whether it moves, and has a residue of rank
    one."""

    pole: complex
    residue: ComplexArray
    moves: bool
    rank_one: bool = True

    @property
    def is_pair(self) -> bool:
        return self.pole.imag != 0

    def saved(self) -> int:
        outputs, inputs = self.residue.shape
        return int((outputs - 1) * (inputs - 1) * (1 + self.is_pair) * self.rank_one)


def one_shape_each(
    data: OutputRegressions,
    poles: Poles,
    coefficients: RealArray,
    direct: RealArray,
    *,
    n_fixed: tuple[int, int],
    refused: Refused,
) -> Shaped | None:
    """Refit with one shape per mode from a fit with free residues, coefficients (Y, U, B), direct (Y, U).

    n_fixed: real poles and pairs that do not move; those at zero stand for integrators. refused(rss, saved):
    whether a fit that leaves rss with so many numbers fewer is refused. None with one input or output, poles
    that repeat, or all modes refused.
    """
    if min(direct.shape) < 2:
        return None
    try:
        modes = modes_of(poles, coefficients, n_fixed)
    except ValueError:
        return None
    modes = [replace(mode, rank_one=False) for mode in modes]
    best = ModalFit(data, modes)
    # By the second singular value of a residue over its first, inputs weighed by how much they drive it.
    sizes = [np.linalg.svd(mode.residue * best.sizes(mode), compute_uv=False) for mode in modes]
    for k in np.argsort([one[1] / max(one[0], 1e-300) for one in sizes]):
        trial = [
            replace(mode, pole=pole, residue=residue, rank_one=mode.rank_one or at == int(k))
            for at, (mode, (pole, residue)) in enumerate(zip(best.modes, best.found(), strict=True))
        ]
        problem = ModalFit(data, trial)
        problem.solve()
        if not refused(problem.rss, sum(mode.saved() for mode in trial)):
            best = problem
    return best.shaped(poles) if any(mode.rank_one for mode in best.modes) else None


def modes_of(
    poles: Poles, coefficients: RealArray, n_fixed: tuple[int, int], rank_one: Sequence[bool] | None = None
) -> list[ShapedMode]:
    """Modes of coefficients (Y, U, B), those at zero left out; rank_one: of each, default all. Raises
    ValueError where poles repeat."""
    values, columns = residue_columns(poles)
    residues = np.einsum("yub,bm->myu", coefficients, columns)
    given = [*poles.real[: n_fixed[0]], *poles.pairs[: n_fixed[1]]]
    listed = [pole for pole in (*poles.real, *poles.pairs) if pole != 0]
    return [
        ShapedMode(complex(pole), residues[int(np.argmin(np.abs(values - pole)))], pole not in given, one)
        for pole, one in zip(listed, rank_one or [True] * len(listed), strict=True)
    ]


class ModalFit:
    """Output error over poles, shapes and free residues from modes as given; what is linear is projected
    out."""

    def __init__(self, data: OutputRegressions, modes: Sequence[ShapedMode]) -> None:
        self.data, self.modes = data, modes
        first = data.each[0]
        self.u, self.segments, self.structure = first.u, first.segments, data.structure
        self.y = np.stack([one.y for one in data.each])
        free = [self._filtered(0.0, self.u)] if self.structure.integrators else []
        free += [self.u] if self.structure.feedthrough else []
        self.free = np.real(np.concatenate(free)) if free else np.zeros((0, first.n_samples))
        self._set(np.concatenate([_start(mode, self.sizes(mode)) for mode in self.modes]))

    def _set(self, x: RealArray) -> None:
        self.x = x
        residual, self._jacobian = self._linearised(x)
        self.residual, self.rss = residual.reshape(self.y.shape), float(residual @ residual)

    def _filtered(self, pole: complex, rows: RealArray | ComplexArray) -> RealArray | ComplexArray:
        """Rows (R, N) through 1/(z - pole), record by record from rest."""
        out = np.empty(rows.shape, dtype=np.complex128 if np.imag(pole) else rows.dtype)
        for here in self.segments:
            out[:, here] = lfilter(
                [0.0, 1.0], [1.0, -pole if np.imag(pole) else -np.real(pole)], rows[:, here]
            )
        return out

    def solve(self) -> None:
        """Levenberg and Marquardt from where the modes are."""
        last: list[tuple[RealArray, tuple[RealArray, RealArray]]] = []

        def both(x: RealArray) -> tuple[RealArray, RealArray]:
            if not (last and np.array_equal(last[-1][0], x)):
                last[:] = [(x.copy(), self._linearised(x))]
            return last[-1][1]

        given: dict[str, Any] = {"method": "lm", "x_scale": "jac", "ftol": _ENOUGH, "xtol": _ENOUGH}
        given |= {"fun": lambda x: both(x)[0], "jac": lambda x: both(x)[1], "max_nfev": _MOST_EVALUATIONS}
        self._set(least_squares(x0=self.x, **given).x)

    def sizes(self, mode: ShapedMode) -> RealArray:
        """How much each input drives a mode, (U,): by that a residue's columns are weighed."""
        return np.asarray(np.linalg.norm(self._filtered(mode.pole, self.u), axis=1))

    def _linearised(self, x: RealArray, *, linear: bool = True) -> tuple[RealArray, RealArray]:
        """Residual (Y N,) and its Jacobian (Y N, P), off the nuisances and every output's linear columns."""
        model, columns, poles = np.zeros_like(self.y), list[RealArray](), list[complex]()
        for mode, (pole, residue), slopes in self._unpacked(x):
            poles.append(pole)
            state = self._filtered(pole, self.u)
            model += _shown(residue @ state, mode)
            if mode.moves:
                again = residue @ self._filtered(pole, state)
                columns += [_shown(step * again, mode) for step in _pole_steps(mode, pole)]
            columns += [_shown(slope @ state, mode) for slope in slopes]
        rows = np.concatenate([(self.y - model)[None], -np.array(columns)]).reshape(-1, self.y.shape[1])
        self._take_out(rows, poles, linear=linear)
        rows = rows.reshape(1 + len(columns), -1)
        return rows[0], rows[1:].T

    def _local_q(self, poles: Sequence[complex]) -> RealArray:
        """Nuisance columns of each record, orthonormal."""
        first = self.data.each[0]
        if not self.structure.estimate_initial_state:
            return first.polynomials_q
        real = [pole.real for pole in poles if pole.imag == 0]
        pairs = np.array([pole for pole in poles if pole.imag], dtype=np.complex128)
        local = Poles(np.array([0.0] * bool(self.structure.integrators) + real), pairs)
        return project(first, NO_POLES, local).local_q

    def _take_out(self, rows: RealArray, poles: Sequence[complex], *, linear: bool = True) -> None:
        """Project rows (R, N) off nuisances and linear columns, in place."""
        first, local_q = self.data.each[0], self._local_q(poles)
        first.take_out_local(local_q, rows)
        if len(self.free) and linear:
            free = self.free.copy()
            first.take_out_local(local_q, free)
            q = np.linalg.qr(free.T)[0]
            rows -= (rows @ q) @ q.T

    def covariance_factor(self, noise: Sequence[RealArray] = ()) -> RealArray:
        """S (P, P'), S S^T the covariance of all free numbers to first order, noise of one: the modes', then
        of every output the coefficients of the linear columns.

        noise: A(q) of every output, A(q) e white and e of power 1; without, white. The fit takes it as white:
        (J^T J)^-1 J^T R J (J^T J)^-1, R that of the noise, at no frequency below white noise of its power:
        an A(q) does not see how little there is at low ones.
        """
        factor, slopes, linear = _inverse_factor(self._jacobian), self._jacobian, self._linear_columns()
        if len(self.free):
            slopes = self._linearised(self.x, linear=False)[1]
            # The modes' columns off the linear ones: what is left of these is independent of them.
            mixed = np.linalg.lstsq(linear, slopes, rcond=None)[0]
            own = _inverse_factor(linear)
            factor = np.block([[factor, np.zeros((len(factor), own.shape[1]))], [mixed @ factor, own]])
        if all(weights.size == 1 for weights in noise):
            return factor
        columns = np.concatenate([-slopes, linear], axis=1).reshape(*self.y.shape, -1)
        through: RealArray = np.zeros((0, columns.shape[2]))
        for rows, weights in zip(columns, noise, strict=True):
            for here in self.segments:
                size = next_fast_len(2 * (here.stop - here.start), real=True)
                power = np.maximum(1 / np.abs(np.fft.rfft(weights, size)) ** 2, 1.0) * 2 / size
                lines = np.fft.rfft(rows[here], size, axis=0) * np.sqrt(power)[:, None]
                parts = [through, lines.real, lines.imag]
                through = np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))
        return np.asarray(factor @ factor.T @ through.T)

    def _linear_columns(self) -> RealArray:
        """Of all outputs, off the nuisances, (Y N, Y Q)."""
        n_outputs, n_free = self.y.shape[0], len(self.free)
        columns = np.zeros((n_outputs * n_free, *self.y.shape))
        for k in range(n_outputs):
            columns[k * n_free : (k + 1) * n_free, k] = self.free
        rows = columns.reshape(-1, self.y.shape[1])
        if n_free:
            self.data.each[0].take_out_local(self._local_q([pole for pole, _ in self.found()]), rows)
        return rows.reshape(n_outputs * n_free, self.y.size).T

    def response_columns(self, omega_rad_s: RealArray) -> ComplexArray:
        """Change of the response with each number of `covariance_factor`, (F, Y, U, P)."""
        a, b, seen = self._one_input()
        z = np.exp(1j * np.asarray(omega_rad_s) * self.data.dt_s)
        states = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, b)[..., 0]
        both = np.concatenate([states, np.ones((z.size, 1))], axis=1)
        return np.asarray(np.einsum("pyum,fm->fyup", seen, both))

    def response_states(self) -> tuple[RealArray, RealArray, RealArray]:
        """The same as a state space: A (n, n), B (n, U), and C (P, Y, n + U) that takes states and inputs to
        what each number changes. Every input drives states of its own."""
        a, b, seen = self._one_input()
        eye, size = np.eye(self.u.shape[0]), len(a)
        rows = [seen[..., :size].reshape(*seen.shape[:2], -1), seen[..., size]]
        return np.asarray(np.kron(eye, a)), np.asarray(np.kron(eye, b)), np.concatenate(rows, axis=2)

    def _one_input(self) -> tuple[RealArray, RealArray, RealArray]:
        """State space of what one input drives, A (m, m), B (m, 1), and (P, Y, U, m + 1): what each number
        of `covariance_factor` changes, seen from the states and the input itself. Inputs as they drive the
        modes, without integrator and delay."""
        n_outputs, n_inputs = self.y.shape[0], self.u.shape[0]
        blocks, drive = [np.zeros((1, 1))], [1.0]  # one sample later, for the integrators' columns
        seen: list[
            tuple[int, ComplexArray, bool]
        ] = []  # first state, change (Y, U), whether it has a conjugate
        for mode, (pole, residue), slopes in self._unpacked(self.x):
            turn = np.array([[0.0, -pole.imag], [pole.imag, 0.0]]) if mode.is_pair else np.zeros((1, 1))
            own, size, at = pole.real * np.eye(len(turn)) + turn, len(turn), len(drive)
            blocks.append(np.block([[own, np.zeros_like(own)], [np.eye(size), own]]))
            drive += [1.0] + [0.0] * (2 * size - 1)
            if mode.moves:
                seen += [(at + size, step * residue, mode.is_pair) for step in _pole_steps(mode, pole)]
            seen += [(at, slope, mode.is_pair) for slope in slopes]
        at, columns = len(drive), []
        for state, change, is_pair in seen:
            column = np.zeros((n_outputs, n_inputs, at + 1))
            column[:, :, state] = change.real
            if is_pair:  # twice the real part of change times the complex state
                column[:, :, state : state + 2] = 2 * np.stack([change.real, -change.imag], axis=-1)
            columns.append(column)
        parts = [0] if self.structure.integrators else []
        parts += [at] if self.structure.feedthrough else []
        for k, part, j in product(range(n_outputs), parts, range(n_inputs)):
            column = np.zeros((n_outputs, n_inputs, at + 1))
            column[k, j, part] = 1.0
            columns.append(column)
        return np.asarray(block_diag(*blocks)), np.array(drive)[:, None], np.array(columns)

    def _unpacked(
        self, x: RealArray
    ) -> Iterator[tuple[ShapedMode, tuple[complex, ComplexArray], list[ComplexArray]]]:
        parts = np.split(x, np.cumsum([_count(mode) for mode in self.modes])[:-1])
        for mode, part in zip(self.modes, parts, strict=True):
            pole, residue, slopes = _unpacked(mode, part)
            yield mode, (pole, residue), slopes

    def found(self) -> list[tuple[complex, ComplexArray]]:
        """Pole and residue (Y, U) of every mode."""
        return [both for _, both, _ in self._unpacked(self.x)]

    def shaped(self, before: Poles) -> Shaped:
        """Coefficients on the basis of the poles as they are now."""
        found = self.found()
        zeros = np.zeros(int(np.sum(before.real == 0)))
        real = [(pole, residue) for pole, residue in found if pole.imag == 0]
        pairs = [(pole, residue) for pole, residue in found if pole.imag != 0]
        poles = Poles(
            np.concatenate([zeros, [pole.real for pole, _ in real]]),
            np.array([pole for pole, _ in pairs], complex),
        )
        values, columns = residue_columns(poles)
        explained = np.zeros_like(self.y)
        for mode, (pole, residue) in zip(self.modes, found, strict=True):
            explained += _shown(residue @ self._filtered(pole, self.u), mode)
        linear = self._free_coefficients(self.y - explained, [pole for pole, _ in found])
        n_outputs, n_inputs = self.y.shape[0], self.u.shape[0]
        parts = linear.reshape(n_outputs, -1, n_inputs)
        rho = np.zeros((poles.order, n_outputs, n_inputs), dtype=np.complex128)
        for pole, residue in found:
            rho[int(np.argmin(np.abs(values - pole)))] = residue
            if pole.imag:
                rho[int(np.argmin(np.abs(values - pole.conjugate())))] = residue.conj()
        if zeros.size:
            rho[int(np.argmin(np.abs(values)))] = parts[:, 0]
        direct = parts[:, -1] if self.structure.feedthrough else np.zeros((n_outputs, n_inputs))
        coefficients = np.real(np.einsum("bm,myu->yub", np.linalg.inv(columns.T), rho))
        return Shaped(
            poles, coefficients, direct, self.residual, self.rss,
            tuple(mode.rank_one for mode in self.modes), sum(mode.saved() for mode in self.modes),
        )  # fmt: skip

    def _free_coefficients(self, rest: RealArray, poles: list[complex]) -> RealArray:
        """Least squares of what the modes leave (Y, N) on the free columns, nuisances beside them: (Y, Q)."""
        if not len(self.free):
            return np.zeros((len(rest), 0))
        both = np.concatenate([rest, self.free])
        self.data.each[0].take_out_local(self._local_q(poles), both)
        return np.asarray(np.linalg.lstsq(both[len(rest) :].T, both[: len(rest)].T, rcond=None)[0].T)


def _inverse_factor(columns: RealArray) -> RealArray:
    """S with S S^T = (C^T C)^-1; columns scaled, so that what is left out as unseen has no units."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(np.linalg.qr(columns / scale, mode="r"), rcond=1e-12) / scale[:, None])


def _shown(rows: RealArray | ComplexArray, mode: ShapedMode) -> RealArray:
    """What a mode adds to the outputs: with its conjugate where it is a pair."""
    return 2 * np.real(rows) if mode.is_pair else np.real(rows)


def _count(mode: ShapedMode) -> int:
    """Free numbers: those of the pole, and of a residue with or without one shape."""
    outputs, inputs = mode.residue.shape
    numbers = outputs + inputs - 1 if mode.rank_one else outputs * inputs
    return int((1 + mode.is_pair) * (numbers + mode.moves))


def _start(mode: ShapedMode, sizes: RealArray) -> RealArray:
    """Free numbers of a mode: log decay (and logistic angle), then c, and b without its largest, which is
    one."""
    pole, residue = mode.pole, mode.residue
    head = [np.log(-np.log(abs(pole)))] if mode.moves else []
    head += [logit(np.angle(pole) / np.pi)] if mode.moves and mode.is_pair else []
    if mode.rank_one:
        left, size, right = np.linalg.svd(residue * sizes)
        b = right[0] / sizes
        fixed = _largest(mode)
        numbers = np.concatenate([left[:, 0] * size[0] * b[fixed], np.delete(b / b[fixed], fixed)])
    else:
        numbers = residue.ravel()
    return np.concatenate([head, *([numbers.real, numbers.imag] if mode.is_pair else [numbers.real])])


def _largest(mode: ShapedMode) -> int:
    """The input that drives a mode most: its share of the shape is one."""
    return int(np.argmax(np.linalg.norm(mode.residue, axis=0)))


def _unpacked(mode: ShapedMode, x: RealArray) -> tuple[complex, ComplexArray, list[ComplexArray]]:
    """Pole, residue (Y, U), and the residue's change with each of its free numbers."""
    pole = mode.pole
    if mode.moves:
        size, x = np.exp(-np.exp(np.clip(x[0], *_LOG_DECAY))), x[1:]
        if mode.is_pair:
            pole, x = size * np.exp(1j * np.pi * expit(x[0])), x[1:]
        else:
            pole = complex(np.copysign(size, mode.pole.real))
    outputs, inputs = mode.residue.shape
    values = x[: x.size // 2] + 1j * x[x.size // 2 :] if mode.is_pair else x.astype(np.complex128)
    turns = (1.0 + 0j, 1j) if mode.is_pair else (1.0 + 0j,)
    slopes: list[ComplexArray] = []
    if not mode.rank_one:
        residue: ComplexArray = values.reshape(outputs, inputs)
        slopes += [
            turn * unit
            for turn in turns
            for unit in np.eye(values.size, dtype=np.complex128).reshape(-1, outputs, inputs)
        ]
        return complex(pole), residue, slopes
    fixed = _largest(mode)
    c, b = values[:outputs], np.insert(values[outputs:], fixed, 1.0)
    for turn in turns:
        slopes += [np.asarray(turn * np.outer(np.eye(outputs)[k], b)) for k in range(outputs)]
        others = (k for k in range(inputs) if k != fixed)
        slopes += [np.asarray(turn * np.outer(c, np.eye(inputs)[k])) for k in others]
    return complex(pole), np.asarray(np.outer(c, b)), slopes


def _pole_steps(mode: ShapedMode, pole: complex) -> list[complex]:
    """Change of the pole with its log decay, and with the logistic number of its angle."""
    decay = pole * np.log(abs(pole)) if pole else 0j
    angle = np.angle(pole)
    return [decay, 1j * pole * angle * (1 - angle / np.pi)] if mode.is_pair else [decay]
