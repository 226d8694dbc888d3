"""Descent of a matrix controller on the worst case over its plants, with exact slopes.

Rows are log gamma of every requirement, plant and frequency (`scaled_bound`); their slope holds the scalings
fixed (envelope theorem). The curvature is that of the rows' sum weighted by their multipliers, from
differences of slopes, so that steps near the end are those of Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from control_design.analysis.stability import NominalLoop
from control_design.plants.ellipses import Complex, Integer, Real
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.scaled_bound import Bound, Rows, conjugate, expansion, scaled_bound
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
_SMALL_BOX = 0.02  # of the step whose multipliers weigh the rows
_NEAR = 0.3  # log gamma^2 below the worst, of the rows that a new block must not raise
_CUTS, _MISSED = 4, 0.05  # rounds of adding directions; share of the predicted fall that may be missed
_ACTIVE = 1e-4  # share of the largest multiplier below which a row bends nothing


@dataclass(frozen=True, eq=False)
class StackedRows:
    """Rows of all plants and requirements: s (R,), omega (R,), plant and requirement number (R,)."""

    rows: Rows
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
    return StackedRows(Rows(G, seen, entering, on_y, on_u, together), s, omega, plant_of, which_of)


@dataclass(frozen=True, eq=False)
class _Local:
    """Rows near the worst at a point, each a Hermitian 2 x 2 block in the two largest eigenvectors of H over
    its largest eigenvalue: block (r, 2, 2) complex, its logarithmic value; slopes (r, 3, n): first and second
    diagonal entry and the entry above them (complex); in_t (r, 3, N) alike. basis (r, Y, 2), top (r,)."""

    index: Integer
    block: Complex
    slope: Complex
    in_t: Complex
    basis: Complex
    top: Real


@dataclass(frozen=True, eq=False)
class Pull:
    """What a change dK of the controller does to first order where a descent ended, at r frequencies s (r,):
    the worst log gamma^2 changes by the sum of 2 Re tr(on_K dK), on_K (r, Y, U), and that of one row by
    2 Re(left^H dK right), left (r, U), right (r, Y)."""

    s: Complex
    on_K: Complex
    left: Complex
    right: Complex


class MatrixDescent:
    """From any controller with stable nominal loops to a local minimum of the worst case on a grid.

    Largest eigenvalues meet where the worst case is smallest, and have kinks there: a step therefore bounds
    the linearised 2 x 2 block of the two largest (a second-order cone), with the scalings as unknowns, and
    one common curvature, that of the blocks' sum weighted by their multipliers. Loops stay stable.
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
        found = scaled_bound(self.stack.rows, K, log_t, accuracy=_ACCURACY, within=_FAR_BELOW)
        return found if np.all(np.isfinite(found.gamma)) else None

    def run(self, start: Real, steps: int) -> tuple[Real, float, int]:
        """At most `steps` steps: parameters where it ended, worst case on the grid (inf: unstable start),
        steps taken."""
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        bound = self.bound(x, None)
        if bound is None:
            return x, float("inf"), 0
        box, taken, weights = _FIRST_BOX, 0, None
        best = 2 * float(np.log(np.max(bound.gamma)))
        local: _Local | None = None
        while taken < steps and box > _SMALLEST_BOX:
            if local is None:
                local = self._local(x, bound)
                steepest = np.max(np.abs(local.slope[:, 0].real), axis=0)
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
            if after is not None and actual > 0.02 * predicted:
                weights = np.zeros((self.stack.s.size, 2, 2), dtype=np.complex128)
                # Multipliers in coordinates of the outputs: eigenvectors turn from step to step.
                weights[local.index] = local.basis @ multipliers @ conjugate(local.basis)
                x, bound, best, local = trial, after, best - actual, None
            if actual > 0.7 * predicted:
                box = min(2.0 * box, _LARGEST_BOX)
            elif actual < 0.25 * predicted:
                box *= 0.35
        return x, float(np.exp(0.5 * best)), taken

    def pull(self, x: Real) -> Pull | None:
        """Multipliers of a small step give the weights of the rows; None without stability or a step."""
        bound = self.bound(x, None)
        if bound is None:
            return None
        local = self._local(x, bound)
        steepest = np.max(np.abs(local.slope[:, 0].real), axis=0)
        unit = np.minimum(self.form.units(x), 1.0 / np.maximum(steepest, 1e-12))
        step = self._step(x, local, np.zeros((x.size, x.size)), unit, _SMALL_BOX)
        if step is None:
            return None
        rows, s = self.stack.rows.part(local.index), self.stack.s[local.index]
        found = expansion(rows, self.form.response(x[None], s)[0], bound.log_t[local.index])
        left, right = found.left @ local.basis, found.right @ local.basis / local.top[:, None, None]
        on_K = right @ step[2] @ conjugate(left)
        near = local.block[:, 0, 0].real > np.max(local.block[:, 0, 0].real) - _NEAR
        return Pull(s[near], on_K[near], left[near, :, 0], right[near, :, 0])

    def _local(self, x: Real, bound: Bound) -> _Local:
        log = 2 * np.log(bound.gamma)
        index = np.flatnonzero(log > np.max(log) - _FAR_BELOW)
        rows, s = self.stack.rows.part(index), self.stack.s[index]
        K = self.form.response(x[None], s)[0]
        found = expansion(rows, K, bound.log_t[index])
        sizes, vectors = np.linalg.eigh(found.H)
        width = min(2, sizes.shape[1])
        basis, top = vectors[:, :, ::-1][:, :, :width], sizes[:, -1]
        block = np.zeros((index.size, width, width), dtype=np.complex128)
        for i in range(width):
            block[:, i, i] = log[index] + sizes[:, -1 - i] / top - 1.0
        left, right = found.left @ basis, found.right @ basis

        def slopes(i: int, j: int) -> Complex:
            return np.asarray(self.form.slopes(x[None], s, left[None, :, :, i], right[None, :, :, j])[0])

        turned = conjugate(basis)[:, None] @ found.in_t @ basis[:, None] / top[:, None, None, None]
        slope: list[Any] = [2 * slopes(0, 0).real]
        in_t: list[Any] = [turned[:, :, 0, 0].real]
        if width == 2:
            slope += [2 * slopes(1, 1).real, slopes(0, 1) + np.conj(slopes(1, 0))]
            in_t += [turned[:, :, 1, 1].real, turned[:, :, 0, 1]]
        return _Local(
            index, block, np.stack(slope, axis=1) / top[:, None, None], np.stack(in_t, axis=1), basis, top
        )

    def _curvature(self, x: Real, bound: Bound, local: _Local, weights: Complex | None, unit: Real) -> Real:
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
        self, x: Real, local: _Local, curvature: Real, unit: Real, box: float
    ) -> tuple[Real, float, Complex] | None:
        """Step (n,) in natural units, predicted fall of log gamma^2, multipliers (r, 2, 2); None where it
        fails. Rows are u^H block u for directions u of every block; the worst are added in rounds."""
        block, slope = local.block, local.slope * unit
        wide = slope.shape[1] == 3
        best = float(np.max(block[:, 0, 0].real))
        # Entries (r, 3 or 1) as real numbers: half the trace, and the Bloch vector m of the block.
        value = (
            _bloch(block[:, 0, 0], block[:, 1, 1], block[:, 0, 1]) if wide else block[:, 0, 0].real[:, None]
        )
        change = _bloch(slope[:, 0], slope[:, 1], slope[:, 2]) if wide else slope.real
        reach = _REACH * box * np.sum(np.abs(slope), axis=2)
        near = np.flatnonzero(block[:, 0, 0].real + reach[:, 0] > best - box)
        pairs, fall = near[:0], np.zeros((0, 4, 0))
        rows, directions = near, np.zeros((near.size, 0))
        if wide:
            fall = _bloch(local.in_t[:, 0], local.in_t[:, 1], local.in_t[:, 2])  # (r, 4, N)
            second = block[:, 1, 1].real + reach[:, 1] + 2 * reach[:, 2] > best - box
            pairs = near[second[near]]
            rows = np.concatenate([near, *[pairs] * 4])
            sides = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
            directions = np.vstack(
                [np.tile([0.0, 0, 1], (near.size, 1)), np.repeat(sides, pairs.size, axis=0)]
            )
        low, high = np.maximum(-box, (self._low - x) / unit), np.minimum(box, (self._high - x) / unit)
        none = np.zeros((0, x.size)), np.zeros(0)
        found = None
        room = _SCALING_BOX * box  # for each log t in the same step
        for _ in range(_CUTS if pairs.size else 1):
            factors = np.hstack([np.ones((rows.size, 1)), 0.5 * directions])
            at = np.einsum("ri,ri->r", factors, value[rows])
            if wide:  # the scalings lower a row as far as they may
                at -= room * np.sum(np.abs(np.einsum("ri,rin->rn", factors, fall[rows])), axis=1)
            slopes = np.einsum("ri,rin->rn", factors, change[rows])
            found = minimax_step(at, slopes, curvature, low, high, *none)
            if found is None or not pairs.size:
                break
            m = value[pairs] + change[pairs] @ found.step
            worst, turned = _lowered(m, fall[pairs], room)
            cut = worst - found.level > _MISSED * max(best - found.level, 0.0)
            if not np.any(cut):
                break
            rows, directions = np.concatenate([rows, pairs[cut]]), np.vstack([directions, turned[cut]])
        if found is None:
            return None
        d = found.step
        multipliers = np.zeros(block.shape, dtype=np.complex128)
        given = found.multipliers
        rows = rows[: given.size]
        if wide:
            v = directions[: given.size]
            below = v[:, 0] + 1j * v[:, 1]
            entries = np.stack([1 + v[:, 2], np.conj(below), below, 1 - v[:, 2]], axis=1).reshape(-1, 2, 2)
            np.add.at(multipliers, rows, 0.5 * given[:, None, None] * entries)
        else:
            multipliers[rows, 0, 0] = given
        return d, best - found.level - 0.5 * float(d @ curvature @ d), multipliers


def _bloch(first: Complex, second: Complex, above: Complex) -> Real:
    """Half the trace and Bloch vector m, on axis 1: u^H block u = half trace + v m / 2 with v the Bloch
    vector of u."""
    parts = (first + second) / 2, 2 * above, 2j * above, first - second
    return np.stack(parts, axis=1).real


def _lowered(m: Real, fall: Real, room: float) -> tuple[Real, Real]:
    """Largest eigenvalue (r,) of blocks half trace + Bloch vector m (r, 4), lowered by moves within +-room
    along fall (r, 4, N), and the direction (r, 3) of its eigenvector: sections of one scaling at a time."""
    shift = np.zeros((m.shape[0], fall.shape[2]))

    def moved(by: Real) -> Real:
        return np.asarray(m + np.einsum("rin,rn->ri", fall, by))

    def largest(by: Real) -> Real:
        at = moved(by)
        return np.asarray(at[:, 0] + 0.5 * np.linalg.norm(at[:, 1:], axis=1))

    for i in list(range(shift.shape[1])) * (1 if shift.shape[1] == 1 else 2):
        low, high = np.full(m.shape[0], -room), np.full(m.shape[0], room)
        for _ in range(14):
            left, right = shift.copy(), shift.copy()
            left[:, i], right[:, i] = low + 0.45 * (high - low), low + 0.55 * (high - low)
            smaller = largest(left) < largest(right)
            low, high = np.where(smaller, low, left[:, i]), np.where(smaller, right[:, i], high)
        shift[:, i] = 0.5 * (low + high)
    at = moved(shift)[:, 1:]
    return largest(shift), at / np.maximum(np.linalg.norm(at, axis=1), 1e-300)[:, None]
