"""Poles of a plant outside the unit circle, from logs of a loop that is closed around it.

The predictor y = M y + N u + e, M and N on one GOBF basis, is stable, and unbiased in a loop where e is
white. G = N / (1 - M): its poles outside the circle are zeros of 1 - M. The poles of the basis start at those
zeros, mirrored into the circle, over and over (Steiglitz and McBride, IEEE TAC 10(4), 1965), and end at least
squares of e.
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
from ident.checks.prior_tests import ROUGH
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression, project
from ident.fit.regression import prepare, prepare_inputs, thinned
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import PoleSearch

# Numbers of real poles and pairs that are tried; the criterion of the order chooses.
_STRUCTURES = ((2, 0), (2, 1), (2, 2), (2, 3), (2, 4))
_ROUNDS = 10  # limit of work: the best one counts
# Standard deviations beyond the circle: one in a million stable plants.
_BEYOND = 5.0
# Slower than one time constant in the longest record, growth is no other than an integrator and drift.
_TIME_CONSTANTS = 1.0
_ON_CIRCLE = 1 - 1e-7  # a time constant of ten million samples


def find_unstable(records: Sequence[Record], options: IdentOptions | None = None) -> Poles:
    """Mirror images 1 / conj(p) of the unstable poles p that these records of one input and output show.

    options: of the fit to come, which takes them by `options.with_unstable`. A pole is kept if its growth is
    significant for the samples that the residual is worth. Raises ValueError as
    `ident.fit.regression.prepare_inputs`. Neglected: friction in the input, which `ident.friction` takes off
    first.
    """
    options = options or IdentOptions()
    both = [_with_output(record, options.input_delay_samples) for record in records]
    poles = _predictor_poles(_prepared(thinned(both, options.search_samples)[0]))
    data = _prepared(both)
    return _significant(data, PoleSearch(data, IdentOptions()).descend(poles, "predictor", ROUGH).poles)


def quick_poles(records: Sequence[Record], options: IdentOptions | None = None) -> Poles:
    """Poles between a stable input and output with a direct term, without a search: zeros of 1 - M, those
    taken out again that the criterion of the order does not mind."""
    part = thinned(records, (options or IdentOptions()).search_samples)[0]
    data = _prepared([_with_output(record, -1) for record in part])
    start = _inside(_predictor(data, _predictor_poles(data))[0].zeros())
    structure = Structure(feedthrough=True, estimate_offset=True, estimate_initial_state=True)
    search = PoleSearch(prepare(part, structure), IdentOptions(feedthrough=True))
    return OrderSelection(search).pruned(search.descend(start, "loop", ROUGH)).poles


def _predictor_poles(data: Regression) -> Poles:
    """Poles of the basis: of the structure that the criterion of the order chooses."""
    starts = [_mirrored_often(data, n_real, n_pairs) for n_real, n_pairs in _STRUCTURES]
    ends = [PoleSearch(data, IdentOptions()).descend(poles, "predictor", ROUGH) for poles in starts]
    worth = float(np.log(data.n_samples))
    return min(
        ends, key=lambda end: data.n_samples * np.log(end.rss) + data.n_parameters(end.poles.order) * worth
    ).poles


def _with_output(record: Record, delay_samples: int) -> Record:
    """The record with its delayed input (or the next one, -1), and its output as another."""
    record.refuse_several()
    u, y = record.input[:, 0], record.output[:, 0]
    u = np.append(u[1:], u[-1]) if delay_samples < 0 else filter_input(u, 0, delay_samples)
    return replace(record, input=np.column_stack([y, u]), input_names=("output", "input"), input_units=())


def _prepared(records: Sequence[Record]) -> Regression:
    return prepare_inputs(records, Structure(estimate_offset=True, estimate_initial_state=True))


def _predictor(data: Regression, poles: Poles) -> tuple[GobfModel, RealArray, float]:
    """1 - M and the coefficients of N at the best fit on these poles, and its residual sum of squares."""
    fitted = project(data, poles)
    m, n = fitted.coefficients(data.y)[: 2 * poles.order].reshape(2, -1)
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
        mirrored = _inside(denominator.zeros())
        # A zero at infinity was left out.
        poles = mirrored.appended(Poles(np.zeros(poles.order - mirrored.order)))
    return best[1]


def _inside(zeros: ComplexArray) -> Poles:
    """Those outside the circle mirrored into it."""
    size = np.maximum(np.abs(zeros), np.finfo(np.float64).tiny)
    return _poles(zeros / size * np.minimum(np.minimum(size, 1 / size), _ON_CIRCLE))


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
    of_m, of_n = inverse[: double.order], inverse[double.order : 2 * double.order]
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
