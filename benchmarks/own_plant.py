"""What the simulations of the real machines share: their constants for compiled code, a delayed command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.linalg import expm

from diagnosis import EffectParameter, PlantEffect

Real = npt.NDArray[np.float64]

# Coulomb friction as a share of the static one.
SHARE = EffectParameter("coulomb_share", 0.0, 0.98, (0.3, 0.7), "linear")


def constants(
    listed: Sequence[PlantEffect],
    effects: Mapping[str, Mapping[str, float]],
    parameters: Mapping[str, float] | None = None,
    **absent: float,
) -> np.record:
    """The parameters, and EFFECT_PARAMETER of every listed effect: zero, or as in `absent`, without it.

    A record with named fields, which compiled code reads as well.
    """
    values = {f"{effect.name}_{p.name}": 0.0 for effect in listed for p in effect.parameters} | absent
    values |= {f"{name}_{key}": value for name, sizes in effects.items() for key, value in sizes.items()}
    values |= parameters or {}
    return np.rec.array([tuple(values.values())], dtype=[(name, np.float64) for name in values])[0]


@njit
def late_value(command: Real, k: int, delay_samples: float, dead_zone: float) -> float:
    """Command (T,) at sample k behind a delay (linear between samples) and a dead zone."""
    whole = int(delay_samples)
    part = delay_samples - whole
    late = (1 - part) * command[max(k - whole, 0)] + part * command[max(k - whole - 1, 0)]
    return float(np.sign(late) * max(abs(late) - dead_zone, 0.0))


@njit
def lagged(pull: float, held: float, step_s: float, lag_s: float) -> float:
    """Exact step of a first-order lag towards a held value."""
    return held if lag_s <= 0.0 else held + (pull - held) * np.exp(-step_s / lag_s)


def held_input(A: Real, B: Real, step_s: float) -> tuple[Real, Real]:
    """A (n, n) and B (n, m) of one step under a held input, exact."""
    n, m = B.shape
    moved = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * step_s)
    return np.ascontiguousarray(moved[:n, :n]), np.ascontiguousarray(moved[:n, n:])
