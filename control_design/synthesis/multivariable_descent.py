"""Descent of a matrix controller on the worst case over its plants, with exact slopes.

Rows are log gamma of every requirement, plant and frequency (`scaled_bound`); their slope holds the scalings
fixed (envelope theorem). The curvature is that of the rows' sum weighted by their multipliers, from
differences of slopes, so that steps near the end are those of Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from control_design.analysis.stability import NominalLoop
from control_design.plants.ellipses import Complex, Integer, Real
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.scaled_bound import Bound, BoundRows, conjugate, expansion, scaled_bound
from control_design.specification.multivariable import MultivariableSpecification, gram
from control_design.synthesis.minimax_step import minimax_step
from control_design.synthesis.modal_controller import ModalForm

_SHIFT = 1e-5  # of a parameter, in natural units, in the difference quotient of slopes
_ACCURACY = 1e-6  # of gamma in a step
_FIRST_BOX, _LARGEST_BOX, _SMALLEST_BOX = 0.3, 1.0, 1e-4
_LEAST_GAIN = 2e-6  # predicted fall of log gamma^2 that is not worth a step
_FAR_BELOW = 2.0  # rows so far below the worst (log gamma^2) cannot become it within one step
_REACH = 0.5  # of the sum of all slopes: how far a row is taken to rise in a box
_SCALING_BOX = 3.0  # box of log t in that of the parameters
_CUTS, _MISSED = 4, 0.05  # rounds of adding directions; share of the predicted fall that may be missed
_ACTIVE = 1e-4  # share of the largest multiplier below which a row bends nothing


@dataclass(frozen=True, eq=False)
class StackedRows:
    """Rows of all plants and requirements: s (R,), omega (R,), plant and requirement number (R,)."""

    rows: BoundRows
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
    """Every requirement of every plant at the frequencies (F,) of its grid, but for weights on S that
    stronger ones cover."""
    delay = specification.computational_delay_samples
    parts: list[tuple[Complex, ...]] = []
    for number, (plant, omega) in enumerate(zip(plants, grids, strict=True)):
        G, seen, entering = plant.blocks(omega, delay)
        s = tustin_s(omega, plant.dt_s)
        covered = np.zeros((omega.size, plant.outputs))
        for which, (of, weights) in enumerate(specification.weights(plant.inputs, plant.outputs).values()):
            size = gram(weights, s)
            none_y, none_u = (np.zeros((omega.size, n, n)) for n in (plant.outputs, plant.inputs))
            on_y, on_u = (size, none_u) if of == "y" else (none_y, size)
            place = np.full(omega.size, number), np.full(omega.size, which)
            every: tuple[Any, ...] = (G, seen, entering, on_y, on_u, s, omega, *place)
            sizes = np.diagonal(on_y, axis1=1, axis2=2)
            use = np.ones(omega.size, bool) if of == "u" else np.any(sizes > covered, axis=1)
            covered = np.maximum(covered, sizes)
            parts.append(tuple(each[use] for each in every))
    G, seen, entering, on_y, on_u, s, omega, plant_of, which_of = (
        np.concatenate([part[i] for part in parts]) for i in range(9)
    )
    return StackedRows(BoundRows(G, seen, entering, on_y, on_u, together), s, omega, plant_of, which_of)


@dataclass(frozen=True, eq=False)
class _NearWorst:
    """Rows near the worst at a point, each the Hermitian matrix of log H in its eigenvectors, w = Y of them,
    largest first, as real numbers (`_entries`): value (r, w^2), slope (r, w^2, n), in_t (r, w^2, N). basis
    (r, Y, w), top (r,)."""

    index: Integer
    value: Real
    slope: Real
    in_t: Real
    basis: Complex
    top: Real


class MatrixDescent:
    """From any controller with stable nominal loops to a local minimum of the worst case on a grid.

    Largest eigenvalues meet where the worst case is smallest, and have kinks there: a step therefore bounds
    the largest eigenvalue of the linearised matrix, by cuts, with the scalings as unknowns, and one common
    curvature, that of the matrices' sum weighted by their multipliers. Loops stay stable.
    """

    def __init__(self, form: ModalForm, stack: StackedRows, loops: Sequence[NominalLoop]) -> None:
        self.form, self.stack, self.loops = form, stack, tuple(loops)
        self._low, self._high = form.bounds()

    def stable(self, x: Real) -> bool:
        """Whether all nominal loops are."""
        a, b, c, d = self.form.discrete(x)
        return all(np.all(np.abs(loop.poles(a, b, c, d)) < 1.0) for loop in self.loops)

    def bound(self, x: Real, log_t: Real | None) -> Bound | None:
        """Of all rows; None without stability."""
        if not self.stable(x):
            return None
        K = self.form.response(x[None], self.stack.s)[0]
        found = scaled_bound(self.stack.rows, K, log_t, accuracy=_ACCURACY)
        return found if np.all(np.isfinite(found.gamma)) else None

    def run(self, start: Real, steps: int) -> tuple[Real, float, int]:
        """At most `steps` steps: parameters where it ended, worst case on the grid (inf: unstable start),
        steps taken. A step that falls short is corrected to second order, for one evaluation more."""
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        bound = self.bound(x, None)
        if bound is None:
            return x, float("inf"), 0
        box, taken, weights = _FIRST_BOX, 0, None
        best = 2 * float(np.log(np.max(bound.gamma)))
        local: _NearWorst | None = None
        while taken < steps and box > _SMALLEST_BOX:
            if local is None:
                local = self._local(x, bound)
                steepest = np.max(np.abs(local.slope[:, 0]), axis=0)
                unit = np.minimum(self.form.units(x), 1.0 / np.maximum(steepest, 1e-12))
                curvature = self._curvature(x, bound, local, weights, unit)
            taken += 1
            step = self._step(x, local, curvature, unit, box)
            if step is None:
                box *= 0.3
                continue
            move, predicted, multipliers = step
            if predicted < _LEAST_GAIN:
                break
            trial = np.clip(x + move * unit, self._low, self._high)
            after = self.bound(trial, bound.log_t)
            actual = -np.inf if after is None else best - 2 * float(np.log(np.max(after.gamma)))
            if after is not None and actual < 0.7 * predicted:
                again = self._step(x, self._bent(local, move * unit, after, box), curvature, unit, box)
                if again is not None:
                    other = np.clip(x + again[0] * unit, self._low, self._high)
                    there = self.bound(other, after.log_t)
                    gained = -np.inf if there is None else best - 2 * float(np.log(np.max(there.gamma)))
                    if gained > actual:
                        trial, after, actual, multipliers = other, there, gained, again[2]
            if after is not None and actual > 0.02 * predicted:
                outputs = local.basis.shape[1]
                weights = np.zeros((self.stack.s.size, outputs, outputs), dtype=np.complex128)
                # Multipliers in coordinates of the outputs: eigenvectors turn from step to step.
                weights[local.index] = local.basis @ multipliers @ conjugate(local.basis)
                x, bound, best, local = trial, after, best - actual, None
            if actual > 0.7 * predicted:
                box = min(2.0 * box, _LARGEST_BOX)
            elif actual < 0.25 * predicted:
                box *= 0.35
        return x, float(np.exp(0.5 * best)), taken

    def _local(self, x: Real, bound: Bound) -> _NearWorst:
        log = 2 * np.log(bound.gamma)
        index = np.flatnonzero(log > np.max(log) - _FAR_BELOW)
        rows, s = self.stack.rows.part(index), self.stack.s[index]
        found = expansion(rows, self.form.response(x[None], s)[0], bound.log_t[index])
        sizes, vectors = np.linalg.eigh(found.H)
        sizes, basis, top = sizes[:, ::-1], vectors[:, :, ::-1], sizes[:, -1]
        width = sizes.shape[1]
        left, right = found.left @ basis, found.right @ basis

        def slopes(i: int, j: int) -> Complex:
            return np.asarray(self.form.slopes(x[None], s, left[None, :, :, i], right[None, :, :, j])[0])

        above = list(combinations(range(width), 2))
        slope = [2 * slopes(i, i).real for i in range(width)]
        for i, j in above:
            entry = slopes(i, j) + np.conj(slopes(j, i))
            slope += [entry.real, entry.imag]
        turned = conjugate(basis)[:, None] @ found.in_t @ basis[:, None] / top[:, None, None, None]
        value = np.zeros((index.size, width**2))
        value[:, :width] = log[index][:, None] + sizes / top[:, None] - 1.0
        in_t = np.moveaxis(_entries(turned), 1, 2)
        return _NearWorst(index, value, np.stack(slope, axis=1) / top[:, None, None], in_t, basis, top)

    def _bent(self, local: _NearWorst, change: Real, after: Bound, box: float) -> _NearWorst:
        """The rows with what they missed at x + change added: a second-order correction, with which the next
        step from the same point follows a curved edge between rows."""
        width = local.basis.shape[2]
        said, _ = _lowered(local.value + local.slope @ change, local.in_t, _SCALING_BOX * box, width)
        value = local.value.copy()
        value[:, :width] += (2 * np.log(after.gamma[local.index]) - said)[:, None]
        return replace(local, value=value)

    def _curvature(
        self, x: Real, bound: Bound, local: _NearWorst, weights: Complex | None, unit: Real
    ) -> Real:
        """Of the blocks' sum weighted by the multipliers of the step before, in natural units (n, n)."""
        n = x.size
        if weights is None:
            return np.zeros((n, n))
        size = np.trace(weights[local.index], axis1=1, axis2=2).real
        use = np.flatnonzero(size > _ACTIVE * np.max(size, initial=1e-300))
        index = local.index[use]
        rows, s = self.stack.rows.part(index), self.stack.s[index]
        # W = sum_k w_k w_k^H, so that tr(W dH) = 2 Re sum_k (left w_k)^H dK (right w_k).
        sizes, axes = np.linalg.eigh(weights[index])
        factors = axes * np.sqrt(np.maximum(sizes, 0.0) / local.top[use][:, None])[:, None, :]

        def gradient(points: Real) -> Real:
            count = points.shape[0]
            copies = np.tile(np.arange(index.size), count)
            K = self.form.response(points, s)
            found = expansion(rows.part(copies), K.reshape(-1, *K.shape[2:]), bound.log_t[index][copies])
            left, right = found.left @ factors[copies], found.right @ factors[copies]
            total = np.zeros((count, n))
            for k in range(factors.shape[2]):
                pair = [each[:, :, k].reshape(count, index.size, -1) for each in (left, right)]
                total += 2 * np.sum(self.form.slopes(points, s, *pair).real, axis=1)
            return total

        points = np.vstack([x[None], x + _SHIFT * np.diag(unit)])
        found = gradient(points)
        change = (found[1:] - found[0]) * unit / _SHIFT
        sizes, axes = np.linalg.eigh(0.5 * (change + change.T))
        return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)

    def _step(
        self, x: Real, local: _NearWorst, curvature: Real, unit: Real, box: float
    ) -> tuple[Real, float, Complex] | None:
        """Step (n,) in natural units, predicted fall of log gamma^2, multipliers (r, w, w); None where it
        fails. Rows are u^H M u for directions u of every matrix; the worst are added in rounds."""
        value, change, fall = local.value, local.slope * unit, local.in_t
        width = local.basis.shape[2]
        best = float(np.max(value[:, 0]))
        reach = _REACH * box * np.sum(np.abs(change), axis=2)
        near = np.flatnonzero(value[:, 0] + reach[:, 0] > best - box)
        rows, sides = [near], [np.eye(width, dtype=np.complex128)[np.zeros(near.size, dtype=int)]]
        for number, (i, j) in enumerate(combinations(range(width), 2)):
            apart = change[:, width + 2 * number : width + 2 * number + 2]
            off = 2 * _REACH * box * np.sum(np.hypot(apart[:, 0], apart[:, 1]), axis=1)
            both = near[(value[:, j] + reach[:, j] + off > best - box)[near]]
            for factor in (1.0, -1.0, 1j, -1j):
                u = np.zeros(width, dtype=np.complex128)
                u[i], u[j] = np.sqrt(0.5), np.sqrt(0.5) * factor
                rows.append(both)
                sides.append(np.tile(u, (both.size, 1)))
        at, u = np.concatenate(rows), np.concatenate(sides)
        pairs = np.unique(at[near.size :])
        low, high = np.maximum(-box, (self._low - x) / unit), np.minimum(box, (self._high - x) / unit)
        none = np.zeros((0, x.size)), np.zeros(0)
        found = None
        room = _SCALING_BOX * box  # for each log t in the same step
        for _ in range(_CUTS if pairs.size else 1):
            factors = _weights(u)
            level = np.einsum("ri,ri->r", factors, value[at])
            if width > 1:  # the scalings lower a row as far as they may
                level -= room * np.sum(np.abs(np.einsum("ri,rin->rn", factors, fall[at])), axis=1)
            found = minimax_step(
                level, np.einsum("ri,rin->rn", factors, change[at]), curvature, low, high, *none
            )
            if found is None or not pairs.size:
                break
            worst, turned = _lowered(value[pairs] + change[pairs] @ found.step, fall[pairs], room, width)
            cut = worst - found.level > _MISSED * max(best - found.level, 0.0)
            if not np.any(cut):
                break
            at, u = np.concatenate([at, pairs[cut]]), np.vstack([u, turned[cut]])
        if found is None:
            return None
        d, given = found.step, found.multipliers
        used = u[: given.size]
        multipliers = np.zeros((value.shape[0], width, width), dtype=np.complex128)
        np.add.at(
            multipliers, at[: given.size], given[:, None, None] * used[:, :, None] * np.conj(used[:, None, :])
        )
        return d, best - found.level - 0.5 * float(d @ curvature @ d), multipliers


def _entries(matrix: Complex) -> Real:
    """Hermitian matrices (..., w, w) as real numbers (..., w^2): diagonal, then real and imaginary part of
    each entry above it."""
    width = matrix.shape[-1]
    found = [matrix[..., i, i].real for i in range(width)]
    for i, j in combinations(range(width), 2):
        found += [matrix[..., i, j].real, matrix[..., i, j].imag]
    return np.stack(found, axis=-1)


def _weights(u: Complex) -> Real:
    """Of `_entries` in u^H M u, (r, w^2) for directions u (r, w)."""
    width = u.shape[1]
    found = [np.abs(u[:, i]) ** 2 for i in range(width)]
    for i, j in combinations(range(width), 2):
        product = 2 * np.conj(u[:, i]) * u[:, j]
        found += [product.real, -product.imag]
    return np.stack(found, axis=1)


def _matrix(entries: Real, width: int) -> Complex:
    """Inverse of `_entries`."""
    found = np.zeros((*entries.shape[:-1], width, width), dtype=np.complex128)
    for i in range(width):
        found[..., i, i] = entries[..., i]
    for number, (i, j) in enumerate(combinations(range(width), 2)):
        entry = entries[..., width + 2 * number] + 1j * entries[..., width + 2 * number + 1]
        found[..., i, j], found[..., j, i] = entry, np.conj(entry)
    return found


def _lowered(value: Real, fall: Real, room: float, width: int) -> tuple[Real, Complex]:
    """Largest eigenvalue (r,) of matrices with entries value (r, w^2), lowered by moves within +-room along
    fall (r, w^2, N), and its eigenvector (r, w): sections of one scaling at a time."""
    shift = np.zeros((value.shape[0], fall.shape[2]))

    def largest(by: Real) -> Real:
        at = value + np.einsum("rin,rn->ri", fall, by)
        if width == 2:
            apart = np.hypot(at[:, 0] - at[:, 1], 2 * np.hypot(at[:, 2], at[:, 3]))
            return np.asarray(0.5 * (at[:, 0] + at[:, 1] + apart))
        return np.asarray(np.linalg.eigvalsh(_matrix(at, width))[:, -1])

    for i in list(range(shift.shape[1])) * (1 if shift.shape[1] == 1 else 2):
        low, high = np.full(value.shape[0], -room), np.full(value.shape[0], room)
        for _ in range(14):
            left, right = shift.copy(), shift.copy()
            left[:, i], right[:, i] = low + 0.45 * (high - low), low + 0.55 * (high - low)
            smaller = largest(left) < largest(right)
            low, high = np.where(smaller, low, left[:, i]), np.where(smaller, right[:, i], high)
        shift[:, i] = 0.5 * (low + high)
    sizes, axes = np.linalg.eigh(_matrix(value + np.einsum("rin,rn->ri", fall, shift), width))
    return sizes[:, -1], axes[:, :, -1]
