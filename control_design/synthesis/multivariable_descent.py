"""Descent of a matrix controller on the worst case over its plants, with exact slopes.

The worst case of several joints is the largest of many rows: log gamma^2 of every requirement, plant and
frequency, by the bound over scalings of `scaled_bound`. `stacked_rows` puts them in one stack,
`MatrixDescent` minimises the largest. gamma^2 of a row is the largest eigenvalue of a Hermitian matrix H,
and where the worst case is smallest several eigenvalues meet, so that the row has a kink. A step therefore
bounds the largest eigenvalue of the linearised matrix, by u^H H u <= s for several directions u.

Slopes of H in the controller's parameters hold the optimal scalings fixed (envelope theorem). The curvature
is that of the matrices' sum weighted by the multipliers of the step before, from differences of slopes, so
that steps near the end are those of Newton's method. Every step is one `minimax_step` in a box, whose size
follows from what the step before gained of what it promised.

In shapes: R rows of the stack, r of them near the worst, n parameters, w = Y outputs (the size of H), U
actuators, N blocks of uncertainty with one scaling log t each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from control_design.analysis.stability import NominalLoop
from control_design.plants.ellipses import Complex, Integer, Real
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.scaled_bound import Bound, BoundRows, conjugate, expansion, scaled_bound
from control_design.specification.multivariable import MultivariableSpecification, gram
from control_design.synthesis.minimax_step import (
    ACCEPTED_SHARE,
    FIRST_BOX,
    SMALLEST_BOX,
    adapted_box,
    minimax_step,
)
from control_design.synthesis.modal_controller import ModalForm

# "Doubled" says by how much the worst case rises of problem T of `benchmarks.mimo_designs` at order 4, for
# a full and for a decentralised controller, after six rounds of eight steps.

# Shift of a parameter in the difference quotient of slopes, in natural units. The quotient errs by about the
# shift times the third derivative, and by rounding over the shift: 1e-5 and 1e-11.
_SHIFT = 1e-5
# Relative accuracy of gamma in a step: that of the least gain that is worth one.
_ACCURACY = 1e-6
# Factor on the box where the programme of a step fails, mostly by rounding. Chosen; seven of them end a
# descent.
_SHORTER = 0.3
# Predicted fall of log gamma^2 that is not worth a step: 1e-6 of gamma, as accurate as it is known.
_LEAST_GAIN = 2e-6
# Rows so far below the worst, in log gamma^2, are left out of a step: they cannot become it within one.
# Doubled: 4 % and nothing.
_FAR_BELOW = 2.0
# How far a row is taken to rise within a box, over the sum of all its slopes times the box. All parameters at
# the edge of the box, each in the row's direction of ascent, would be 1. Doubled: 13 % and nothing.
_REACH = 0.5
# Box of a scaling log t, over that of the parameters: scalings follow the controller freely. Doubled: 2 and
# 5 %.
_SCALING_BOX = 3.0
# Programmes that are solved for a step at most, each with the directions u that the one before lacked.
# Doubled: nothing.
_CUTS = 4
# Share of the predicted fall by which the largest eigenvalue may exceed the programme's level; beyond it, a
# direction is added. Doubled: 6 and 2 %.
_MISSED = 0.05
# Share of the largest multiplier below which a row does not enter the curvature, which each row makes dearer.
# Doubled: nothing.
_ACTIVE = 1e-4
# A step that gains less than this share of what it promised is corrected to second order. Chosen: it is the
# share above which the box grows.
_CORRECTED_BELOW = 0.7
# Least steepest slope by a parameter: no division by zero where no row near the worst depends on it. Its unit
# is that of the form then.
_NO_SLOPE = 1e-12
# Sections of an interval in the search for a scaling: each leaves .55 of it, 14 of them 2e-4.
_SECTIONS = 14
# Left inner point of the interval, as a share of it; where the value is larger here, the right part stays.
_LEFT_SECTION = 0.45

# Right inner point. The two parts overlap by a tenth, so that a minimum between the points is in both.
# Chosen.
_RIGHT_SECTION = 0.55


@dataclass(frozen=True, eq=False)
class StackedRows:
    """Rows of all plants and requirements on their grids.

    Attributes
    ----------
    rows : BoundRows
        R rows, as `scaled_bound` takes them: plant G (R, Y, U), Gram matrices `seen` (R, N, U, U) and
        `entering` (R, N, Y, Y) of how each block sees the actuators and enters the outputs, and V_y (R, Y,
        Y), V_u (R, U, U) of the weights on outputs and actuators.
    s : ndarray, shape (R,)
        Tustin's s, rad/s, at the row's frequency, where `ModalForm.response` evaluates K.
    omega_rad_s : ndarray, shape (R,)
        The row's frequency. Built by `stacked_rows`; no shape is checked.
    plant : ndarray, shape (R,)
        Number of the row's plant.
    requirement : ndarray, shape (R,)
        Number of the row's requirement, in the order of `MultivariableSpecification.weights`.
    """

    rows: BoundRows
    s: Complex
    omega_rad_s: Real
    plant: Real
    requirement: Real


class _RowArrays(NamedTuple):
    """Arrays of some rows, first axis: rows; named as in `BoundRows` and `StackedRows`.

    G (r, Y, U), seen (r, N, U, U), entering (r, N, Y, Y), V_y (r, Y, Y), V_u (r, U, U); the others (r,).
    """

    G: Complex
    seen: Complex
    entering: Complex
    V_y: Real
    V_u: Real
    s: Complex
    omega_rad_s: Real
    plant: Real
    requirement: Real


def stacked_rows(
    plants: Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    grids: Sequence[Real],
    *,
    together: bool = False,
) -> StackedRows:
    """Every requirement of every plant at the frequencies of its grid.

    Parameters
    ----------
    plants : sequence of MultivariablePlant
        Nominal plant, ball and errors of channels; at least one, all of U inputs and Y outputs (not checked
        here: the caller's `Programme` has).
    specification : MultivariableSpecification
        Weights of each requirement, on S (outputs) or on K S (actuators).
    grids : sequence of ndarray, shape (F,)
        Of each plant, rad/s, positive and below Nyquist, where Tustin's s is infinite (not checked).
    together : bool
        As of `BoundRows`: uncertainty grows with 1 / gamma (mu) instead of keeping its size.

    Returns
    -------
    StackedRows
        Without rows of weights on S that an earlier requirement covers in every output.

    Raises
    ------
    ValueError
        Plants and grids differ in number, or a ball that is known on its own frequencies only is asked at
        another one.
    """
    delay = specification.computational_delay_samples
    parts: list[_RowArrays] = []
    for number, (plant, omega) in enumerate(zip(plants, grids, strict=True)):
        G, seen, entering = plant.blocks(omega, delay)
        s = tustin_s(omega, plant.dt_s)
        nothing_on_y = np.zeros((omega.size, plant.outputs, plant.outputs))
        nothing_on_u = np.zeros((omega.size, plant.inputs, plant.inputs))
        # Largest weight on S so far, by frequency and output.
        covered = np.zeros((omega.size, plant.outputs))
        requirements = specification.weights(plant.inputs, plant.outputs).values()
        for which, (channel_kind, weights) in enumerate(requirements):
            size = gram(weights, s)
            if channel_kind == "u":
                on_y, on_u = nothing_on_y, size
                use = np.ones(omega.size, bool)
            else:
                on_y, on_u = size, nothing_on_u
                sizes = np.diagonal(on_y, axis1=1, axis2=2)
                use = np.any(sizes > covered, axis=1)
                covered = np.maximum(covered, sizes)
            plant_number = np.full(omega.size, number)
            requirement_number = np.full(omega.size, which)
            every = (G, seen, entering, on_y, on_u, s, omega, plant_number, requirement_number)
            parts.append(_RowArrays._make(array[use] for array in every))
    joined = _RowArrays._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    rows = BoundRows(joined.G, joined.seen, joined.entering, joined.V_y, joined.V_u, together)
    return StackedRows(rows, joined.s, joined.omega_rad_s, joined.plant, joined.requirement)


@dataclass(frozen=True, eq=False)
class _NearWorst:
    """First-order model of the r rows near the worst at one point.

    Each row is the Hermitian matrix M of log H, in the eigenvectors of H at that point, largest first. Its
    w^2 real numbers are ordered as `_entries` does: the diagonal, then real and imaginary parts above it. At
    least one row, as the worst one is near itself; nothing is checked.

    Attributes
    ----------
    index : ndarray, shape (r,)
        Number of the row in the stack.
    value : ndarray, shape (r, w^2)
        M; its largest eigenvalue is log gamma^2.
    slope : ndarray, shape (r, w^2, n)
        dM by parameter.
    in_t : ndarray, shape (r, w^2, N)
        dM by log t of each scaling.
    basis : ndarray, shape (r, w, w)
        Eigenvectors of H in coordinates of the outputs, as columns.
    top : ndarray, shape (r,)
        Largest eigenvalue of H: gamma^2.
    """

    index: Integer
    value: Real
    slope: Real
    in_t: Real
    basis: Complex
    top: Real


class _Move(NamedTuple):
    """A step (n,) in natural units, the predicted fall of log gamma^2, and multipliers (r, w, w).

    The multipliers of one row are sum_u z_u u u^H over its directions u (w,), in the row's basis, with z_u
    the multiplier of the programme's row u^H M u <= s; all z_u add up to one.
    """

    step: Real
    predicted: float
    multipliers: Complex


class MatrixDescent:
    """From any controller with stable nominal loops to a local minimum of the worst case on a grid.

    All nominal loops stay stable at every step.

    Parameters
    ----------
    form : ModalForm
        Response and slopes of K (U, Y) in parameters (n,), and their bounds and natural units.
    stack : StackedRows
        Of the lean grid.
    loops : sequence of NominalLoop
        One for each plant: its `poles(A, B, C, D)` are the closed-loop poles in z under a discrete
        controller.

    Notes
    -----
    The parts are not checked against one another: `Programme` builds them from one specification.
    """

    def __init__(self, form: ModalForm, stack: StackedRows, loops: Sequence[NominalLoop]) -> None:
        """Keep the arguments, and the bounds (n,) of the parameters; nothing is checked."""
        self.form = form
        self.stack = stack
        self.loops = tuple(loops)
        self._low, self._high = form.bounds()

    def stable(self, x: Real) -> bool:
        """Whether all nominal loops are stable under parameters x (n,): poles strictly inside the circle.

        False for an algebraic loop, whose pole is infinite.
        """
        a, b, c, d = self.form.discrete(x)
        return all(np.all(np.abs(loop.poles(a, b, c, d)) < 1.0) for loop in self.loops)

    def bound(self, x: Real, log_t: Real | None) -> Bound | None:
        """Worst case of every row.

        Parameters
        ----------
        x : ndarray, shape (n,)
        log_t : ndarray, shape (R, N), or None
            Scalings to begin with; None: from the sizes of the blocks.

        Returns
        -------
        Bound or None
            gamma (R,), scalings log_t (R, N), worst output (R, Y). None where a nominal loop is unstable, or
            some row shows no robust stability.
        """
        if not self.stable(x):
            return None
        K = self.form.response(x[None], self.stack.s)[0]
        bound = scaled_bound(self.stack.rows, K, log_t, accuracy=_ACCURACY)
        return bound if np.all(np.isfinite(bound.gamma)) else None

    def run(self, start: Real, steps: int) -> tuple[Real, float, int]:
        """Descend from a start.

        Parameters
        ----------
        start : ndarray, shape (n,)
            Clipped to the bounds of the form first.
        steps : int
            At most; steps that are not accepted count.

        Returns
        -------
        x : ndarray, shape (n,)
            Parameters where it ended.
        gamma : float
            Worst case on the grid there; inf: the start is not robustly stable, and x is the clipped start.
        taken : int
            Steps taken.

        Notes
        -----
        A step that falls short of its prediction is corrected to second order, for one evaluation more.
        """
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        bound = self.bound(x, None)
        if bound is None:
            return x, float("inf"), 0
        best = _largest_log(bound)
        box = FIRST_BOX
        taken = 0
        multipliers: Complex | None = None
        local: _NearWorst | None = None
        while taken < steps and box > SMALLEST_BOX:
            # The model of a point serves all steps from it, in smaller and smaller boxes.
            if local is None:
                local = self._local(x, bound)
                # No unit is longer than what changes some row's log gamma^2 by one.
                steepest = np.max(np.abs(local.slope[:, 0]), axis=0)
                unit = np.minimum(self.form.units(x), 1.0 / np.maximum(steepest, _NO_SLOPE))
                curvature = self._curvature(x, bound, local, multipliers, unit)
            taken += 1
            move = self._step(x, local, curvature, unit, box)
            if move is None:
                box *= _SHORTER
                continue
            predicted = move.predicted
            if predicted < _LEAST_GAIN:
                break
            change = move.step * unit
            trial = np.clip(x + change, self._low, self._high)
            after = self.bound(trial, bound.log_t)
            actual = _fall(best, after)

            # Second-order correction: the step again, with the rows as they are at its end.
            if after is not None and actual < _CORRECTED_BELOW * predicted:
                bent = self._bent(local, change, after, box)
                second_move = self._step(x, bent, curvature, unit, box)
                if second_move is not None:
                    second_trial = np.clip(x + second_move.step * unit, self._low, self._high)
                    second_after = self.bound(second_trial, after.log_t)
                    second_actual = _fall(best, second_after)
                    if second_actual > actual:
                        move = second_move
                        trial = second_trial
                        after = second_after
                        actual = second_actual

            if after is not None and actual > ACCEPTED_SHARE * predicted:
                outputs = local.basis.shape[1]
                # In coordinates of the outputs: eigenvectors turn from step to step.
                multipliers = np.zeros((self.stack.s.size, outputs, outputs), dtype=np.complex128)
                multipliers[local.index] = local.basis @ move.multipliers @ conjugate(local.basis)
                x = trial
                bound = after
                best = best - actual
                local = None
            box = adapted_box(box, actual, predicted)
        return x, float(np.exp(0.5 * best)), taken

    def _local(self, x: Real, bound: Bound) -> _NearWorst:
        """First-order model of the rows near the worst at parameters x (n,).

        bound: at x; its gamma (R,), finite and positive, says which rows are near, its log_t (R, N) are the
        scalings that are held.
        """
        log = 2 * np.log(bound.gamma)
        index = np.flatnonzero(log > np.max(log) - _FAR_BELOW)
        rows = self.stack.rows.part(index)
        s = self.stack.s[index]
        K = self.form.response(x[None], s)[0]
        first_order = expansion(rows, K, bound.log_t[index])

        # Eigenvectors of H, the largest eigenvalue first, and dH = left^H dK right + (.)^H in them.
        ascending, vectors = np.linalg.eigh(first_order.H)
        sizes = ascending[:, ::-1]
        basis = vectors[:, :, ::-1]
        top = ascending[:, -1]
        width = sizes.shape[1]
        left = first_order.left @ basis
        right = first_order.right @ basis

        def slopes(i: int, j: int) -> Complex:
            """left_i^H dK right_j by parameter, (r, n), of eigenvectors i and j of each row."""
            by_parameter = self.form.slopes(x[None], s, left[None, :, :, i], right[None, :, :, j])
            return np.asarray(by_parameter[0])

        # d log H = dH / top at the largest eigenvalue; the others are expanded alike, about log top.
        slope_entries = [2 * slopes(i, i).real for i in range(width)]
        for i, j in combinations(range(width), 2):
            entry = slopes(i, j) + np.conj(slopes(j, i))
            slope_entries += [entry.real, entry.imag]
        slope = np.stack(slope_entries, axis=1) / top[:, None, None]
        turned = conjugate(basis)[:, None] @ first_order.in_t @ basis[:, None]
        relative_turned = turned / top[:, None, None, None]
        in_t = np.moveaxis(_entries(relative_turned), 1, 2)
        log_of_rows = log[index]
        relative_sizes = sizes / top[:, None]
        value = np.zeros((index.size, width**2))
        value[:, :width] = log_of_rows[:, None] + relative_sizes - 1.0
        return _NearWorst(index, value, slope, in_t, basis, top)

    def _bent(self, local: _NearWorst, change: Real, after: Bound, box: float) -> _NearWorst:
        """Model of the rows with what it missed at x + change (n,) added to its values.

        A second-order correction: the next step from the same point follows a curved edge between rows.
        after: the bound at x + change, with gamma finite; box: half width, in natural units.
        """
        width = local.basis.shape[2]
        at_change = local.value + local.slope @ change
        predicted, _ = _lowered(at_change, local.in_t, _SCALING_BOX * box, width)
        missed = 2 * np.log(after.gamma[local.index]) - predicted
        value = local.value.copy()
        value[:, :width] += missed[:, None]
        return replace(local, value=value)

    def _curvature(
        self, x: Real, bound: Bound, local: _NearWorst, multipliers: Complex | None, unit: Real
    ) -> Real:
        """Second derivative (n, n), in natural units, of the rows' sum weighted by multipliers (R, w, w).

        The multipliers are those of the step before, in coordinates of the outputs; None: the first step,
        which is taken without curvature. Negative curvature is left out, so that the programme is convex.
        bound and local are those of x; unit (n,) are natural units. Where no row of the model has a
        multiplier the result is zero.
        """
        n = x.size
        if multipliers is None:
            return np.zeros((n, n))
        # 1e-300: an empty model has no largest one.
        size = np.trace(multipliers[local.index], axis1=1, axis2=2).real
        use = np.flatnonzero(size > _ACTIVE * np.max(size, initial=1e-300))
        index = local.index[use]
        rows = self.stack.rows.part(index)
        s = self.stack.s[index]
        # With W = sum_k w_k w_k^H a row's share is tr(W dH) = 2 Re sum_k (left w_k)^H dK (right w_k).
        weights, axes = np.linalg.eigh(multipliers[index])
        top = local.top[use]
        roots = np.sqrt(np.maximum(weights, 0.0) / top[:, None])
        factors = axes * roots[:, None, :]

        def gradient(points: Real) -> Real:
            """Slopes (P, n) of the weighted sum at points (P, n), all in one call, with the scalings held."""
            count = points.shape[0]
            copies = np.tile(np.arange(index.size), count)
            K = self.form.response(points, s)
            K_of_rows = K.reshape(-1, *K.shape[2:])
            first_order = expansion(rows.part(copies), K_of_rows, bound.log_t[index][copies])
            left = first_order.left @ factors[copies]
            right = first_order.right @ factors[copies]
            total = np.zeros((count, n))
            for k in range(factors.shape[2]):
                left_k = left[:, :, k].reshape(count, index.size, -1)
                right_k = right[:, :, k].reshape(count, index.size, -1)
                slopes = self.form.slopes(points, s, left_k, right_k)
                total += 2 * np.sum(slopes.real, axis=1)
            return total

        points = np.vstack([x[None], x + _SHIFT * np.diag(unit)])
        gradients = gradient(points)
        change = (gradients[1:] - gradients[0]) * unit / _SHIFT
        symmetric = 0.5 * (change + change.T)
        curvatures, directions = np.linalg.eigh(symmetric)
        scaled_directions = directions * np.maximum(curvatures, 0.0)
        return np.asarray(scaled_directions @ directions.T)

    def _step(self, x: Real, local: _NearWorst, curvature: Real, unit: Real, box: float) -> _Move | None:
        """Step from x (n,) within a box, with the smallest largest row of the model; None where it fails.

        curvature (n, n) is in natural units (unit, (n,)), in which the box is stated. Rows of the programme
        are u^H M u for directions u of every matrix M; the worst directions are added in rounds. None where
        `minimax_step` fails, mostly by rounding.
        """
        value = local.value
        change = local.slope * unit
        fall = local.in_t
        width = local.basis.shape[2]
        best = float(np.max(value[:, 0]))

        # First directions: the largest eigenvector of every row that may become the worst ..
        reach = _REACH * box * np.sum(np.abs(change), axis=2)
        highest = value[:, 0] + reach[:, 0]
        near = np.flatnonzero(highest > best - box)
        axes = np.eye(width, dtype=np.complex128)
        first_axis = axes[np.zeros(near.size, dtype=int)]
        rows = [near]
        directions = [first_axis]
        # .. and four directions between two eigenvectors, where the second may become the worst.
        for number, (i, j) in enumerate(combinations(range(width), 2)):
            first = width + 2 * number
            real_part = change[:, first]
            imaginary_part = change[:, first + 1]
            size = np.hypot(real_part, imaginary_part)
            off_reach = 2 * _REACH * box * np.sum(size, axis=1)
            highest = value[:, j] + reach[:, j] + off_reach
            may_meet = highest > best - box
            meeting = near[may_meet[near]]
            for factor in (1.0, -1.0, 1j, -1j):
                between = np.zeros(width, dtype=np.complex128)
                between[i] = np.sqrt(0.5)
                between[j] = np.sqrt(0.5) * factor
                rows.append(meeting)
                directions.append(np.tile(between, (meeting.size, 1)))
        at = np.concatenate(rows)
        u = np.concatenate(directions)
        # Only where eigenvalues may meet are further directions looked for.
        pairs = np.unique(at[near.size :])

        low = np.maximum(-box, (self._low - x) / unit)
        high = np.minimum(box, (self._high - x) / unit)
        no_rows = np.zeros((0, x.size))
        no_limits = np.zeros(0)
        scaling_room = _SCALING_BOX * box
        solution = None
        for _ in range(_CUTS if pairs.size else 1):
            factors = _weights(u)
            level = np.einsum("ri,ri->r", factors, value[at])
            if width > 1:
                # Scalings lower a row as far as they may.
                by_scaling = np.abs(np.einsum("ri,rin->rn", factors, fall[at]))
                level -= scaling_room * np.sum(by_scaling, axis=1)
            row_slope = np.einsum("ri,rin->rn", factors, change[at])
            solution = minimax_step(level, row_slope, curvature, low, high, no_rows, no_limits)
            if solution is None or not pairs.size:
                break
            # Largest eigenvalues at the step: where one exceeds the programme's, its direction is added.
            matrices = value[pairs] + change[pairs] @ solution.step
            worst, eigenvectors = _lowered(matrices, fall[pairs], scaling_room, width)
            cut = worst - solution.level > _MISSED * max(best - solution.level, 0.0)
            if not np.any(cut):
                break
            at = np.concatenate([at, pairs[cut]])
            u = np.vstack([u, eigenvectors[cut]])
        if solution is None:
            return None

        # Directions that were added after the last solution have no multiplier.
        step = solution.step
        count = solution.multipliers.size
        used = u[:count]
        weighted = solution.multipliers[:, None, None] * used[:, :, None]
        projectors = weighted * np.conj(used[:, None, :])
        multipliers = np.zeros((value.shape[0], width, width), dtype=np.complex128)
        np.add.at(multipliers, at[:count], projectors)
        predicted = best - solution.level - 0.5 * float(step @ curvature @ step)
        return _Move(step, predicted, multipliers)


def _largest_log(bound: Bound) -> float:
    """log gamma^2 of the worst row; -inf where every gamma is 0."""
    return 2 * float(np.log(np.max(bound.gamma)))


def _fall(before: float, after: Bound | None) -> float:
    """Fall of the worst log gamma^2 from `before`; -inf where the loop is not robustly stable any more."""
    return -np.inf if after is None else before - _largest_log(after)


def _entries(matrix: Complex) -> Real:
    """Real numbers (..., w^2) of Hermitian matrices (..., w, w).

    The diagonal, then real and imaginary part of each entry above it, row by row; what stands below the
    diagonal is not looked at, so that a matrix is taken as Hermitian.
    """
    width = matrix.shape[-1]
    numbers = [matrix[..., i, i].real for i in range(width)]
    for i, j in combinations(range(width), 2):
        numbers += [matrix[..., i, j].real, matrix[..., i, j].imag]
    return np.stack(numbers, axis=-1)


def _weights(u: Complex) -> Real:
    """Weights (r, w^2) with which u^H M u is a sum of M's `_entries` (r, w^2), for directions u (r, w) of any
    length."""
    width = u.shape[1]
    weights = [np.abs(u[:, i]) ** 2 for i in range(width)]
    for i, j in combinations(range(width), 2):
        # 2 Re(conj(u_i) M_ij u_j)
        product = 2 * np.conj(u[:, i]) * u[:, j]
        weights += [product.real, -product.imag]
    return np.stack(weights, axis=1)


def _matrix(entries: Real, width: int) -> Complex:
    """Hermitian matrices (..., w, w) with given `_entries` (..., w^2); width is w. Fewer entries are an
    IndexError, further ones are left out."""
    matrix = np.zeros((*entries.shape[:-1], width, width), dtype=np.complex128)
    for i in range(width):
        matrix[..., i, i] = entries[..., i]
    for number, (i, j) in enumerate(combinations(range(width), 2)):
        first = width + 2 * number
        entry = entries[..., first] + 1j * entries[..., first + 1]
        matrix[..., i, j] = entry
        matrix[..., j, i] = np.conj(entry)
    return matrix


def _lowered(value: Real, fall: Real, room: float, width: int) -> tuple[Real, Complex]:
    """Largest eigenvalues (r,) of matrices, lowered by their scalings, and the eigenvectors (r, w).

    value (r, w^2) are the entries of the matrices, fall (r, w^2, N) their slopes by log t; each log t moves
    within +-room, room >= 0. One scaling after the other is set by a search in sections (the largest
    eigenvalue is convex in it), several scalings twice; width is w. Nothing is checked.
    """
    shift = np.zeros((value.shape[0], fall.shape[2]))

    def largest(by: Real) -> Real:
        """Largest eigenvalue (r,) with scalings log t moved by (r, N)."""
        at = value + np.einsum("rin,rn->ri", fall, by)
        if width == 2:
            # In closed form: a fraction of the time of a general solver.
            first = at[:, 0]
            second = at[:, 1]
            off_diagonal = np.hypot(at[:, 2], at[:, 3])
            apart = np.hypot(first - second, 2 * off_diagonal)
            return np.asarray(0.5 * (first + second + apart))
        return np.asarray(np.linalg.eigvalsh(_matrix(at, width))[:, -1])

    scalings = list(range(shift.shape[1]))
    # A second sweep where they depend on each other.
    sweeps = 1 if len(scalings) == 1 else 2
    for i in scalings * sweeps:
        low = np.full(value.shape[0], -room)
        high = np.full(value.shape[0], room)
        for _ in range(_SECTIONS):
            left = shift.copy()
            left[:, i] = low + _LEFT_SECTION * (high - low)
            right = shift.copy()
            right[:, i] = low + _RIGHT_SECTION * (high - low)
            smaller = largest(left) < largest(right)
            low = np.where(smaller, low, left[:, i])
            high = np.where(smaller, right[:, i], high)
        shift[:, i] = 0.5 * (low + high)
    lowered = value + np.einsum("rin,rn->ri", fall, shift)
    sizes, axes = np.linalg.eigh(_matrix(lowered, width))
    return sizes[:, -1], axes[:, :, -1]
