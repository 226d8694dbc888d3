"""Signals of a record as users have them: vectors, tables, pandas columns, responses of python-control.

`Record` takes any of these and keeps arrays (T, n) with a name for each column. pandas and python-control are
not imported here: what has columns, or times with inputs and outputs, is taken for theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ident.data.arrays import RealArray

# Times of a response are evenly spaced within this share of a step: rounding of printed decimals.
_UNEVEN_SHARE = 1e-6


def listed(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return one name, or several, as a tuple."""
    return (names,) if isinstance(names, str) else tuple(names)


def once(short_name: str, first: Any, long_name: str, second: Any) -> Any:
    """Return the one of two values that is given; ValueError, with their names, where it is not just one."""
    if (first is None) == (second is None):
        raise ValueError(f"give {short_name} (or, under its long name, {long_name}), once")
    return second if first is None else first


def is_time_response(response: Any) -> bool:
    """Return whether this is a time response of python-control: times, inputs and outputs."""
    return all(hasattr(response, part) for part in ("time", "inputs", "outputs"))


def of_time_response(response: Any, dt_s: float | None) -> tuple[RealArray, RealArray, float]:
    """Return input (T, U), output (T, Y) and sampling time, s, of a time response, which has a row a signal.

    dt_s: as stated, or None. Raises ValueError where the times are not even, are not dt_s apart, or the
    response has no input of one signal a row.
    """
    time = np.asarray(response.time, dtype=np.float64)
    step = float(time[-1] - time[0]) / max(time.size - 1, 1)
    if not step > 0 or not np.allclose(np.diff(time), step, rtol=0, atol=_UNEVEN_SHARE * step):
        raise ValueError("the time response is not evenly sampled: give control.forced_response even times")
    if dt_s is not None and not np.isclose(dt_s, step, rtol=_UNEVEN_SHARE, atol=0):
        raise ValueError(
            f"dt_s is {dt_s:.6g} s, the times of the response are {step:.6g} s apart: leave dt_s out"
        )
    inputs = np.atleast_2d(np.asarray(response.inputs))
    outputs = np.atleast_2d(np.asarray(response.outputs))
    if response.inputs is None or inputs.ndim != 2 or outputs.ndim != 2:
        raise ValueError(
            "the time response needs one input signal per row: control.forced_response(system, T, U)"
        )
    return inputs.T, outputs.T, step if dt_s is None else dt_s


def refuse_other_rows(*signals: Any) -> None:
    """Raise ValueError where columns of pandas have other rows: nothing is put in line by its index."""
    indices = [getattr(signal, "index", None) for signal in signals]
    rows: list[Any] = [index for index in indices if hasattr(index, "equals")]
    if any(not index.equals(rows[0]) for index in rows):
        raise ValueError(
            "u and y have rows of different index; put them in line first: u, y = u.align(y, join='inner')"
        )


def signals_of(symbol: str, values: Any, names: str | Sequence[str]) -> tuple[RealArray, tuple[str, ...]]:
    """Return signals (T, n) with n names.

    Parameters
    ----------
    symbol : str
        'u', 'y' or 'r': what signals without a name are called (with a number where they are several), and
        how complaints call them.
    values : array-like, shape (T,) or (T, n), or a pandas column or table
        Real numbers, a row a sample.
    names : str or sequence of str
        Of the columns; without any, those that pandas knows.

    Raises
    ------
    ValueError
        Another shape, more signals than samples, or what is no real number.
    """
    chosen = listed(names)
    if not chosen:
        columns = getattr(values, "columns", None)
        if columns is not None:
            chosen = tuple(str(column) for column in columns)
        elif getattr(values, "name", None):
            chosen = (str(values.name),)
    signals = _real(symbol, values)
    if signals.ndim == 1:
        signals = signals[:, None]
    if signals.ndim != 2:
        raise ValueError(f"{symbol} must be (T,) or (T, n); got shape {signals.shape}")
    n_samples, n_signals = signals.shape
    if n_signals > max(n_samples, 1):
        raise ValueError(
            f"{symbol} has {n_samples} samples of {n_signals} signals; expected one row per sample"
        )
    if not any(chosen):
        chosen = (symbol,) if n_signals == 1 else tuple(f"{symbol}{i + 1}" for i in range(n_signals))
    return signals, chosen


def _real(symbol: str, values: Any) -> RealArray:
    """Return numbers as doubles, where nothing is lost; ValueError else, with the symbol of the signal."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        raise ValueError(
            f"{symbol} holds complex numbers; expected real ones: give {symbol}.real if that is meant"
        )
    if np.ma.is_masked(values):
        row = int(np.argwhere(np.ma.getmaskarray(values))[0][0])
        raise ValueError(f"{symbol} has no value at index {row} (masked); expected a number in every row")
    if array.dtype.kind not in "fiubO":
        raise ValueError(f"{symbol} holds {array.dtype}; expected real numbers")
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{symbol} holds what is no number; expected real numbers") from None
