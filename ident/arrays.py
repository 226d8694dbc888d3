"""Array types and the copy-and-lock helper that every frozen record of this package uses."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

RealArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


def readonly_real(values: Any) -> RealArray:
    """A float64 copy that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def readonly_complex(values: Any) -> ComplexArray:
    """A complex128 copy that cannot be written to."""
    array = np.array(values, dtype=np.complex128)
    array.setflags(write=False)
    return array
