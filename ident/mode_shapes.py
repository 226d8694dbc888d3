"""Give every mode of a model of several inputs and outputs one shape, where the records let it.

A mode of a structure has one shape: its residue, (Y, U) for Y outputs and U inputs, is a product c b of a
column c (which outputs move) and a row b (which inputs drive it), a matrix of rank one. Two modes that lie
together, or an input that acts past the structure, have a residue of higher rank, which stays free here.

`one_shape_each` begins at a fit with free residues and tries one mode after the other, those nearest to one
shape first. Each trial is refitted by nonlinear least squares (`ModalFit`), with a pole as the logarithm of
its decay and the logistic number of its angle. The caller refuses a trial by the likelihood ratio of both
fits, which is chi-squared with (Y - 1)(U - 1) degrees for a real pole and twice as many for a pair.

`ModalFit` also says how uncertain the numbers are and how they change the response, to first order. Assumed:
poles that differ, and outputs whitened to independent noise of power 1.

`OutputRegressions`, of another file, holds a regression for each output (`each`) of the same inputs u (U, N),
with `y` (N,), `segments` (rows of each record) and `take_out_local`, which projects rows off nuisance
columns. `Poles` has real poles and of each pair the one above the axis, all inside the unit circle; B of
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.special import expit, logit

from ident.basis.mimo_model import residue_columns
from ident.basis.noise_model import NoiseModel
from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import ComplexArray, RealArray
from ident.fit.least_squares import project
from ident.fit.several_outputs import OutputRegressions

# Evaluations of one refit at most: a limit of work. A refit begins at the best free residues, near its end,
# and takes two or three; of two modes at one place, which have no common shape and are refused, twenty. With
# 20 no test of several outputs moves.
MOST_EVALUATIONS = 40
# A refit ends when the residual's power, or its numbers, change by a smaller share: a thousandth of a degree
# of freedom in 10 000 samples, far below what the likelihood ratio decides by. With 1e-5 no test of several
# outputs moves.
LEAST_CHANGE = 1e-7
# Lowest logarithm of a pole's decay per sample: a time constant of 7e10 samples. It keeps poles inside the
# unit circle; no pole that records show comes near it.
LOWEST_LOG_DECAY = -25.0
# Highest one: a pole of e^-403, which keeps its logarithm finite. Records show none below e^-30 or so.
HIGHEST_LOG_DECAY = 6.0
# Singular values of Jacobian columns of one length below this share of the largest are not seen by the data:
# they get no variance instead of an infinite one. Rounding leaves about 1e-15 of a column.
SMALLEST_SEEN = 1e-12
# Nearly the smallest double that still can be divided by, in place of a length of zero.
TINY = 1e-300

# Whether a fit that leaves a residual sum of squares with so many free numbers fewer is refused.
Refused = Callable[[float, int], bool]


@dataclass(frozen=True, eq=False)
class Shaped:
    """A fit in which some modes have one shape. Nothing is checked: `ModalFit.shaped` makes it.

    Attributes
    ----------
    poles : Poles
        Those at zero, which stand for integrators, first; then those of the modes, pairs apart.
    coefficients : ndarray, shape (Y, U, B)
        Of the basis functions of these poles.
    direct : ndarray, shape (Y, U)
        Direct terms; zero where there are none.
    residual : ndarray, shape (Y, N)
        What the fit leaves of the whitened outputs.
    rss : float
        Its sum of squares.
    rank_one : tuple of bool
        Of each mode: it has one shape.
    saved : int
        Free numbers that the shapes saved.
    """

    poles: Poles
    coefficients: RealArray
    direct: RealArray
    residual: RealArray
    rss: float
    rank_one: tuple[bool, ...]
    saved: int


class _ModeValue(NamedTuple):
    """A mode at some values of its free numbers.

    mode : ShapedMode, which says what of it is free
    pole : real, or the upper one of a pair
    residue (Y, U)
    residue_slopes : change of the residue with each of its free numbers, (Y, U) each
    """

    mode: ShapedMode
    pole: complex
    residue: ComplexArray
    residue_slopes: list[ComplexArray]

    def pole_slopes(self) -> list[complex]:
        """Change of the pole with the logarithm of its decay, and with the logistic number of its angle.

        One number for a real pole, two for a pair; zero for a pole at zero.
        """
        # With |p| = exp(-exp(x)) the slope is p ln|p|, which is zero at p = 0.
        with_log_decay = 0j
        if self.pole:
            with_log_decay = self.pole * np.log(abs(self.pole))
        if not self.mode.is_pair:
            return [with_log_decay]
        # The angle is pi expit(x): its slope is angle (1 - angle / pi).
        angle = np.angle(self.pole)
        with_angle = 1j * self.pole * angle * (1 - angle / np.pi)
        return [with_log_decay, with_angle]

    def seen(self, rows: RealArray | ComplexArray) -> RealArray:
        """Real rows (R, N) that complex rows (R, N) of the mode are at the outputs.

        A pair's rows come with those of its conjugate: twice their real part. Of a real mode the imaginary
        part, which is zero, is left out.
        """
        if self.mode.is_pair:
            return 2 * np.real(rows)
        return np.real(rows)


@dataclass(frozen=True, eq=False)
class ShapedMode:
    """A mode, and what of it a fit may change.

    Its free numbers, in this order: where it moves, the logarithm of its decay per sample and, for a pair,
    the logistic number of its angle over pi; then those of the residue, for a pair first all real and then
    all imaginary parts. The residue has either Y U entries, row by row, or as c b the Y of c and the U - 1 of
    b without its largest, which is one. Nothing is checked: `modes_of` makes it of poles inside the circle.

    Attributes
    ----------
    pole : complex
        Real, or the upper one of a pair.
    residue : ndarray, shape (Y, U), complex
        Of whitened outputs, for the inputs behind integrators and delay.
    moves : bool
        The pole is fitted; False: it was given.
    rank_one : bool
        The residue is a product c b.
    """

    pole: complex
    residue: ComplexArray
    moves: bool
    rank_one: bool = True

    @property
    def is_pair(self) -> bool:
        """Whether the pole stands for itself and its conjugate."""
        return self.pole.imag != 0

    @property
    def reals_per_number(self) -> int:
        """Real numbers in a free number of the residue: 2 for a pair."""
        return 2 if self.is_pair else 1

    def saved(self) -> int:
        """Free real numbers that one shape has fewer than a free residue; 0 where the residue is free."""
        if not self.rank_one:
            return 0
        outputs, inputs = self.residue.shape
        return int((outputs - 1) * (inputs - 1) * self.reals_per_number)

    def n_free(self) -> int:
        """Free real numbers of the mode: those of the residue, and of the pole where it moves."""
        outputs, inputs = self.residue.shape
        residue_numbers = outputs + inputs - 1 if self.rank_one else outputs * inputs
        pole_numbers = 1 if self.moves else 0
        return int(self.reals_per_number * (residue_numbers + pole_numbers))

    def largest_input(self) -> int:
        """Index of the input with the largest column of the residue: its share b of the shape is one.

        The first of equals; 0 for a residue of zeros.
        """
        return int(np.argmax(np.linalg.norm(self.residue, axis=0)))

    def pack(self, input_sizes: RealArray) -> RealArray:
        """Free numbers (P,) of pole and residue as they are.

        A residue of higher rank than a shape may have is replaced by the nearest one of rank one, where
        `input_sizes` (U,), above zero, weigh the inputs by how strongly they drive the mode. A pole at zero
        that moves, and a mode without any residue, give infinity or nan: neither is a mode (`modes_of`).
        """
        pole_numbers = []
        if self.moves:
            pole_numbers.append(np.log(-np.log(abs(self.pole))))
            if self.is_pair:
                pole_numbers.append(logit(np.angle(self.pole) / np.pi))
        if self.rank_one:
            # The nearest c b. Its scale goes into c, so that the entry of b is one for the largest input.
            left, size, right = np.linalg.svd(self.residue * input_sizes)
            drive = right[0] / input_sizes
            fixed = self.largest_input()
            shape = left[:, 0] * size[0] * drive[fixed]
            numbers = np.concatenate([shape, np.delete(drive / drive[fixed], fixed)])
        else:
            numbers = self.residue.ravel()
        if self.is_pair:
            return np.concatenate([pole_numbers, numbers.real, numbers.imag])
        return np.concatenate([pole_numbers, numbers.real])

    def at(self, numbers: RealArray) -> _ModeValue:
        """Pole, residue and the residue's slopes at free numbers (P,), laid out as `pack` does.

        Which entry of b is one, and the sign of a real pole, are those of the start. Too few numbers are an
        IndexError or ValueError of NumPy; a decay beyond its bounds counts as the bound.
        """
        pole = self.pole
        if self.moves:
            modulus = np.exp(-np.exp(np.clip(numbers[0], LOWEST_LOG_DECAY, HIGHEST_LOG_DECAY)))
            if self.is_pair:
                pole = modulus * np.exp(1j * np.pi * expit(numbers[1]))
                numbers = numbers[2:]
            else:
                pole = complex(np.copysign(modulus, self.pole.real))
                numbers = numbers[1:]
        # A complex number has two free ones, along 1 and along j.
        units: tuple[complex, ...]
        if self.is_pair:
            half = numbers.size // 2
            values = numbers[:half] + 1j * numbers[half:]
            units = (1.0 + 0j, 1j)
        else:
            values = numbers.astype(np.complex128)
            units = (1.0 + 0j,)

        outputs, inputs = self.residue.shape
        slopes: list[ComplexArray] = []
        if not self.rank_one:
            entries = np.eye(values.size, dtype=np.complex128).reshape(-1, outputs, inputs)
            for unit in units:
                slopes += [unit * entry for entry in entries]
            return _ModeValue(self, complex(pole), values.reshape(outputs, inputs), slopes)

        # d(c b) is dc b + c db.
        fixed = self.largest_input()
        shape = values[:outputs]
        drive = np.insert(values[outputs:], fixed, 1.0)
        for unit in units:
            for output_unit in np.eye(outputs):
                slopes.append(np.asarray(unit * np.outer(output_unit, drive)))
            for input_unit in np.delete(np.eye(inputs), fixed, axis=0):
                slopes.append(np.asarray(unit * np.outer(shape, input_unit)))
        return _ModeValue(self, complex(pole), np.asarray(np.outer(shape, drive)), slopes)


def one_shape_each(
    data: OutputRegressions,
    poles: Poles,
    coefficients: RealArray,
    direct: RealArray,
    *,
    n_fixed: tuple[int, int],
    refused: Refused,
) -> Shaped | None:
    """Refit with one shape per mode, from a fit with free residues.

    Parameters
    ----------
    data : OutputRegressions
        A regression per output, of the same inputs; outputs whitened to noise of power 1.
    poles : Poles
        Of the fit with free residues.
    coefficients : ndarray, shape (Y, U, B)
        Of the basis functions of these poles.
    direct : ndarray, shape (Y, U)
        Direct terms.
    n_fixed : tuple of int
        Real poles and pairs, first of each type, that do not move; those at zero stand for integrators.
    refused : callable
        (residual sum of squares, free numbers saved) -> whether such a fit is refused.

    Returns
    -------
    Shaped or None
        None with one input or output, where a residue has one shape anyway; where poles repeat; and where
        every mode was refused. Shapes are not checked; an input that drives no mode at all is one that the
        caller has refused.
    """
    if min(direct.shape) < 2:
        return None
    try:
        modes = modes_of(poles, coefficients, n_fixed)
    except ValueError:
        return None
    free_modes = [replace(mode, rank_one=False) for mode in modes]
    best = ModalFit(data, free_modes)

    # How far a residue is from rank one: its second singular value over its first, inputs weighed by how
    # strongly they drive the mode.
    remoteness = []
    for mode in free_modes:
        singular_values = np.linalg.svd(mode.residue * best.input_sizes(mode), compute_uv=False)
        remoteness.append(singular_values[1] / max(singular_values[0], TINY))
    for shaped_index in np.argsort(remoteness):
        # This mode gets one shape; the others stay as the last accepted fit has them.
        trial_modes = []
        for index, value in enumerate(best.values()):
            rank_one = value.mode.rank_one or index == int(shaped_index)
            trial_modes.append(replace(value.mode, pole=value.pole, residue=value.residue, rank_one=rank_one))
        trial = ModalFit(data, trial_modes)
        trial.solve()
        if not refused(trial.rss, sum(mode.saved() for mode in trial_modes)):
            best = trial
    if not any(mode.rank_one for mode in best.modes):
        return None
    return best.shaped(poles)


def modes_of(
    poles: Poles, coefficients: RealArray, n_fixed: tuple[int, int], rank_one: Sequence[bool] | None = None
) -> list[ShapedMode]:
    """Modes of a model on the basis of some poles.

    Parameters
    ----------
    poles : Poles
        Of the basis, B of them.
    coefficients : ndarray, shape (Y, U, B)
        Of its functions, for each output and input.
    n_fixed : tuple of int
        Real poles and pairs, first of each type, that do not move.
    rank_one : sequence of bool, optional
        Of each mode: it has one shape; default: all have.

    Returns
    -------
    list of ShapedMode
        Real poles, then pairs. Those at zero are left out: they stand for integrators.

    Raises
    ------
    ValueError
        Poles repeat, so that they have no residue each (`residue_columns`), or `rank_one` has not one entry
        per mode.
    """
    values, columns = residue_columns(poles)
    residues = np.einsum("yub,bm->myu", coefficients, columns)
    fixed_poles = [*poles.real[: n_fixed[0]], *poles.pairs[: n_fixed[1]]]
    # The eigenvalues of the basis come in another order than its poles.
    listed = [pole for pole in (*poles.real, *poles.pairs) if pole != 0]
    shapes = rank_one or [True] * len(listed)
    modes = []
    for pole, has_one_shape in zip(listed, shapes, strict=True):
        nearest = int(np.argmin(np.abs(values - pole)))
        modes.append(ShapedMode(complex(pole), residues[nearest], pole not in fixed_poles, has_one_shape))
    return modes


class ModalFit:
    """Output error of modes driven by the inputs, and its least squares over their free numbers.

    What is linear and has no shape is projected out: nuisance columns of each record, and for every output a
    coefficient of each `linear_rows` row (the inputs where there is a direct term, and the inputs one sample
    later where there are integrators).

    Parameters
    ----------
    data : OutputRegressions
        A regression per output, of the same inputs.
    modes : sequence of ShapedMode
        The start.

    Attributes
    ----------
    u : ndarray, shape (U, N)
        Inputs behind delay and integrators, all records one after the other.
    y : ndarray, shape (Y, N)
        Outputs of the same rows.
    linear_rows : ndarray, shape (Q, N)
        Inputs a sample later, then inputs: U rows of each that the structure asks for; Q = 0, U or 2 U.
    x : ndarray, shape (P,)
        Free numbers of all modes.
    residual : ndarray, shape (Y, N)
        What the modes leave of the outputs, projected off nuisances and linear rows.
    rss : float
        Its sum of squares.
    """

    def __init__(self, data: OutputRegressions, modes: Sequence[ShapedMode]) -> None:
        """Take the modes as they are, and the residual and Jacobian there.

        Raises ValueError without modes; their shapes (Y, U) are to be those of the data, which is not
        checked.
        """
        first = data.each[0]
        self.data = data
        self.modes = modes
        self.u = first.u
        self.segments = first.segments
        self.structure = data.structure
        self.y = np.stack([regression.y for regression in data.each])
        linear_rows: list[RealArray | ComplexArray] = []
        if self.structure.integrators:
            linear_rows.append(self._filtered(0.0, self.u))
        if self.structure.feedthrough:
            linear_rows.append(self.u)
        self.linear_rows: RealArray = np.zeros((0, first.n_samples))
        if linear_rows:
            self.linear_rows = np.real(np.concatenate(linear_rows))
        self._set(np.concatenate([mode.pack(self.input_sizes(mode)) for mode in modes]))

    def _set(self, x: RealArray) -> None:
        """Take free numbers (P,), and the residual (Y, N) and Jacobian (Y N, P) there; the length is not
        checked."""
        residual, jacobian = self._linearised(x)
        self.x = x
        self.residual = residual.reshape(self.y.shape)
        self.rss = float(residual @ residual)
        self._jacobian = jacobian

    def _filtered(self, pole: complex, rows: RealArray | ComplexArray) -> RealArray | ComplexArray:
        """Rows (R, N) through 1/(z - pole), record by record from rest, (R, N).

        A pole outside the circle is not refused: the rows then grow.
        """
        # A real pole leaves real rows real, which is half the work.
        kind: np.dtype[Any] = rows.dtype
        denominator: list[complex] = [1.0, -np.real(pole)]
        if np.imag(pole):
            kind = np.dtype(np.complex128)
            denominator = [1.0, -pole]
        filtered = np.empty(rows.shape, dtype=kind)
        for record_rows in self.segments:
            filtered[:, record_rows] = lfilter([0.0, 1.0], denominator, rows[:, record_rows])
        return filtered

    def solve(self) -> None:
        """Move the free numbers to the least residual, by Levenberg and Marquardt from where they are.

        After `MOST_EVALUATIONS` it stops where it is, without a word. SciPy raises ValueError where there are
        fewer samples of all outputs than free numbers, or where the residual is not finite.
        """
        # SciPy asks for the residual and then for the Jacobian at the same numbers: both come from one pass.
        last: dict[bytes, tuple[RealArray, RealArray]] = {}

        def linearised(x: RealArray) -> tuple[RealArray, RealArray]:
            """Residual (Y N,) and Jacobian (Y N, P) at x (P,), from memory where they were asked for last."""
            if x.tobytes() not in last:
                last.clear()
                last[x.tobytes()] = self._linearised(x)
            return last[x.tobytes()]

        def residual_at(x: RealArray) -> RealArray:
            """Residual (Y N,) at x (P,)."""
            return linearised(x)[0]

        def jacobian_at(x: RealArray) -> RealArray:
            """Jacobian (Y N, P) at x (P,)."""
            return linearised(x)[1]

        solution = least_squares(
            residual_at,
            self.x,
            jac=jacobian_at,
            method="lm",
            x_scale="jac",
            ftol=LEAST_CHANGE,
            xtol=LEAST_CHANGE,
            max_nfev=MOST_EVALUATIONS,
        )
        self._set(solution.x)

    def input_sizes(self, mode: ShapedMode) -> RealArray:
        """How strongly each input drives a mode, (U,): length of the state that it makes of the input.

        Zero for an input that stands at zero.
        """
        return np.asarray(np.linalg.norm(self._filtered(mode.pole, self.u), axis=1))

    def _linearised(self, x: RealArray, *, linear: bool = True) -> tuple[RealArray, RealArray]:
        """Residual (Y N,) and its Jacobian (Y N, P) at free numbers (P,), projected off the nuisances.

        `linear` : off the linear rows of every output, too. `x` is laid out as the modes' `pack` does, one
        after the other: not checked.
        """
        model = np.zeros_like(self.y)
        columns: list[RealArray] = []
        poles: list[complex] = []
        for value in self._values_at(x):
            poles.append(value.pole)
            state = self._filtered(value.pole, self.u)
            model += value.seen(value.residue @ state)
            if value.mode.moves:
                # d/dp of 1/(z - p) is 1/(z - p)^2.
                slope_state = value.residue @ self._filtered(value.pole, state)
                columns += [value.seen(slope * slope_state) for slope in value.pole_slopes()]
            columns += [value.seen(slope @ state) for slope in value.residue_slopes]
        # Residual and columns, output after output, are projected together.
        rows = np.concatenate([(self.y - model)[None], -np.array(columns)]).reshape(-1, self.y.shape[1])
        self._take_out(rows, poles, linear=linear)
        rows = rows.reshape(1 + len(columns), -1)
        return rows[0], rows[1:].T

    def _local_q(self, poles: Sequence[complex]) -> RealArray:
        """Nuisance columns (Ql, N), orthonormal within each record.

        Polynomials (offset, drift of integrators), and free responses of the poles where records may begin in
        motion. Raises ValueError (`Poles`) for a pole that is not inside the circle; the lower pole of a pair
        is not to be among `poles`.
        """
        first = self.data.each[0]
        if not self.structure.estimate_initial_state:
            return first.polynomials_q
        real = [pole.real for pole in poles if pole.imag == 0]
        if self.structure.integrators:
            # The pole at zero that stands for an integrator moves freely, too.
            real.insert(0, 0.0)
        pairs = np.array([pole for pole in poles if pole.imag], dtype=np.complex128)
        return project(first, NO_POLES, Poles(np.array(real), pairs)).local_q

    def _take_out(self, rows: RealArray, poles: Sequence[complex], *, linear: bool = True) -> None:
        """Project rows (R, N) off the nuisances and, with `linear`, off the linear rows, in place.

        `poles` : of the free responses, where records may begin in motion. Rows of another length are a
        ValueError of NumPy.
        """
        first = self.data.each[0]
        local_q = self._local_q(poles)
        first.take_out_local(local_q, rows)
        if len(self.linear_rows) and linear:
            linear_rows = self.linear_rows.copy()
            first.take_out_local(local_q, linear_rows)
            q = np.linalg.qr(linear_rows.T)[0]
            rows -= (rows @ q) @ q.T

    def covariance_factor(self, noise: Sequence[NoiseModel] = ()) -> RealArray:
        """Factor S of the covariance S S^T of all free numbers, to first order.

        Parameters
        ----------
        noise : sequence of NoiseModel, optional
            Of every output, brought to power 1. Default: white noise.

        Returns
        -------
        ndarray, shape (P, P')
            Numbers of the modes, then of every output the coefficients of the linear rows. What the data do
            not show gets zero.

        Raises
        ------
        ValueError
            Noise models of another number than outputs, where one is not white.

        Notes
        -----
        The fit takes noise as white: the covariance is (J^T J)^-1 J^T R J (J^T J)^-1, with R that of the
        noise. R is taken at no frequency below white noise of power 1, for an autoregression does not see
        how little noise there is at low frequencies.
        """
        slopes = self._jacobian
        linear = self._linear_columns()
        factor = _inverse_factor(self._jacobian)
        if len(self.linear_rows):
            # The numbers of the modes take the linear coefficients with them, by the regression of their
            # columns on the linear ones; what is left of the coefficients' errors is independent of them.
            slopes = self._linearised(self.x, linear=False)[1]
            mixed = np.linalg.lstsq(linear, slopes, rcond=None)[0]
            linear_factor = _inverse_factor(linear)
            corner = np.zeros((len(factor), linear_factor.shape[1]))
            factor = np.block([[factor, corner], [mixed @ factor, linear_factor]])
        if all(model.is_white for model in noise):
            return factor

        # Triangle T with T^T T = J^T R J, J with the linear columns, from spectra of the columns. Records are
        # padded to twice their length, so that nothing wraps round.
        columns = np.concatenate([-slopes, linear], axis=1).reshape(*self.y.shape, -1)
        triangle: RealArray = np.zeros((0, columns.shape[2]))
        for output_columns, model in zip(columns, noise, strict=True):
            for record_rows in self.segments:
                size = next_fast_len(2 * (record_rows.stop - record_rows.start), real=True)
                noise_power = np.maximum(model.relative_spectrum(size), 1.0)
                # Half of the lines are computed, and stand for both halves.
                line_weight = noise_power * 2 / size
                spectra = np.fft.rfft(output_columns[record_rows], size, axis=0)
                lines = spectra * np.sqrt(line_weight)[:, None]
                stacked = np.concatenate([triangle, lines.real, lines.imag])
                triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
        return np.asarray(factor @ factor.T @ triangle.T)

    def _linear_columns(self) -> RealArray:
        """Linear columns of all outputs, off the nuisances, (Y N, Y Q): output after output; (Y N, 0) without
        any."""
        n_outputs = self.y.shape[0]
        n_linear = len(self.linear_rows)
        columns = np.zeros((n_outputs * n_linear, *self.y.shape))
        for output in range(n_outputs):
            columns[output * n_linear : (output + 1) * n_linear, output] = self.linear_rows
        rows = columns.reshape(-1, self.y.shape[1])
        if n_linear:
            poles = [value.pole for value in self.values()]
            self.data.each[0].take_out_local(self._local_q(poles), rows)
        return rows.reshape(n_outputs * n_linear, self.y.size).T

    def response_columns(self, omega_rad_s: RealArray) -> ComplexArray:
        """Change of the response with each number of `covariance_factor`, (F, Y, U, P).

        `omega_rad_s` (F,), up to Nyquist (not checked); without integrators and delay, which stand in front
        of the modes. Raises LinAlgError where a pole at z = 1 meets omega = 0; modes have none.
        """
        dynamics, drive, seen = self._one_input()
        z = np.exp(1j * np.asarray(omega_rad_s) * self.data.dt_s)
        states = np.linalg.solve(z[:, None, None] * np.eye(len(dynamics)) - dynamics, drive)[..., 0]
        states_and_input = np.concatenate([states, np.ones((z.size, 1))], axis=1)
        return np.asarray(np.einsum("pyum,fm->fyup", seen, states_and_input))

    def response_states(self) -> tuple[RealArray, RealArray, RealArray]:
        """State space of what `response_columns` gives at frequencies: A (n, n), B (n, U), C (P, Y, n + U).

        C takes states and inputs to what each number of `covariance_factor` changes. Every input drives
        states of its own. Nothing goes in, so nothing is refused.
        """
        dynamics, drive, seen = self._one_input()
        size = len(dynamics)
        each_input = np.eye(self.u.shape[0])
        from_states = seen[..., :size].reshape(*seen.shape[:2], -1)
        from_inputs = seen[..., size]
        return (
            np.asarray(np.kron(each_input, dynamics)),
            np.asarray(np.kron(each_input, drive)),
            np.concatenate([from_states, from_inputs], axis=2),
        )

    def _one_input(self) -> tuple[RealArray, RealArray, RealArray]:
        """State space of what one input drives, and what each number of `covariance_factor` changes.

        A (m, m), B (m, 1), and (P, Y, U, m + 1): the change of each output for each input, seen from the m
        states of that input and the input itself. Inputs as they drive the modes, behind integrators and
        delay. A mode has a state (two for a pair: real and imaginary part) and as many again for 1/(z - p)^2.
        P numbers, those of the modes first; at the free numbers as they are now.
        """
        n_outputs = self.y.shape[0]
        n_inputs = self.u.shape[0]

        # The first state is the input one sample later, for the columns that stand for integrators.
        blocks = [np.zeros((1, 1))]
        drive = [1.0]
        changes: list[_ResponseChange] = []
        for value in self._values_at(self.x):
            is_pair = value.mode.is_pair
            turn = np.zeros((1, 1))
            if is_pair:
                turn = np.array([[0.0, -value.pole.imag], [value.pole.imag, 0.0]])
            size = len(turn)
            dynamics = value.pole.real * np.eye(size) + turn
            blocks.append(np.block([[dynamics, np.zeros_like(dynamics)], [np.eye(size), dynamics]]))
            first_state = len(drive)
            drive += [1.0] + [0.0] * (2 * size - 1)
            if value.mode.moves:
                for slope in value.pole_slopes():
                    changes.append(_ResponseChange(first_state + size, slope * value.residue, is_pair))
            for residue_slope in value.residue_slopes:
                changes.append(_ResponseChange(first_state, residue_slope, is_pair))

        # What each free number of the modes changes.
        n_states = len(drive)
        columns = []
        for change in changes:
            column = np.zeros((n_outputs, n_inputs, n_states + 1))
            column[:, :, change.state] = change.residue.real
            if change.is_pair:
                # Twice the real part of the change times the complex state.
                parts = np.stack([change.residue.real, -change.residue.imag], axis=-1)
                column[:, :, change.state : change.state + 2] = 2 * parts
            columns.append(column)
        # Every coefficient of a linear row: from one input to one output.
        linear_states = []
        if self.structure.integrators:
            linear_states.append(0)
        if self.structure.feedthrough:
            linear_states.append(n_states)
        for output, state, input_ in product(range(n_outputs), linear_states, range(n_inputs)):
            column = np.zeros((n_outputs, n_inputs, n_states + 1))
            column[output, input_, state] = 1.0
            columns.append(column)
        return np.asarray(block_diag(*blocks)), np.array(drive)[:, None], np.array(columns)

    def _values_at(self, x: RealArray) -> Iterator[_ModeValue]:
        """Every mode at free numbers (P,) of all of them; too few raise in `ShapedMode.at`."""
        ends = np.cumsum([mode.n_free() for mode in self.modes])
        for mode, numbers in zip(self.modes, np.split(x, ends[:-1]), strict=True):
            yield mode.at(numbers)

    def values(self) -> list[_ModeValue]:
        """Every mode as it is now, in the order of `modes`: pole and residue (Y, U), in whitened output
        units."""
        return list(self._values_at(self.x))

    def shaped(self, before: Poles) -> Shaped:
        """The fit as coefficients on the basis of the poles as they are now.

        `before` : poles of the fit with free residues; those at zero, which stand for integrators, are taken
        over as they are. Raises ValueError (`residue_columns`) where poles have met, so that they have no
        residue each.
        """
        values = self.values()
        integrator_poles = np.zeros(int(np.sum(before.real == 0)))
        real = [value.pole.real for value in values if value.pole.imag == 0]
        pairs = [value.pole for value in values if value.pole.imag != 0]
        poles = Poles(np.concatenate([integrator_poles, real]), np.array(pairs, complex))

        # Coefficients (Y, Q) of the linear rows: of each output those of the integrators, then direct terms.
        explained = np.zeros_like(self.y)
        for value in values:
            explained += value.seen(value.residue @ self._filtered(value.pole, self.u))
        linear = self._linear_coefficients(self.y - explained, [value.pole for value in values])
        n_outputs = self.y.shape[0]
        n_inputs = self.u.shape[0]
        linear_parts = linear.reshape(n_outputs, -1, n_inputs)
        direct = np.zeros((n_outputs, n_inputs))
        if self.structure.feedthrough:
            direct = linear_parts[:, -1]

        # Residues of all poles (B, Y, U), in the order in which the basis has them.
        basis_poles, columns = residue_columns(poles)
        residues = np.zeros((poles.order, n_outputs, n_inputs), dtype=np.complex128)
        for value in values:
            residues[int(np.argmin(np.abs(basis_poles - value.pole)))] = value.residue
            if value.pole.imag:
                conjugate = int(np.argmin(np.abs(basis_poles - value.pole.conjugate())))
                residues[conjugate] = value.residue.conj()
        if integrator_poles.size:
            residues[int(np.argmin(np.abs(basis_poles)))] = linear_parts[:, 0]
        coefficients = np.real(np.einsum("bm,myu->yub", np.linalg.inv(columns.T), residues))
        return Shaped(
            poles,
            coefficients,
            direct,
            self.residual,
            self.rss,
            rank_one=tuple(mode.rank_one for mode in self.modes),
            saved=sum(mode.saved() for mode in self.modes),
        )

    def _linear_coefficients(self, unexplained: RealArray, poles: list[complex]) -> RealArray:
        """Coefficients (Y, Q) of the linear rows, by least squares beside the nuisances.

        `unexplained` (Y, N) : what the modes leave of the outputs; `poles` : those of the free responses. (Y,
        0) without linear rows; shapes are not checked.
        """
        n_outputs = len(unexplained)
        if not len(self.linear_rows):
            return np.zeros((n_outputs, 0))
        rows = np.concatenate([unexplained, self.linear_rows])
        self.data.each[0].take_out_local(self._local_q(poles), rows)
        solution = np.linalg.lstsq(rows[n_outputs:].T, rows[:n_outputs].T, rcond=None)[0]
        return np.asarray(solution.T)


class _ResponseChange(NamedTuple):
    """Change of the response with one free number of a mode.

    state : index of the state of one input that it is seen from, for a pair of that and the next one
    residue (Y, U) : by which outputs see that state of each input
    is_pair : with the conjugate
    """

    state: int
    residue: ComplexArray
    is_pair: bool


def _inverse_factor(columns: RealArray) -> RealArray:
    """S (P, P) with S S^T = (C^T C)^-1 for columns C (N, P); what the columns do not see gets zero.

    Columns are scaled to one length, so that what counts as unseen has no units. nan raises LinAlgError.
    """
    scale = np.maximum(np.linalg.norm(columns, axis=0), TINY)
    triangle = np.linalg.qr(columns / scale, mode="r")
    return np.asarray(np.linalg.pinv(triangle, rcond=SMALLEST_SEEN) / scale[:, None])
