"""Records made ready for a fit: filtered inputs and outputs of all records, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.structure import Structure, answered, driving_input, stabilised
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression


def prepare(records: Sequence[Record], structure: Structure) -> Regression:
    """Stack single-input single-output records for one fit.

    Raises ValueError as `prepare_inputs`, and if a record has more than one input or output.
    """
    for record in records:
        record.refuse_several()
    return prepare_inputs(records, structure)


def prepare_inputs(records: Sequence[Record], structure: Structure) -> Regression:
    """Stack records of equal inputs and one output for one fit.

    Raises ValueError if there is no record, a record has more than one output, the inputs differ between
    records, or the sampling times differ by more than 0.1 %.
    """
    if not records:
        raise ValueError("identification needs at least one record; got none")
    first, delay = records[0], structure.input_delay_samples
    inputs, outputs, polynomials, starts = [], [], [], [0]
    for record in records:
        if record.output.shape[1] != 1:
            raise ValueError(f"{record.label}: expected one output, got {list(record.output_names)}")
        names = record.input_names
        if max(len(names), len(first.input_names)) > 1 and names != first.input_names:
            raise ValueError(
                f"{record.label}: columns {list(names)}, but the first record has {list(first.input_names)}"
            )
        if not record.sampled_like(first):
            raise ValueError(
                f"{record.label}: dt_s = {record.dt_s:.6g}, but the first record has {first.dt_s:.6g}"
            )
        if record.n_samples <= delay:
            raise ValueError(
                f"{record.label}: {record.n_samples} samples, not more than the input delay {delay}"
            )
        inputs.append([driving_input(u, structure.integrators, delay) for u in record.input.T])
        outputs.append(answered(stabilised(record.output[:, 0], structure.unstable), delay))
        starts.append(starts[-1] + record.n_samples - delay)
        polynomials.append(_legendre(record.n_samples - delay, structure.n_polynomials))
    return Regression(
        u=np.ascontiguousarray(np.concatenate(inputs, axis=1)),
        y=np.concatenate(outputs),
        starts=np.array(starts, dtype=np.int64),
        polynomials=np.ascontiguousarray(np.concatenate(polynomials, axis=1)),
        structure=structure,
        dt_s=first.dt_s,
    )


def restructured(records: Sequence[Record], data: Regression, structure: Structure) -> Regression:
    """`prepare_inputs(records, structure)`, the records having been prepared otherwise: where only nuisances
    differ, their signals are not filtered anew."""
    same = ("integrators", "input_delay_samples")
    if any(getattr(structure, name) != getattr(data.structure, name) for name in same):
        return prepare_inputs(records, structure)
    if structure.n_polynomials == data.structure.n_polynomials:
        return replace(data, structure=structure)
    sizes = np.diff(data.starts)
    polynomials = np.concatenate([_legendre(int(size), structure.n_polynomials) for size in sizes], axis=1)
    return replace(data, structure=structure, polynomials=np.ascontiguousarray(polynomials))


def _legendre(n_samples: int, count: int) -> RealArray:
    """Legendre polynomials of degrees 0 .. count - 1 over a record, (count, T)."""
    if count < 2:
        return np.ones((count, n_samples))
    return np.asarray(
        np.polynomial.legendre.legvander(np.linspace(-1, 1, n_samples), count - 1).T, np.float64
    )


def thinned(records: Sequence[Record], limit: int) -> tuple[list[Record], bool]:
    """Part of the records with about `limit` samples for a search, and whether it starts in mid-record.

    Whole records, evenly chosen, as many as fit; if not even one fits, the most exciting stretch of the
    first.
    """
    total = sum(record.n_samples for record in records)
    if total <= limit:
        return list(records), False
    count = max(1, int(len(records) * limit / total))
    chosen = [records[i] for i in np.linspace(0, len(records), count, endpoint=False).astype(int)]
    if count > 1 or chosen[0].n_samples <= limit:
        return chosen, False
    record = chosen[0]
    starts = range(0, record.n_samples - limit + 1, max(limit // 4, 1))
    # Ties (a periodic or binary input) go to the beginning, where the record may well start from rest.
    power = [float(np.var(record.input[start : start + limit])) for start in starts]
    best = starts[int(np.argmax(np.array(power) > 0.9 * max(power)))]
    return [record.slice(best, best + limit)], best > 0
