"""Certificate of one controller for plants with several inputs and outputs.

Between grid points: with the scalings of `scaled_bound` held fixed, the scaled gain is a rational matrix, and
the frequencies at which its largest singular value crosses a level are the imaginary eigenvalues of a
Hamiltonian matrix (Boyd, Balakrishnan and Kabamba, 1989). Pieces without a crossing, each with scalings of
its own, cover all frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg

from control_design.analysis.between_grid_points import EXCESS, LEAST_EXCESS
from control_design.analysis.limited_loop import LimitedLoop, limited_joints
from control_design.analysis.stability import NominalLoop, NyquistCount, nyquist_count
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Complex, Real
from control_design.plants.frequency_grid import frequency_grid, lowest_rad_s, near_the_circle
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.plant_set import Mode, modes_of
from control_design.plants.scaled_bound import (
    BoundRows,
    largest_channel,
    scaled_bound,
    stability_bound,
    structured_norm,
)
from control_design.plants.weights import RationalWeight
from control_design.specification.multivariable import MultivariableSpecification, gram
from ident.data.shown import Shown

_PIECES = 3000  # at most, of one requirement
_CROSSES = 1e-6  # relative real part below which an eigenvalue counts as imaginary
_AT_ONE = 1e-7  # distance from z = 1 of an integrator

StateSpace = tuple[Real, Real, Real, Real]


@dataclass(frozen=True)
class DiskMargin:
    """alpha: every gain and phase within the disk of this size is tolerated in all channels at once
    (Seiler, Packard and Gahinet, 2020); loops: the same of each channel by itself, the others closed."""

    alpha: float
    loops: tuple[float, ...]

    @property
    def gain(self) -> float:
        """Every channel's gain may be multiplied or divided by this, all at once."""
        return (2 + self.alpha) / (2 - self.alpha) if self.alpha < 2 else float("inf")

    @property
    def phase_rad(self) -> float:
        """Phase that every channel may gain or lose, all at once."""
        return 2 * float(np.arctan(self.alpha / 2))


@dataclass(frozen=True)
class MultivariableVerdict:
    """What was found for one plant.

    stable: all nominal poles inside the circle, pole_radius the largest. winding: of det(I + G K), a second
    way to the same. worst: largest worst case of each requirement on the dense grid, worst_at its frequency
    [rad/s], worst_joint the index of the joint that carries most of it. bounds: upper bound for all
    frequencies from from_rad_s to Nyquist, inf where none was proved; obstacle says why. stability_radius:
    factor by which the uncertainty may grow before a member is unstable (inf without uncertainty), on the
    grid. input_disk, output_disk: of the nominal loop, on the grid.
    exact: the worst case is exact at a frequency, not an upper bound (up to two blocks). limited: the nominal
    loop at the controller's limits, None without limits.
    """

    plant: str
    stable: bool
    pole_radius: float
    winding: NyquistCount
    worst: dict[str, float]
    worst_at: dict[str, float]
    bounds: dict[str, float]
    from_rad_s: float
    obstacle: str | None
    stability_radius: float
    input_disk: DiskMargin
    output_disk: DiskMargin
    frequencies: int
    exact: bool
    worst_joint: dict[str, int] = field(default_factory=dict, metadata={"since": 2})
    limited: LimitedLoop | None = field(default=None, metadata={"since": 10})

    @property
    def proved(self) -> bool:
        """Stable, and every requirement bounded for all frequencies."""
        return self.stable and self.winding.matches and bool(np.all(np.isfinite(list(self.bounds.values()))))

    @property
    def met(self) -> bool:
        """Proved at or below 1, and the loop at its limits ends where it has to."""
        limited_ends = self.limited is None or self.limited.ends
        return self.proved and max(self.bounds.values()) <= 1.0 and limited_ends


@dataclass(frozen=True, repr=False)
class MultivariableCertificate(Shown):
    """Verdicts by plant; gamma: largest worst case on the grids; met: for every one."""

    table_in_notebook = True

    verdicts: tuple[MultivariableVerdict, ...]
    gamma: float = field(init=False)

    def __post_init__(self) -> None:
        stable = all(each.stable for each in self.verdicts)
        worst = max(value for each in self.verdicts for value in each.worst.values())
        object.__setattr__(self, "gamma", worst if stable else float("inf"))

    @property
    def met(self) -> bool:
        return all(each.met for each in self.verdicts)


def certify_multivariable(
    controller: Controller,
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    *,
    dense_points: int = 1500,
) -> MultivariableCertificate:
    """Stability, worst cases for all frequencies, margins: of u = -K y, for every plant by itself.

    A plant whose uncertainty is known on its own frequencies only is certified there. Raises ValueError for a
    controller that does not fit the plants. Neglected: rounding of double precision.
    """
    listed = (plants,) if isinstance(plants, MultivariablePlant) else tuple(plants)
    for plant in listed:
        if controller.D.shape != (plant.inputs, plant.outputs) or not np.isclose(controller.dt_s, plant.dt_s):
            raise ValueError(
                f"plant {plant.name!r} needs a controller with D ({plant.inputs}, {plant.outputs}) at dt "
                f"{plant.dt_s}; got {controller.D.shape} at {controller.dt_s}"
            )
        if controller.computational_delay_samples != specification.computational_delay_samples:
            raise ValueError("controller and specification differ in computational_delay_samples")
        specification.pattern(plant.inputs, plant.outputs)  # refuses another number of joints
    return MultivariableCertificate(
        tuple(_verdict(controller, p, specification, dense_points) for p in listed)
    )


def _verdict(
    controller: Controller, plant: MultivariablePlant, specification: MultivariableSpecification, points: int
) -> MultivariableVerdict:
    dt, delay = plant.dt_s, controller.computational_delay_samples
    poles = NominalLoop(plant, delay).poles(controller.A, controller.B, controller.C, controller.D)
    radius = float(np.max(np.abs(poles), initial=0.0))
    weights = specification.weights(plant.inputs, plant.outputs)
    omega = _grid(controller, plant, poles, weights, points)
    s = tustin_s(omega, dt)
    G, seen, entering = plant.blocks(omega, delay)
    K = controller.response(omega, with_delay=False).reshape(omega.size, plant.inputs, plant.outputs)

    def rows(of: str, each: tuple[RationalWeight | None, ...]) -> BoundRows:
        size = gram(each, s)
        none_y, none_u = (np.zeros((omega.size, n, n)) for n in (plant.outputs, plant.inputs))
        on_y, on_u = (size, none_u) if of == "y" else (none_y, size)
        return BoundRows(G, seen, entering, on_y, on_u, False)

    worst, worst_at, worst_joint, scalings = {}, {}, {}, {}
    for name, (of, each) in weights.items():
        found = scaled_bound(rows(of, each), K)
        at = int(np.argmax(found.gamma))
        worst_joint[name] = int(largest_channel(rows(of, each), K, found.right)[at])
        worst[name], worst_at[name] = float(found.gamma[at]), float(omega[at])
        scalings[name] = found.log_t
    at_one = [int(np.sum(np.abs(each - 1) < _AT_ONE)) for each in (plant.poles, controller.poles)]
    outside = sum(
        int(np.sum((np.abs(each) >= 1) & (np.abs(each - 1) >= _AT_ONE)))
        for each in (plant.poles, controller.poles)
    )

    def turned(w: Real) -> Complex:
        k = controller.response(w, with_delay=False).reshape(w.size, plant.inputs, plant.outputs)
        own = plant.blocks(w, delay)[0] if plant.own_grid is None else G[np.searchsorted(omega, w)]
        return np.asarray(np.linalg.det(np.eye(plant.outputs) + own @ k) - 1.0)

    winding = nyquist_count(
        turned, omega, integrators=sum(at_one), unstable_poles=outside, refinable=plant.own_grid is None
    )
    stable = radius < 1.0
    bounds = dict.fromkeys(weights, float("inf"))
    obstacle: str | None = None
    integrates = any(
        np.any(np.roots(w.denominator) == 0) for _, e in weights.values() for w in e if w is not None
    )
    start = max(float(omega[0]) if integrates else 0.0, plant.ball.lowest_rad_s if plant.ball else 0.0)
    if plant.own_grid is not None:
        obstacle = "the uncertainty is known on its own frequencies only"
    elif not stable:
        obstacle = "the nominal loop is unstable"
    else:
        for name, (of, each) in weights.items():
            if not np.isfinite(worst[name]):
                obstacle = f"{name}: some member of the uncertainty is unstable at {worst_at[name]:.4g} rad/s"
                continue
            level = worst[name] * (1 + EXCESS)
            if worst[name] <= 1.0 < level:
                level = max(1.0, worst[name] * (1 + LEAST_EXCESS))
            system, sizes = _scaled_loop(controller, plant, of, each)
            stopped = _covered(system, sizes, level, np.abs(s), scalings[name], start)
            bounds[name] = level if stopped is None else float("inf")
            if stopped is not None:
                obstacle = f"{name}: no bound found beyond {stopped:.4g} rad/s"
    sensitivity = np.linalg.inv(np.eye(plant.outputs) + G @ K)
    at_input = np.linalg.inv(np.eye(plant.inputs) + K @ G)
    blocks = seen.shape[1]
    mu = stability_bound(rows("y", (None,) * plant.outputs), K) if blocks else np.zeros(1)
    largest = float(np.max(mu))
    return MultivariableVerdict(
        plant.name, stable, radius, winding, worst, worst_at, bounds, start, obstacle,
        1.0 / largest if largest > 0 else float("inf"), _disk(at_input), _disk(sensitivity), int(omega.size),
        blocks <= 2, worst_joint,
        limited_joints(controller, plant) if controller.limited_commands.any() else None,
    )  # fmt: skip


def _disk(sensitivity: Any) -> DiskMargin:
    half = sensitivity - 0.5 * np.eye(sensitivity.shape[1])
    each = np.max(np.abs(np.diagonal(half, axis1=1, axis2=2)), axis=0)
    return DiskMargin(1.0 / float(np.max(structured_norm(half))), tuple((1.0 / each).tolist()))


def _grid(
    controller: Controller,
    plant: MultivariablePlant,
    poles: Complex,
    weights: dict[str, tuple[str, tuple[RationalWeight | None, ...]]],
    points: int,
) -> Real:
    """Dense frequencies: logarithmic, around modes and zeros, around whatever is near the circle."""
    dt = plant.dt_s
    if plant.own_grid is not None:
        return plant.own_grid[plant.own_grid < np.pi / dt]
    roots = np.concatenate([plant.poles, plant.zeros, controller.poles, poles])
    corners = [
        abs(r) for _, e in weights.values() for w in e if w is not None for r in np.roots(w.denominator) if r
    ]
    low = min(0.1 * min(corners, default=np.inf), lowest_rad_s(dt, roots))
    light = [Mode(m.omega_rad_s, max(abs(m.zeta), 1e-5)) for m in modes_of(roots, dt)]
    light = [m for m in light if m.omega_rad_s < np.pi / dt]
    return frequency_grid(
        0.999999 * np.pi / dt, light, omega_min_rad_s=low, n_log=points, n_mode=60 * len(light),
        extra=near_the_circle(roots, dt),
    )  # fmt: skip


def _in_s(system: Any, dt_s: float) -> StateSpace:
    """State space in Tustin's s with the values of the discrete one: the inverse of Tustin's rule."""
    A, B, C, D = (np.asarray(getattr(system, each), dtype=np.float64) for each in "ABCD")
    inverse = np.linalg.inv(A + np.eye(A.shape[0]))
    return (
        2 / dt_s * (A - np.eye(A.shape[0])) @ inverse,
        4 / dt_s * inverse @ inverse @ B,
        C,
        D - C @ inverse @ B,
    )


def _weights(weights: tuple[RationalWeight | None, ...]) -> StateSpace:
    """Diagonal of weights, as a state space in s."""
    parts = []
    for weight in weights:
        given = weight or RationalWeight(numerator=(1e-300,), denominator=(1.0,))
        top, bottom = np.array(given.numerator), np.array(given.denominator)
        n, top = bottom.size - 1, np.concatenate([np.zeros(bottom.size - top.size), top]) / bottom[0]
        bottom = bottom / bottom[0]
        # Unit of time in which the companion form is well scaled.
        unit = max(float(abs(bottom[-1])) ** (1 / n), 1e-12) if n else 1.0
        powers = unit ** np.arange(n + 1)
        b, c = bottom / powers, top / powers
        A = np.zeros((n, n))
        A[:-1, 1:] = np.eye(max(n - 1, 0))
        if n:
            A[-1] = -b[:0:-1]
        B = np.zeros((n, 1))
        B[-1:] = 1.0
        C = (c[1:] - b[1:] * c[0])[::-1][None, :]
        parts.append((unit * A, unit * B, C, np.array([[c[0]]])))
    return _side_by_side(parts)


def _side_by_side(parts: Sequence[StateSpace]) -> StateSpace:
    """Block-diagonal state space."""
    stacked = [scipy.linalg.block_diag(*(part[i] for part in parts)) for i in range(4)]
    n, outputs, inputs = (sum(p[k].shape[a] for p in parts) for k, a in ((0, 0), (3, 0), (3, 1)))
    shapes = ((n, n), (n, inputs), (outputs, n), (outputs, inputs))
    A, B, C, D = (part.reshape(shape) for part, shape in zip(stacked, shapes, strict=True))
    return A, B, C, D


def _scaled_loop(
    controller: Controller, plant: MultivariablePlant, of: str, weights: tuple[RationalWeight | None, ...]
) -> tuple[StateSpace, list[tuple[int, int]]]:
    """Closed loop in s from (w of every block, d) to (z of every block, e); sizes (z, w) of the blocks in the
    order of `MultivariablePlant.blocks`."""
    dt, u, y = plant.dt_s, plant.inputs, plant.outputs
    G = _in_s(plant.delayed(controller.computational_delay_samples), dt)
    parts = [G, _in_s(controller, dt), _weights(weights)]
    sizes: list[tuple[int, int]] = []
    if plant.ball is not None:
        li = plant.ball.Li
        parts.append(_in_s(plant.ball.Li, dt))
        sizes.append((li.noutputs, plant.ball.Lo.shape[1]))
    errors = plant.input_error or plant.output_error
    if errors:
        parts.append(_weights(errors))
        sizes += [(1, 1)] * len(errors)
    A, B, C, D = _side_by_side(parts)
    ins = np.cumsum([0, *(part[3].shape[1] for part in parts)])
    outs = np.cumsum([0, *(part[3].shape[0] for part in parts)])
    w = np.cumsum([0, *(size[1] for size in sizes), y])
    z = np.cumsum([0, *(size[0] for size in sizes), len(weights)])
    # Inputs of the parts = link (their outputs) + enter (w, d); z = see (their outputs) + direct (w, d).
    link, enter = np.zeros((ins[-1], outs[-1])), np.zeros((ins[-1], w[-1]))
    see, direct = np.zeros((z[-1], outs[-1])), np.zeros((z[-1], w[-1]))
    g, k, e = (slice(outs[i], outs[i + 1]) for i in range(3))
    # Signals of the plant's output: G u + ball + errors + d.
    at_y, d_y = np.zeros((y, outs[-1])), np.zeros((y, w[-1]))
    at_y[:, g], d_y[:, w[-2] :] = np.eye(y), np.eye(y)
    at_u = np.zeros((u, outs[-1]))
    at_u[:, k] = -np.eye(u)
    link[ins[0] : ins[1]] = at_u
    number, block = 3, 0
    if plant.ball is not None:
        link[ins[3] : ins[4]] = at_u
        see[z[0] : z[1], outs[3] : outs[4]] = plant.ball.radius * np.eye(sizes[0][0])
        d_y[:, w[0] : w[1]] = plant.ball.Lo
        number, block = 4, 1
    if plant.input_error:  # w, weighted, joins u at the plant
        enter[ins[number] : ins[number + 1], w[block] : w[block + u]] = np.eye(u)
        link[ins[0] : ins[1], outs[number] : outs[number + 1]] = np.eye(u)
        see[z[block] : z[block + u]] = at_u
    if plant.output_error:  # sees the plant's own output, weighted
        link[ins[number] : ins[number + 1], g] = np.eye(y)
        see[z[block] : z[block + y], outs[number] : outs[number + 1]] = np.eye(y)
        d_y[:, w[block] : w[block + y]] = np.eye(y)
    link[ins[1] : ins[2]], enter[ins[1] : ins[2]] = at_y, d_y
    if of == "y":
        link[ins[2] : ins[3]], enter[ins[2] : ins[3]] = at_y, d_y
    else:
        link[ins[2] : ins[3]] = at_u
    see[z[-2] :, e] = np.eye(len(weights))
    solve = np.linalg.inv(np.eye(outs[-1]) - D @ link)
    out_x, out_w = solve @ C, solve @ D @ enter
    return (A + B @ link @ out_x, B @ (link @ out_w + enter), see @ out_x, see @ out_w + direct), sizes


def _covered(
    system: StateSpace,
    sizes: list[tuple[int, int]],
    level: float,
    size_s: Real,
    log_t: Real,
    start: float,
) -> float | None:
    """Where the bound `level` could not be continued, |s|; None if it holds from `start` to infinity.

    size_s (F,), log_t (F, N): the dense frequencies and their scalings.
    """
    A, B, C, D = system
    z = np.repeat(
        np.arange(len(sizes) + 1), [*(size[0] for size in sizes), C.shape[0] - sum(s[0] for s in sizes)]
    )
    w = np.repeat(
        np.arange(len(sizes) + 1), [*(size[1] for size in sizes), B.shape[1] - sum(s[1] for s in sizes)]
    )
    # Well-scaled coordinates of the states, once.
    _, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale

    def free(here: float) -> tuple[float, float]:
        """Interval around |s| = here without a crossing, with scalings between those of its neighbours."""
        log = [np.interp(np.log(here), np.log(size_s), column) for column in log_t.T]
        left = np.append(np.exp(-0.5 * np.array(log)), 1.0)[z]
        right = np.append(np.exp(0.5 * np.array(log)), 1.0 / level)[w]
        b, c, d = B * right, C * left[:, None], D * left[:, None] * right
        inner = np.linalg.inv(np.eye(d.shape[1]) - d.T @ d)
        top = A + b @ inner @ d.T @ c
        hamiltonian = np.block(
            [[top, b @ inner @ b.T], [-c.T @ (np.eye(d.shape[0]) + d @ inner @ d.T) @ c, -top.T]]
        )
        gain = c @ np.linalg.solve(1j * here * np.eye(A.shape[0]) - A, b) + d
        if not np.linalg.norm(gain, 2) < 1.0:
            return here, here
        found = scipy.linalg.eigvals(hamiltonian)
        crossing = np.abs(found.imag[np.abs(found.real) <= _CROSSES * np.abs(found)])
        return float(np.max(crossing[crossing < here], initial=0.0)), float(
            np.min(crossing[crossing > here], initial=np.inf)
        )

    covered, stride, pieces = start, 16, 0
    while pieces < _PIECES:
        first = min(int(np.searchsorted(size_s, covered)), size_s.size - 1)
        trials = [size_s[min(first + each, size_s.size - 1)] for each in (stride, stride // 4, 0)]
        trials += [covered + share * (size_s[first] - covered) for share in (0.3, 0.1, 0.03, 0.01)]
        for number, here in enumerate(trials):
            low, high = free(float(here))
            pieces += 1
            if low <= covered < high:
                covered, stride = high, min(2 * stride, 256) if number == 0 else max(stride // 2, 4)
                break
        else:
            return covered
        if not np.isfinite(covered):
            return None
    return covered
