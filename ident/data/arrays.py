"""Array types, real forms of complex arrays, locked copies for frozen classes, and clipped samples.

What every part of the package needs of numpy beyond numpy itself. `real_rows` and `factor_matrices` write
complex equations and products in real numbers, `lock` and `readonly` make the arrays of frozen classes
unchangeable, `kernel_array` prepares an array for compiled code, and `clipped_share` judges one signal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

RealArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# Options of numba functions. They are stored compiled; a wrapper for C, which nothing uses, is not compiled.
COMPILED: Any = {"cache": True, "no_cfunc_wrapper": True}
# Options of numba functions that compiled code alone calls: no wrapper for Python either.
INSIDE: Any = {**COMPILED, "no_cpython_wrapper": True}

# Different values below which a signal is one of few levels, which stands at each of them often. Chosen:
# steps and random sequences have two or three levels, a sensor's swing many more.
FEWEST_LEVELS = 10
# Share of samples at both extremes together above which a signal is binary by design, as a random sequence:
# most of its samples. A sine that is clipped so far is hardly one. Chosen.
BINARY_SHARE = 0.5
# An extreme value is clipped where at least this share of the samples stands there (chosen: what is clipped
# less hardly moves a fit),
CLIPPED_SHARE = 0.01
# ... at least so many samples (chosen: in short records a few equal ones come by chance),
FEWEST_CLIPPED = 5
# ... and so many times as many as at the next level: a sine, too, dwells at its extremes, where it has 2.4
# times as many samples as at the next of many levels, 1 / (sqrt(2) - 1).
CLIPPED_OVER_NEXT = 5
# A single stretch at an extreme is clipped only where it is at least this share of the record: a step
# response that is logged with few digits ends in one.
ONE_STRETCH_SHARE = 0.05


def kernel_array(array: RealArray) -> RealArray:
    """Return the array as compiled code takes it: C-contiguous and writable; a copy only where it is not.

    For numba, each layout is a type of its own, and compiled anew: two compilations may round differently.
    The type of its numbers is not changed, nor checked. array: of any shape.
    """
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else array.copy(order="C")


def one_signal(values: npt.ArrayLike) -> RealArray:
    """Return one signal as (T,), which may come as the only column (T, 1) of a record; other shapes stay.

    What cannot be made doubles raises numpy's ValueError or TypeError.
    """
    signal = np.asarray(values, dtype=np.float64)
    is_one_column = signal.ndim == 2 and signal.shape[1] == 1
    return signal[:, 0] if is_one_column else signal


def real_rows(values: ComplexArray) -> RealArray:
    """Return complex rows (F, .) as real ones (2 F, .): real parts above imaginary parts.

    F complex equations in real unknowns are these 2 F real ones. A vector (F,) becomes (2 F,).
    """
    return np.concatenate([values.real, values.imag])


def factor_matrices(factor: ComplexArray) -> RealArray:
    """Return matrices (F, 2, 2) that do to (Re, Im) what multiplication by a complex factor (F,) does.

    [[a, -b], [b, a]] for the factor a + j b. Any shape (...) becomes (..., 2, 2); NaN stays NaN.
    """
    real = factor.real
    imaginary = factor.imag
    first_row = np.stack([real, -imaginary], -1)
    second_row = np.stack([imaginary, real], -1)
    return np.stack([first_row, second_row], -2)


def lock(record: object, *names: str, dtype: npt.DTypeLike = np.float64) -> None:
    """Replace fields of an instance of a frozen class, given by name, by copies that cannot be written to.

    record: the instance; AttributeError for a field that is not there. Numbers are converted to dtype, not
    checked.
    """
    for name in names:
        object.__setattr__(record, name, readonly(getattr(record, name), dtype))


def readonly(values: Any, dtype: npt.DTypeLike = np.float64) -> Any:
    """Return a copy of an array, of this type, that cannot be written to.

    What cannot be converted raises numpy's ValueError or TypeError; NaN passes.
    """
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def clipped_share(signal: RealArray) -> float:
    """Return the share of samples that stand at a suspiciously frequent extreme value, else 0.

    Parameters
    ----------
    signal : ndarray, shape (T,)
        At least one sample, finite; not checked. Signals of fewer than ten levels are not judged, nor those
        mostly at both extremes, which are binary by design.

    Notes
    -----
    An extreme is suspicious where 1 % of the samples stand there, five times as many as at the next level, in
    more than one stretch, or in one of 5 % of the record. Rest before the first and after the last change is
    left out of the count, though not of the number of samples.
    """
    levels, counts = np.unique(signal, return_counts=True)
    if levels.size < FEWEST_LEVELS or counts[0] + counts[-1] > BINARY_SHARE * signal.size:
        return 0.0
    changes = np.flatnonzero(np.diff(signal))
    between_rests = signal[changes[0] + 1 : changes[-1] + 1]
    share = 0.0
    for extreme, next_count in ((levels[0], counts[1]), (levels[-1], counts[-2])):
        is_there = between_rests == extreme
        count = int(np.count_nonzero(is_there))
        n_stretches = np.count_nonzero(is_there[1:] & ~is_there[:-1])
        if is_there[:1].any():
            n_stretches += 1
        comes_often = n_stretches >= 2 or count >= ONE_STRETCH_SHARE * signal.size
        fewest = max(CLIPPED_SHARE * signal.size, FEWEST_CLIPPED, CLIPPED_OVER_NEXT * next_count)
        if comes_often and count >= fewest:
            share += count / signal.size
    return share
