"""Records made ready for a fit: filtered inputs and outputs of all records, one after the other.

A fit of poles does not care for integrators and delay, which are exact filters of the input: they are applied
here, once. `prepare` and `prepare_inputs` stack records into a `Regression`; `restructured` changes the
nuisance columns of one without filtering again; `thinned` chooses the part of long records that a search
looks at. Records must have one sampling time and the same inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.structure import Structure, answered, driving_input, stabilised
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression

# Starts per length of a stretch, of the stretches of a long record among which the most exciting one is
# sought: a quarter of their length apart, so that each exciting one is at least to seven eighths in one of
# them. Chosen.
_STARTS_PER_STRETCH = 4
# Share of the largest input variance with which a stretch counts as equally exciting: ties (a periodic or
# binary input) go to the beginning, where the record may well start from rest. Chosen.
_AS_EXCITING = 0.9


def prepare(records: Sequence[Record], structure: Structure) -> Regression:
    """Single-input single-output records stacked for one fit.

    Parameters
    ----------
    records : sequence of Record
        input (T, 1), output (T, 1), dt_s.
    structure : Structure
        Integrators, delay and nuisance columns.

    Returns
    -------
    Regression
        With U = 1.

    Raises
    ------
    ValueError
        As `prepare_inputs`, and if a record has more than one input or output.
    """
    for record in records:
        record.refuse_several()
    return prepare_inputs(records, structure)


def prepare_inputs(records: Sequence[Record], structure: Structure) -> Regression:
    """Records of equal inputs and one output stacked for one fit.

    Parameters
    ----------
    records : sequence of Record
        input (T, U), output (T, 1), dt_s; T may differ.
    structure : Structure
        Integrators, delay (samples), unstable poles, and which nuisance columns a record gets.

    Returns
    -------
    Regression
        Inputs (U, N) behind integrators and delay, output (N,), N the samples of all records without the
        first ones that the delay leaves unanswered.

    Raises
    ------
    ValueError
        No record, a record with more than one output or not longer than the delay, inputs that differ between
        records (by name; a single one may have any), or sampling times that differ by more than 0.1 %.
        Finite numbers are checked by `Record`.
    """
    if not records:
        raise ValueError("identification needs at least one record; got none")
    first = records[0]
    delay = structure.input_delay_samples
    inputs = []
    outputs = []
    polynomials = []
    starts = [0]
    for record in records:
        if record.output.shape[1] != 1:
            raise ValueError(f"{record.label}: expected one output, got {list(record.output_names)}")
        # A single input may have another name in each file; several are matched by name.
        names = record.input_names
        has_several = max(len(names), len(first.input_names)) > 1
        if has_several and names != first.input_names:
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
        n_answered = record.n_samples - delay
        inputs.append([driving_input(u, structure.integrators, delay) for u in record.input.T])
        stable_output = stabilised(record.output[:, 0], structure.unstable)
        outputs.append(answered(stable_output, delay))
        polynomials.append(_legendre(n_answered, structure.n_polynomials))
        starts.append(starts[-1] + n_answered)
    return Regression(
        u=np.ascontiguousarray(np.concatenate(inputs, axis=1)),
        y=np.concatenate(outputs),
        starts=np.array(starts, dtype=np.int64),
        polynomials=np.ascontiguousarray(np.concatenate(polynomials, axis=1)),
        structure=structure,
        dt_s=first.dt_s,
    )


def restructured(records: Sequence[Record], data: Regression, structure: Structure) -> Regression:
    """`prepare_inputs(records, structure)`, from `data`, the records prepared with another structure.

    Where only nuisances and direct term differ, their signals are not filtered anew, and `records` are not
    looked at. That `data` are of these records, and the unstable poles the same, is not checked; where they
    are filtered anew: ValueError as `prepare_inputs`.
    """
    # Feed-through and free responses are columns that a fit makes itself; only polynomials are stored.
    before = data.structure
    same_filters = (
        structure.integrators == before.integrators
        and structure.input_delay_samples == before.input_delay_samples
    )
    if not same_filters:
        return prepare_inputs(records, structure)
    if structure.n_polynomials == before.n_polynomials:
        return replace(data, structure=structure)
    sizes = np.diff(data.starts)
    of_records = [_legendre(int(size), structure.n_polynomials) for size in sizes]
    polynomials = np.concatenate(of_records, axis=1)
    return replace(data, structure=structure, polynomials=np.ascontiguousarray(polynomials))


def _legendre(n_samples: int, count: int) -> RealArray:
    """Legendre polynomials of degrees 0 .. count - 1 over a record of T = n_samples samples, (count, T).

    (0, T) for count = 0; T is at least 1, and below count the rows depend on each other.
    """
    # Constants, by far the most common, need no ramp.
    if count < 2:
        return np.ones((count, n_samples))
    ramp = np.linspace(-1, 1, n_samples)
    columns = np.polynomial.legendre.legvander(ramp, count - 1)
    return np.asarray(columns.T, np.float64)


def thinned(records: Sequence[Record], limit: int) -> tuple[list[Record], bool]:
    """Part of the records with about `limit` samples for a search, and whether it starts in mid-record.

    Parameters
    ----------
    records : sequence of Record
        Without any, so is the part.
    limit : int
        Samples that the search shall look at, at least 1 (ValueError by `Record.slice` for 0 where the
        records do not fit).

    Returns
    -------
    part : list of Record
        Whole records, evenly chosen, as many as fit if all were of mean length; where that is one which does
        not fit, its first stretch of `limit` samples whose input varies most, to a tenth. All records where
        they fit.
    in_mid_record : bool
        The part begins after the first row of its record, and so hardly at rest.
    """
    total = sum(record.n_samples for record in records)
    if total <= limit:
        return list(records), False
    # Evenly over the campaign: neighbours are alike.
    count = max(1, int(len(records) * limit / total))
    positions = np.linspace(0, len(records), count, endpoint=False).astype(int)
    chosen = [records[i] for i in positions]
    if count > 1 or chosen[0].n_samples <= limit:
        return chosen, False

    # One record, longer than the limit: the first stretch whose input varies about as much as any.
    record = chosen[0]
    starts = range(0, record.n_samples - limit + 1, max(limit // _STARTS_PER_STRETCH, 1))
    variances = [float(np.var(record.input[start : start + limit])) for start in starts]
    is_exciting = np.array(variances) > _AS_EXCITING * max(variances)
    best = starts[int(np.argmax(is_exciting))]
    return [record.slice(best, best + limit)], best > 0
