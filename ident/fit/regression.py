"""Records made ready for a fit: filtered inputs and outputs of all records, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ident.basis.structure import Structure, filter_input
from ident.data.arrays import RealArray
from ident.data.record import Record


@dataclass(frozen=True, eq=False)
class Regression:
    """Everything a fit needs but the poles.

    Attributes
    ----------
    u : (N,) array
        Inputs after delay and integrators. The first `input_delay_samples` rows of a record are left out: the
        input they answer to was not recorded.
    y : (N,) array
        Outputs of the same rows.
    starts : (K + 1,) int array
        Record i owns the rows starts[i]:starts[i + 1].
    polynomials : (Q, N) array
        Per-record polynomial nuisance columns, as rows (Legendre, degrees 0 .. Q - 1).
    structure : Structure
    dt_s : float
    """

    u: RealArray
    y: RealArray
    starts: npt.NDArray[np.int64]
    polynomials: RealArray
    structure: Structure
    dt_s: float

    @cached_property
    def polynomials_q(self) -> RealArray:
        """The polynomial columns made orthonormal within each record, (Q, N)."""
        rows = np.zeros_like(self.polynomials)
        if len(rows) == 1:  # constants, by far the most common: no factorisation
            for here in map(self.segment, range(self.n_records)):
                rows[0, here] = 1 / np.sqrt(here.stop - here.start)
            return rows
        for here in map(self.segment, range(self.n_records)):
            q, _ = np.linalg.qr(self.polynomials[:, here].T)
            rows[: q.shape[1], here] = q.T
        return rows

    @cached_property
    def y_clear(self) -> RealArray:
        """The outputs without their part in the polynomial columns, (N,)."""
        y, rows = self.y.copy(), self.polynomials_q
        if len(rows) == 0:
            return y
        for here in map(self.segment, range(self.n_records)):
            y[here] -= rows[:, here].T @ (rows[:, here] @ y[here])
        return y

    @property
    def n_samples(self) -> int:
        """Number of rows N over all records."""
        return int(self.y.size)

    @property
    def n_records(self) -> int:
        return int(self.starts.size - 1)

    @property
    def longest(self) -> int:
        """Rows of the longest record."""
        return int(np.max(np.diff(self.starts)))

    def segment(self, record: int) -> slice:
        return slice(int(self.starts[record]), int(self.starts[record + 1]))

    def n_parameters(self, order: int) -> int:
        """Number of free real numbers of a fit with `order` poles: coefficients, poles, nuisances."""
        local = self.polynomials.shape[0] + (order if self.structure.estimate_initial_state else 0)
        return int(2 * order + self.structure.feedthrough + self.n_records * local)


def prepare(records: Sequence[Record], structure: Structure) -> Regression:
    """Stack single-input single-output records for one fit.

    Raises
    ------
    ValueError
        If there is no record, a record has more than one input or output, or the sampling times differ by
        more than 0.1 %.
    """
    if not records:
        raise ValueError("identification needs at least one record; got none")
    dt_s = records[0].dt_s
    inputs, outputs, polynomials, starts = [], [], [], [0]
    for record in records:
        if record.input.shape[1] != 1 or record.output.shape[1] != 1:
            raise ValueError(
                f"{record.label}: identification takes one input and one output, got "
                f"{list(record.input_names)} "
                f"and {list(record.output_names)}; choose with Record.siso"
            )
        if not abs(record.dt_s - dt_s) <= 1e-3 * dt_s:
            raise ValueError(f"{record.label}: dt_s = {record.dt_s:.6g}, but the first record has {dt_s:.6g}")
        delay = structure.input_delay_samples
        if record.n_samples <= delay:
            raise ValueError(
                f"{record.label}: {record.n_samples} samples, not more than the input delay {delay}"
            )
        u = filter_input(record.input[:, 0], structure.integrators, delay)[delay:]
        inputs.append(u)
        outputs.append(record.output[delay:, 0])
        polynomials.append(_legendre(u.size, structure.n_polynomials))
        starts.append(starts[-1] + u.size)
    return Regression(
        u=np.concatenate(inputs),
        y=np.concatenate(outputs),
        starts=np.array(starts, dtype=np.int64),
        polynomials=np.ascontiguousarray(np.concatenate(polynomials, axis=1)),
        structure=structure,
        dt_s=dt_s,
    )


def restructured(records: Sequence[Record], data: Regression, structure: Structure) -> Regression:
    """`prepare(records, structure)`, the records having been prepared otherwise: where only nuisances differ,
    their signals are not filtered anew."""
    same = ("integrators", "input_delay_samples")
    if any(getattr(structure, name) != getattr(data.structure, name) for name in same):
        return prepare(records, structure)
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
