"""The polynomial methods that GOBF models are compared with: ARX (FIR is its case na = 0), ARMAX and OE.

All of them take one single-input single-output record; offsets are not estimated, so subtract means where a
signal has one. `delay_samples` = 1 (the default) is a plant without direct term.
"""

from __future__ import annotations

import numpy as np

from ident.basis.structure import filter_input
from ident.comparators.polynomial_model import PolynomialModel
from ident.comparators.prediction_error import (
    arx_polynomials,
    best_end,
    monic,
    prediction_errors,
    shifted,
    steiglitz_mcbride,
)
from ident.comparators.stable_sections import stabilised
from ident.data.arrays import RealArray
from ident.data.record import Record

_ONE = np.ones(1)


def arx(record: Record, na: int, nb: int, *, delay_samples: int = 1) -> PolynomialModel:
    """A y = B u + e by linear least squares: na coefficients in A, nb in B.

    The first max(na, nb - 1) samples of the record serve as past only. Biased when the noise is not 1/A
    filtered white noise. Raises ValueError for orders or a record that cannot be used.
    """
    u, y = _signals(record, delay_samples, {"na": (na, 0), "nb": (nb, 1)})
    a, b = arx_polynomials(u, y, na, nb)
    return PolynomialModel(a, b, _ONE, _ONE).of(record, delay_samples, "ARX")


def oe(
    record: Record, nb: int, nf: int, *, delay_samples: int = 1, arx_start: bool = True
) -> PolynomialModel:
    """y = (B / F) u + e by prediction-error minimisation: nb coefficients in B, nf in F, F stable.

    Best of the local searches from Steiglitz-McBride and, with `arx_start`, from ARX (slower, and hardly
    ever better); the record starts from rest. The minimum is local. Raises ValueError for orders or a record
    that cannot be used.
    """
    u, y = _signals(record, delay_samples, {"nb": (nb, 1), "nf": (nf, 0)})
    starts = [steiglitz_mcbride(u, y, nb, nf)]
    if arx_start:
        a, b = arx_polynomials(u, y, nf, nb)
        starts.append(PolynomialModel(_ONE, b, _ONE, stabilised(a)))
    return best_end(starts, u, y).of(record, delay_samples, "OE")


def armax(
    record: Record, na: int, nb: int, nc: int, *, delay_samples: int = 1, output_error_start: bool = True
) -> PolynomialModel:
    """A y = B u + C e by prediction-error minimisation: na, nb, nc coefficients, C stable (A need not be).

    Best of the local searches from ARX, from two-stage least squares (innovations of a long ARX model as a
    second input) and, with `output_error_start`, from Steiglitz-McBride with C = A; the record starts
    from rest. The minimum is local: without the third start, which common toolboxes do not try, lightly
    damped modes under white output noise are usually missed. Raises ValueError for orders or a record that
    cannot be used.
    """
    orders = {"na": (na, 0), "nb": (nb, 1), "nc": (nc, 0)}
    u, y = _signals(record, delay_samples, orders)
    a, b = arx_polynomials(u, y, na, nb)
    starts = [PolynomialModel(a, b, monic(np.zeros(nc)), _ONE), _two_stage(u, y, na, nb, nc)]
    if output_error_start:
        found = steiglitz_mcbride(u, y, nb, na)
        c = np.zeros(nc + 1)
        shared = min(nc, na) + 1
        c[:shared] = found.f[:shared]
        starts.append(PolynomialModel(found.f, found.b, stabilised(c), _ONE))
    return best_end(starts, u, y).of(record, delay_samples, "ARMAX")


def _two_stage(u: RealArray, y: RealArray, na: int, nb: int, nc: int) -> PolynomialModel:
    """ARMAX start by least squares with the innovations of a long ARX model in place of e."""
    long = max(na, nb, nc, min(4 * max(na, nb, nc, 1), (y.size - 1) // 3))
    e = prediction_errors(PolynomialModel(*arx_polynomials(u, y, long, long), _ONE, _ONE), u, y)
    past = [-shifted(y, range(1, na + 1)), shifted(u, range(nb)), shifted(e, range(1, nc + 1))]
    theta = np.linalg.lstsq(np.hstack(past)[long:], y[long:])[0]
    a, b, c = np.split(theta, [na, na + nb])
    return PolynomialModel(monic(a), b, stabilised(monic(c)), _ONE)


def _signals(
    record: Record, delay_samples: int, orders: dict[str, tuple[int, int]]
) -> tuple[RealArray, RealArray]:
    """Delayed u and y, (T,) each; ValueError if orders (value, least) or the record do not fit together.

    The first samples of the record, as many as an equation looks back, give none.
    """
    for name, (value, least) in ({"delay_samples": (delay_samples, 0)} | orders).items():
        if not (isinstance(value, (int, np.integer)) and value >= least):
            raise ValueError(f"{name} must be a whole number, at least {least}; got {value!r}")
    if record.input.shape[1] != 1 or record.output.shape[1] != 1:
        raise ValueError(f"{record.label}: expected one input and one output; choose with siso(...)")
    unknowns = sum(value for value, _ in orders.values())
    past = max(orders[key][0] - (key == "nb") for key in orders if key != "nc")
    equations = max(record.n_samples - past, 0)
    if not equations > unknowns:
        raise ValueError(
            f"{record.label}: {equations} equations for {unknowns} unknowns; expected more samples"
        )
    return filter_input(record.input[:, 0], 0, delay_samples), record.output[:, 0]
