"""Residuals read as one missing function: a hub torque or a sensor error that depends on one variable alone.

The residuals are regressed on the model's response to a torque on the hub that is a free function of hub
speed (angle, voltage, deflection, time), piecewise linear with a jump allowed at zero; likewise on free
functions added to a sensor. The share of the gap that one explains says where the cause acts.

Neglected: a large gap moves the variable, which is the model's, and bends the curve. Standard errors hold the
sensor noise only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import chi2

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import EquivalentCurve, sensors_of
from diagnosis.where.regimes import Motion
from diagnosis.where.where_energy import Energy

_SHIFTS = 39  # the fewest of which none reaches it in 2.5 % of cases by chance: 1 / 40
# Axes that explain less than this are not worth the shifts.
_LEAST_SHARE = 0.3
_LEAST_SAMPLES = 60  # as of a bin in `diagnosis.where.regimes`
_VARIABLES: dict[str, tuple[Callable[[Motion], Real | None], str]] = {
    "speed": (lambda m: m.speed_rad_s, "rad/s"),
    "angle": (lambda m: m.angle_rad, "rad"),
    "command": (lambda m: m.command_V, "V"),
    "deflection": (lambda m: m.deflection_m, "m"),
    "position": (lambda m: m.position_m, "m"),
    "time": (lambda m: m.time_s, "s"),
}
_ROUTES = (
    ("hub_torque", ("speed", "angle", "command", "deflection", "time"), "N m"),
    ("hub_angle", ("angle", "speed", "time"), "rad"),
    ("tip", ("position", "speed", "time"), "m"),
)


@dataclass(frozen=True, eq=False)
class _Basis:
    """Hat functions (T, K) per experiment and their nodes (K,); node -0.0 and 0.0 are the sides of a jump."""

    nodes: Real
    functions: Mapping[str, Real]


def missing_functions(
    case: Case,
    residuals: Mapping[str, Real],
    moved: Mapping[str, Motion],
    level: float,
    rng: np.random.Generator,
) -> tuple[EquivalentCurve, ...]:
    """Every route that is measured and its axes.

    Together they raise a false alarm with chance `level` when there is only noise.

    Found also asks for a share of 30 % and that no shift in time of the function's variable explains as much
    (39 shifts), which guards against slow residuals that any slow function would fit.
    """
    gap = Energy.of(residuals.values()).gap
    # In noise deviations, (T, Y): of the nominal machine, wherever a record starts.
    response, _ = case.machine.torque_response(max(e.voltage_V.size for e in case.experiments))
    torque, sensors = response / case.noise, sensors_of(case)
    routes = [route for route in _ROUTES if route[0] in ("hub_torque", *sensors)]
    tests = sum(len(axes) for _, axes, _ in routes)
    bases, found = {axis: _basis(axis, moved) for axis in _VARIABLES}, []
    for route, axes, value_unit in routes:
        at = sensors.index(route) if route in sensors else None
        for axis in axes:
            basis = bases[axis]
            if basis is None:
                continue
            gram, moment = _normal_equations(at, basis.functions, residuals, torque, case.noise)
            explained, rank, values, errors = _solve(gram, moment)
            p_value = float(chi2.sf(explained, rank))
            share = float((explained - rank) / gap) if gap > 0 else 0.0
            by_chance, beyond = 0.0, False
            if p_value < level / tests and share >= _LEAST_SHARE:
                shares = np.zeros(_SHIFTS)
                for k in range(_SHIFTS):
                    # A slow function is hardly another one less than a tenth of a record later.
                    moved_on = {
                        name: np.roll(f, rng.integers(tenth, len(f) - tenth), axis=0)
                        for name, f in basis.functions.items()
                        for tenth in [max(len(f) // 10, 1)]
                    }
                    again = _solve(*_normal_equations(at, moved_on, residuals, torque, case.noise))
                    shares[k] = (again[0] - again[1]) / gap
                by_chance = float(np.quantile(shares, 0.95))
                p_value = max(p_value, (1 + np.count_nonzero(shares >= share)) / (_SHIFTS + 1))
                beyond = bool(share > np.max(shares))
            found.append(
                EquivalentCurve(
                    route,
                    axis,
                    _VARIABLES[axis][1],
                    value_unit,
                    tuple(float(v) for v in basis.nodes),
                    tuple(float(v) for v in values),
                    tuple(float(v) for v in errors),
                    share,
                    by_chance,
                    float(p_value),
                    beyond,
                )
            )
    return tuple(found)


def _basis(axis: str, moved: Mapping[str, Motion]) -> _Basis | None:
    known = {name: _VARIABLES[axis][0](m) for name, m in moved.items()}
    values = {name: v for name, v in known.items() if v is not None}
    if not values:
        return None
    everything = np.concatenate(list(values.values()))
    if axis == "time":
        nodes = np.linspace(0.0, float(everything.max()), 8)
        return _Basis(nodes, {name: _hats(v, nodes) for name, v in values.items()})
    sides = []
    for sign in (-1.0, 1.0):
        reached = sign * everything[sign * everything > 0]
        if reached.size < _LEAST_SAMPLES:
            continue  # nothing to tell on this side
        # Nodes where samples are: half, nine tenths and all of them lie below.
        nodes = np.unique(np.concatenate([[0.0], np.quantile(reached, (0.5, 0.9, 1.0))]))
        nodes = nodes[np.concatenate([[True], np.diff(nodes) > 1e-6 * nodes[-1]])]
        order = slice(None, None, -1 if sign < 0 else 1)
        functions = {name: (_hats(sign * v, nodes) * (sign * v > 0)[:, None]) for name, v in values.items()}
        sides.append((sign * nodes[order], {name: f[:, order] for name, f in functions.items()}))
    if not sides:
        return None
    return _Basis(
        np.concatenate([nodes for nodes, _ in sides]),
        {name: np.hstack([f[name] for _, f in sides]) for name in values},
    )


def _hats(values: Real, nodes: Real) -> Real:
    """Piecewise linear interpolation weights (T, K) of values within the nodes (K,)."""
    return np.column_stack([np.interp(values, nodes, row) for row in np.eye(nodes.size)])


def _normal_equations(
    sensor: int | None,
    functions: Mapping[str, Real],
    residuals: Mapping[str, Real],
    torque: Real,
    noise: Real,
) -> tuple[Real, Real]:
    """Gram (K, K) and moment (K,) of the regressors' responses in noise deviations.

    sensor: index of the output that the functions are added to; None: they are torques on the hub.
    """
    K = next(iter(functions.values())).shape[1]
    gram, moment = np.zeros((K, K)), np.zeros(K)
    for name, f in functions.items():
        e = residuals[name]
        if sensor is None:
            T = f.shape[0]
            n = next_fast_len(2 * T - 1, real=True)
            columns = irfft(rfft(f.T, n)[None] * rfft(torque[:T].T, n)[:, None], n)[:, :, :T]  # (Y, K, T)
            for s in range(columns.shape[0]):
                gram += columns[s] @ columns[s].T
                moment += columns[s] @ e[:, s]
        else:
            gram += f.T @ f / noise[sensor] ** 2
            moment += f.T @ e[:, sensor] / noise[sensor]
    return gram, moment


def _solve(gram: Real, moment: Real) -> tuple[float, int, Real, Real]:
    """Explained energy, rank, coefficients and their standard errors (NaN-free; 0 for an empty function)."""
    scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
    used = scale > 1e-12 * max(float(scale.max()), 1e-300)
    values, errors = np.zeros(scale.size), np.zeros(scale.size)
    if not np.any(used):
        return 0.0, 0, values, errors
    eigenvalues, vectors = np.linalg.eigh(gram[np.ix_(used, used)] / np.outer(scale[used], scale[used]))
    kept = eigenvalues > 1e-9 * eigenvalues[-1]
    explained = float(np.sum((vectors[:, kept].T @ (moment[used] / scale[used])) ** 2 / eigenvalues[kept]))
    inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T
    values[used] = inverse @ (moment[used] / scale[used]) / scale[used]
    errors[used] = np.sqrt(np.diag(inverse)) / scale[used]
    return explained, int(np.count_nonzero(kept)), values, errors
