"""Array types, real forms of complex arrays, and the copy-and-lock helper of every frozen record."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

RealArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# Options of numba functions. The way in for C, which nothing takes, is not compiled; nor is that for Python
# of what compiled code alone calls.
COMPILED: Any = {"cache": True, "no_cfunc_wrapper": True}
INSIDE: Any = {**COMPILED, "no_cpython_wrapper": True}


def kernel_array(array: RealArray) -> RealArray:
    """The array as compiled code takes it: C-contiguous and writable. One type is one compilation: two may
    round differently."""
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else array.copy(order="C")


def one_signal(values: npt.ArrayLike) -> RealArray:
    """One signal as (T,), which may be the only column (T, 1) of a record; other shapes as they are."""
    signal = np.asarray(values, dtype=np.float64)
    return signal[:, 0] if signal.ndim == 2 and signal.shape[1] == 1 else signal


def real_rows(values: ComplexArray) -> RealArray:
    """Real parts (F, .) above imaginary ones: complex equations in real unknowns, as twice as many real
    ones."""
    return np.concatenate([values.real, values.imag])


def factor_matrices(factor: ComplexArray) -> RealArray:
    """(F,2,2) that do to (Re, Im) what multiplication by a complex factor (F,) does."""
    re, im = factor.real, factor.imag
    return np.stack([np.stack([re, -im], -1), np.stack([im, re], -1)], -2)


def lock(record: object, *names: str, dtype: npt.DTypeLike = np.float64) -> None:
    """Replace these fields of a frozen record by copies that cannot be written to."""
    for name in names:
        object.__setattr__(record, name, readonly(getattr(record, name), dtype))


def readonly(values: Any, dtype: npt.DTypeLike = np.float64) -> Any:
    """A copy that cannot be written to."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def clipped_share(signal: RealArray) -> float:
    """Share of samples that stand at a suspiciously frequent extreme value, else 0.

    Suspicious: 1 % of the samples, five times as many as at the next level, in more than one stretch unless
    that one is 5 % of the record. Rest before and after is left out, as are signals of a few levels and those
    mostly at both extremes, which are binary by design.
    """
    levels, counts = np.unique(signal, return_counts=True)
    if levels.size < 10 or counts[0] + counts[-1] > 0.5 * signal.size:
        return 0.0
    changes = np.flatnonzero(np.diff(signal))
    inside = signal[changes[0] + 1 : changes[-1] + 1]
    share = 0.0
    for extreme, neighbour in ((levels[0], counts[1]), (levels[-1], counts[-2])):
        at = inside == extreme
        count = int(np.count_nonzero(at))
        stretches = np.count_nonzero(at[1:] & ~at[:-1]) + int(at[:1].any())
        often = stretches >= 2 or count >= 0.05 * signal.size
        if often and count >= max(0.01 * signal.size, 5, 5 * neighbour):
            share += count / signal.size
    return share
