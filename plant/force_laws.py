"""Laws of smooth forces that depend on one position or one speed of a moving body.

One table for every route: the rig's stepper (`plant.kernel`), and the diagnosis of simulations and measured
motions (`diagnosis.machine.body_forces`). A new law is a label in `plant.machine` and a branch in each of the
three functions here; a new effect that follows a law which stands here needs no equation at all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from plant.machine import ABSOLUTE, CUBIC, LINEAR, OFF_AXIS, QUADRATIC, SINE

# Compiled into its callers: a call per force and step costs a third of a stepper's time. A division by zero
# gives inf, as in NumPy.
_INLINED: Any = {"cache": True, "error_model": "numpy", "forceinline": True}


@njit(**_INLINED)
def force_of_law(law: int, p0: float, p1: float, p2: float, y: float) -> float:
    """Force on a body by a law; its equation stands with its label in `plant.machine`.

    Parameters
    ----------
    law : int
        Label of the law.
    p0, p1, p2 : float
        Its parameters, the size first; a law with fewer ignores the last ones.
    y : float
        Position (m or rad) or speed (m/s or rad/s) of the body.

    Returns
    -------
    float
        Force along positive motion, N or N m; nan for a label without a law here.
    """
    if law == SINE:
        return float(p0 * np.sin(p1 * y + p2))
    if law == CUBIC:
        return float(-p0 * y**3)
    if law == QUADRATIC:
        return float(-p0 * y * abs(y))
    if law == LINEAR:
        return float(-p0 * y)
    if law == ABSOLUTE:
        return float(-p0 * abs(y))
    if law == OFF_AXIS:
        return float(-p0 * (np.sin(y + p1) - np.sin(p1)))
    return np.nan


@njit(**_INLINED)
def slope_of_law(law: int, p0: float, p1: float, p2: float, y: float) -> float:
    """Derivative of `force_of_law` by y, with the same arguments.

    Returns
    -------
    float
        Force per unit of y; where a law has a kink at zero, the mean of both sides.
    """
    if law == SINE:
        return float(p0 * p1 * np.cos(p1 * y + p2))
    if law == CUBIC:
        return float(-3 * p0 * y * y)
    if law == QUADRATIC:
        return float(-2 * p0 * abs(y))
    if law == LINEAR:
        return float(-p0)
    if law == ABSOLUTE:
        return float(-p0 * np.sign(y))
    if law == OFF_AXIS:
        return float(-p0 * np.cos(y + p1))
    return np.nan


def steepest_slope(law: int, p0: float, p1: float, largest: float) -> float:
    """Largest size of the slope of a law over |y| <= largest, for how finely a motion has to be cut.

    Parameters
    ----------
    law, p0, p1
        As of `force_of_law`.
    largest : float
        Largest size of the position or speed.

    Returns
    -------
    float
        Force per unit of y, no less than any slope there; nan for a label without a law here.
    """
    if law == SINE:
        return abs(p0 * p1)
    if law == CUBIC:
        return 3 * abs(p0) * largest**2
    if law == QUADRATIC:
        return 2 * abs(p0) * largest
    if law in (LINEAR, ABSOLUTE, OFF_AXIS):
        return abs(p0)
    return np.nan
