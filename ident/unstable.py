"""Poles of a plant outside the unit circle, from logs of a loop that is closed around it.

The predictor y = M y + N u + e, M and N on one GOBF basis, is stable whatever the plant is, and unbiased in
a loop where e is white. G = N / (1 - M): its poles outside the circle are zeros of 1 - M. The poles of the
basis are those of the noise model. Start: those zeros themselves, mirrored into the circle, over and over
(Steiglitz and McBride, IEEE TAC 10(4), 1965), which ends at white sensor noise; then by least squares of e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.functions import basis_response
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import NO_POLES, Poles
from ident.basis.structure import Structure, filter_input
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression, project
from ident.fit.regression import prepare_inputs, thinned
from ident.search.pole_search import PoleSearch

# Numbers of real poles and pairs that are tried; the criterion of the order chooses.
_STRUCTURES = ((2, 0), (2, 1), (2, 2), (2, 3), (2, 4))
_ROUNDS = 10
_ROUGH = 1e-4
# Standard deviations beyond the circle: one in a million stable plants.
_BEYOND = 5.0
# Slower than one time constant in the longest record, growth is no other than an integrator and drift.
_TIME_CONSTANTS = 1.0
_ON_CIRCLE = 1 - 1e-7


def find_unstable(records: Sequence[Record], options: IdentOptions | None = None) -> Poles:
    """Mirror images 1 / conj(p) of the unstable poles p that these records show; none where they show none.

    records: of one input and output. options: of the fit to come, which `options.with_unstable(...)` then has
    made with what is found here. A pole is kept if its growth is significant, the residual counted for as
    many samples as its colour is worth. Raises ValueError as `ident.fit.regression.prepare_inputs`.

    Neglected: what friction in the input does to the noise model; take it off first (`ident.friction`).
    """
    options = options or IdentOptions()
    both = [_with_output(record, options.input_delay_samples) for record in records]
    part = _prepared(thinned(both, options.search_samples)[0])
    starts = [_mirrored_often(part, n_real, n_pairs) for n_real, n_pairs in _STRUCTURES]
    ends = [PoleSearch(part, IdentOptions()).descend(poles, "predictor", _ROUGH) for poles in starts]
    worth = part.n_samples
    best = min(
        ends, key=lambda end: worth * np.log(end.rss) + part.n_parameters(end.poles.order) * np.log(worth)
    )
    data = _prepared(both)
    return _significant(data, PoleSearch(data, IdentOptions()).descend(best.poles, "predictor", _ROUGH).poles)


def _with_output(record: Record, delay_samples: int) -> Record:
    """The record with its delayed input, and its output as a second one."""
    record.refuse_several()
    signals = np.column_stack([filter_input(record.input[:, 0], 0, delay_samples), record.output[:, 0]])
    return replace(record, input=signals, input_names=("input", "output"), input_units=())


def _prepared(records: Sequence[Record]) -> Regression:
    return prepare_inputs(records, Structure(estimate_offset=True, estimate_initial_state=True))


def _predictor(data: Regression, poles: Poles) -> tuple[GobfModel, RealArray, float]:
    """1 - M and the coefficients of N at the best fit on these poles, and its residual sum of squares."""
    fitted = project(data, poles)
    n, m = np.split(fitted.coefficients(data.y), [poles.order])
    return GobfModel(poles, -m, data.dt_s, 1.0), n, float(fitted.residual @ fitted.residual)


def _mirrored_often(data: Regression, n_real: int, n_pairs: int) -> Poles:
    """Poles of the basis after rounds in which zeros of 1 - M take their place; those of the best round."""
    slowest, fastest = 2 / (data.longest * data.dt_s), 0.3 / data.dt_s
    poles = Poles.from_continuous(
        decay_per_s=np.geomspace(slowest, fastest, n_real + 2)[1:-1],
        omega_rad_s=np.geomspace(4 * slowest, fastest, n_pairs + 2)[1:-1],
        zeta=[0.3] * n_pairs,
        dt_s=data.dt_s,
    )
    best = np.inf, poles
    for _ in range(_ROUNDS):
        denominator, _, rss = _predictor(data, poles)
        best = min(best, (rss, poles), key=lambda pair: pair[0])
        zeros = denominator.zeros()
        size = np.maximum(np.abs(zeros), np.finfo(np.float64).tiny)
        mirrored = zeros / size * np.minimum(np.minimum(size, 1 / size), _ON_CIRCLE)
        # A zero at infinity was left out.
        poles = _poles(np.append(mirrored, np.zeros(poles.order - zeros.size)))
    return best[1]


def _poles(values: ComplexArray) -> Poles:
    return Poles(values[values.imag == 0].real, values[values.imag > 0])


def _significant(data: Regression, poles: Poles) -> Poles:
    """Mirror images of the zeros of 1 - M that are poles outside the circle beyond doubt.

    To first order a zero p moves by -d(1 - M)(p) / (1 - M)'(p), poles of the basis moving as they like: every
    one twice. A zero that N shares, be it by chance, is no pole.
    """
    denominator, numerator, rss = _predictor(data, poles)
    zeros = denominator.zeros()
    double = poles.doubled()
    fitted = project(data, double, poles)
    worth = data.colour(fitted.residual).effective_samples - 2 * double.order
    if not worth > 0:
        return NO_POLES
    inverse = np.linalg.pinv(fitted.triangle, rcond=1e-12) * np.sqrt(rss / worth)
    of_n, of_m = inverse[: double.order], inverse[double.order :]
    kept = []
    for zero in zeros[(np.abs(zeros) > 1) & (zeros.imag >= 0)]:
        # Value, first and second derivative from differences: analytic outside the circle.
        away = 0.01 * (np.abs(zero) - 1)
        differences = np.array([[0, 1, 0], [-0.5, 0, 0.5], [1, -2, 1]]) / away ** np.arange(3)[:, None]
        near, free = (
            differences @ basis_response(basis, zero + away * np.arange(-1, 2)) for basis in (poles, double)
        )
        (_, m1, m2), (n0, n1, _) = near @ denominator.coefficients, near @ numerator
        by_m, by_n = -free @ of_m, free @ of_n
        moves = -by_m[0] / m1
        # Residue n0 / m1 of G: its relative change.
        residue = (by_n[0] + n1 * moves) / n0 - (by_m[1] + m2 * moves) / m1
        growth, spread = float(np.log(np.abs(zero))), float(np.linalg.norm((moves / zero).real))
        least = max(_BEYOND * spread, _TIME_CONSTANTS / data.longest)
        if growth > least and _BEYOND * np.linalg.norm(residue) < 1:
            kept.append(1 / zero.conjugate())
    return _poles(np.array(kept, dtype=np.complex128))
