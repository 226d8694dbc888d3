"""Certificate of one controller for plants with several inputs and outputs.

For every plant it computes the closed-loop poles, the winding of det(I + G K), the worst case of each
requirement on a dense grid (the D-scaled bound of `plants.scaled_bound`) and disk margins. It then bounds
each worst case between the grid points: with the scalings held fixed, the scaled gain is a rational matrix in
Tustin's s, and the frequencies at which its largest singular value crosses a level are the imaginary
eigenvalues of a Hamiltonian matrix (Boyd, Balakrishnan and Kabamba, Math. Control Signals Systems 2, 1989).
Pieces without a crossing, each with scalings of its own, are joined until they cover all frequencies.
`certify_multivariable` is the entry; `_verdict` makes the steps for one plant, `_scaled_loop` builds the
rational matrix, `_bound_ends_at` joins the pieces. Neglected: rounding of double precision.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

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
from control_design.specification.multivariable import ChannelWeights, MultivariableSpecification, gram
from ident.data.keywords import clear_constructor
from ident.data.shown import Shown

# Relative difference of two sampling times that counts as none: rounding of decimal numbers.
_SAME_PERIOD = 1e-9
# Pieces, at most, into which the frequencies of one requirement are cut: a limit of work, as each takes the
# eigenvalues of a matrix of twice the loop's states. Chosen; with a tenth of it no test of this module moves.
_MOST_PIECES = 3000
# Real part, as a share of the modulus, below which an eigenvalue of the Hamiltonian counts as imaginary. A
# double imaginary eigenvalue splits by the root of the rounding error, 1e-8: this is a hundred times that.
# A larger share shortens the pieces and never makes a bound wrong; up to 1e-4 no test moves.
_IMAGINARY_SHARE = 1e-6
# Distance from z = 1 below which a pole counts as an integrator. Rounding moves a double one by 1e-8, and a
# pole at 1e-5 rad per sample is a slow one. From 1e-9 to 1e-5 no test moves.
_INTEGRATOR_DISTANCE = 1e-7

# How far ahead of what is proved, in grid points, the next piece is centred: at first, at least and at most.
# They set how many pieces are computed, never what they prove. Chosen, all three.
_FIRST_STRIDE = 16

# Least stride: shorter ones would compute a piece for every grid point.
_LEAST_STRIDE = 4

# Largest stride: a piece that fails after a longer one has to be computed anew.
_LARGEST_STRIDE = 256
# Where no piece centred on a grid point reaches back to what is proved: centres on the way to the next grid
# point, as shares of that way. Chosen: each a third of the one before, down to a hundredth.
_SHARES_OF_A_STEP = (0.3, 0.1, 0.03, 0.01)

# Damping ratio that the grid takes at least for a mode, so that its points do not fall onto one another.
# Chosen.
_LEAST_DAMPING = 1e-5
# Grid points around each mode of plant, controller and loop, some fourteen of them within its bandwidth.
# Chosen: half as many as for one channel, since the bounds between points do not need them.
_POINTS_PER_MODE = 60
# The grid begins at this share of the lowest corner frequency of a weight, where that is lower: a decade
# below it a weight of first order is within 0.5 % of its limit.
_BELOW_CORNERS = 0.1
# The grid ends at this share of the Nyquist frequency, where Tustin's s is still finite: 4e5 times the
# Nyquist frequency. Chosen; the bounds go on to Nyquist itself.
_SHARE_OF_NYQUIST = 0.999999

# Gain of the weight of a channel on which nothing is asked: zero, which a `RationalWeight` refuses.
_NO_WEIGHT = 1e-300
# Smallest size of a weight's roots in rad/s by which its states are scaled; roots at zero have no size.
_SMALLEST_ROOT_RAD_S = 1e-12


class StateSpace(NamedTuple):
    """Matrices of x' = A x + B u, y = C x + D u, continuous in s (rad/s): (n, n), (n, U), (Y, n), (Y, U)."""

    A: Real
    B: Real
    C: Real
    D: Real


@dataclass(frozen=True)
class DiskMargin:
    """Gain and phase that all channels tolerate at once (Seiler, Packard and Gahinet, IEEE CSM 40, 2020).

    Attributes
    ----------
    alpha : float
        Size of the disk: every factor f with |(1 - f) / (1 + f)| <= alpha / 2 is tolerated, in all channels
        at once.
    loops : tuple of float
        Such a size for each channel by itself, the others closed.
    """

    alpha: float
    loops: tuple[float, ...]

    @property
    def gain(self) -> float:
        """Factor by which every channel's gain may be multiplied or divided, all at once; inf from 2 on.

        No unit; at least 1 for alpha >= 0.
        """
        if self.alpha < 2:
            return (2 + self.alpha) / (2 - self.alpha)
        return float("inf")

    @property
    def phase_rad(self) -> float:
        """Phase, rad, that every channel may gain or lose, all at once.

        Between 0 and pi; nan where alpha is nan.
        """
        return 2 * float(np.arctan(self.alpha / 2))


@dataclass(frozen=True)
class MultivariableVerdict:
    """What was computed for one plant.

    Attributes
    ----------
    plant : str
        Its name.
    stable : bool
        All nominal closed-loop poles lie inside the unit circle.
    pole_radius : float
        Largest modulus of these poles.
    winding : NyquistCount
        Half turns of det(I + G K): a second way to `stable`.
    worst, worst_at : dict of str to float
        By requirement ("tracking", "effort", "modulus"): the largest worst case on the dense grid (at most 1
        where it is met), and its frequency, rad/s.
    bounds : dict of str to float
        By requirement: upper bound of the worst case for all frequencies from `from_rad_s` to Nyquist; inf
        where none was proved.
    from_rad_s : float
        Where the bounds begin; 0 unless a weight integrates or the uncertainty begins later.
    obstacle : str or None
        Why a bound is missing.
    stability_radius : float
        Factor by which the uncertainty may grow before a member is unstable, on the grid; inf without
        uncertainty.
    input_disk, output_disk : DiskMargin
        Of the nominal loop, opened at the actuators and at the sensors, on the grid.
    frequencies : int
        Points of the dense grid.
    exact : bool
        The worst case is exact at each frequency (up to two blocks), not an upper bound.
    worst_joint : dict of str to int
        By requirement: index of the output or actuator that carries most of the worst case.
    limited : LimitedLoop or None
        The nominal loop at the controller's limits; None without limits.
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
        """Whether the loop is stable by poles and winding, and every requirement has a finite bound.

        Without any bound false only by poles and winding; the modulus margin always has one.
        """
        bounds = list(self.bounds.values())
        return self.stable and self.winding.matches and bool(np.all(np.isfinite(bounds)))

    @property
    def met(self) -> bool:
        """Whether every bound is at most 1, and the loop at its limits ends where it has to.

        False where a bound is nan.
        """
        limited_ends = self.limited is None or self.limited.ends
        return self.proved and max(self.bounds.values()) <= 1.0 and limited_ends


@clear_constructor
@dataclass(frozen=True, repr=False)
class MultivariableCertificate(Shown):
    """Verdicts on one controller, a plant each.

    Attributes
    ----------
    verdicts : tuple of MultivariableVerdict
        In the order of the plants.
    gamma : float
        Largest worst case of any requirement and plant on the grids, no unit; inf where a nominal loop is
        unstable.

    Raises
    ------
    ValueError
        There are no verdicts (Python's error for the maximum of nothing).

    Examples
    --------
    >>> law = flexlink.Controller.proportional(0.01, 0.01)
    >>> both = control.append(law.to_control(), law.to_control())
    >>> plant, asked = example_joint_plant(), example_joint_specification()
    >>> flexlink.certify_multivariable(both, plant, asked).met
    True
    """

    table_in_notebook = True

    verdicts: tuple[MultivariableVerdict, ...]
    gamma: float = field(init=False)

    def __post_init__(self) -> None:
        """Compute `gamma` from the verdicts.

        ValueError without verdicts.
        """
        stable = all(verdict.stable for verdict in self.verdicts)
        worst = max(value for verdict in self.verdicts for value in verdict.worst.values())
        object.__setattr__(self, "gamma", worst if stable else float("inf"))

    @property
    def met(self) -> bool:
        """Whether the requirements are proved for every plant.

        Nothing can be refused: verdicts are not empty.
        """
        return all(verdict.met for verdict in self.verdicts)


def certify_multivariable(
    controller: Controller,
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    *,
    dense_points: int = 1500,
) -> MultivariableCertificate:
    """Stability, worst cases for all frequencies and margins of u = -K y, for every plant by itself.

    Parameters
    ----------
    controller : Controller
        Discrete, Y errors to U commands, with the delay of the specification.
    plants : MultivariablePlant or sequence of them
        Nominal state space and uncertainty of each, U inputs and Y outputs. Where the uncertainty is known
        on its own frequencies only, the plant is checked there and nothing is proved between them.
    specification : MultivariableSpecification
        What is asked of each output and actuator.
    dense_points : int
        Logarithmic points of the dense grid; those around modes come on top. 1500 over some seven decades are
        1 % from one to the next. Chosen; not checked.

    Returns
    -------
    MultivariableCertificate

    Raises
    ------
    ValueError
        The controller's shape, sampling time or computational delay is not that of plant and specification,
        or the specification has another number of joints or another structure (SpecificationError); no plant
        is given; or a plant's uncertainty or response cannot be evaluated on the grid.
    """
    if isinstance(plants, MultivariablePlant):
        listed: tuple[MultivariablePlant, ...] = (plants,)
    else:
        listed = tuple(plants)
    for plant in listed:
        same_period = np.isclose(controller.dt_s, plant.dt_s, rtol=_SAME_PERIOD, atol=0)
        if controller.D.shape != (plant.inputs, plant.outputs) or not same_period:
            raise ValueError(
                f"plant {plant.name!r} needs a controller with D ({plant.inputs}, {plant.outputs}) at dt "
                f"{plant.dt_s}; got {controller.D.shape} at {controller.dt_s}"
            )
        if controller.computational_delay_samples != specification.computational_delay_samples:
            raise ValueError("controller and specification differ in computational_delay_samples")
        # Called for its error: another number of joints.
        specification.pattern(plant.inputs, plant.outputs)
    verdicts = tuple(_verdict(controller, plant, specification, dense_points) for plant in listed)
    return MultivariableCertificate(verdicts)


def _verdict(
    controller: Controller, plant: MultivariablePlant, specification: MultivariableSpecification, points: int
) -> MultivariableVerdict:
    """Everything that is checked of one plant; points: logarithmic points of the dense grid.

    An unstable loop is no error: bounds stay inf and `obstacle` says so. LinAlgError of numpy where I + G K
    is singular at a grid frequency, or the loop is algebraic.
    """
    delay = controller.computational_delay_samples
    poles = NominalLoop(plant, delay).poles(controller.A, controller.B, controller.C, controller.D)
    radius = float(np.max(np.abs(poles), initial=0.0))
    stable = radius < 1.0

    # Plant, uncertainty and controller at F frequencies.
    weights = specification.weights(plant.inputs, plant.outputs)
    omega = _dense_grid(controller, plant, poles, weights, points)
    s = tustin_s(omega, plant.dt_s)
    G, seen, entering = plant.blocks(omega, delay)
    n_blocks = seen.shape[1]
    K = _matrix_of(controller, plant, omega)
    no_weight_on_y = np.zeros((omega.size, plant.outputs, plant.outputs))
    no_weight_on_u = np.zeros((omega.size, plant.inputs, plant.inputs))

    # Worst case of every requirement over the uncertainty.
    worst: dict[str, float] = {}
    worst_at: dict[str, float] = {}
    worst_joint: dict[str, int] = {}
    log_scalings: dict[str, Real] = {}
    for name, asked in weights.items():
        size = gram(asked.weights, s)
        if asked.signal == "y":
            rows = BoundRows(G, seen, entering, size, no_weight_on_u, False)
        else:
            rows = BoundRows(G, seen, entering, no_weight_on_y, size, False)
        bound = scaled_bound(rows, K)
        at = int(np.argmax(bound.gamma))
        worst[name] = float(bound.gamma[at])
        worst_at[name] = float(omega[at])
        worst_joint[name] = int(largest_channel(rows, K, bound.right)[at])
        log_scalings[name] = bound.log_t

    # Stability once more, by the winding of det(I + G K).
    integrators = 0
    unstable_poles = 0
    for roots in (plant.poles, controller.poles):
        at_one = np.abs(roots - 1) < _INTEGRATOR_DISTANCE
        outside = (np.abs(roots) >= 1) & (np.abs(roots - 1) >= _INTEGRATOR_DISTANCE)
        integrators += int(np.sum(at_one))
        unstable_poles += int(np.sum(outside))

    def determinant_less_one(asked_rad_s: Real) -> Complex:
        """det(I + G K) - 1 (F,): takes the place of a loop gain L, whose 1 + L is counted.

        asked_rad_s (F,): rad/s. No unit. Other frequencies than the plant's own, where it has such, are not
        seen: the next higher own one answers.
        """
        if plant.own_grid is None:
            response = plant.blocks(asked_rad_s, delay)[0]
        else:
            # Nothing is known between the plant's own frequencies, and only these are asked for.
            response = G[np.searchsorted(omega, asked_rad_s)]
        law = _matrix_of(controller, plant, asked_rad_s)
        return np.asarray(np.linalg.det(np.eye(plant.outputs) + response @ law) - 1.0)

    winding = nyquist_count(
        determinant_less_one,
        omega,
        integrators=integrators,
        unstable_poles=unstable_poles,
        refinable=plant.own_grid is None,
    )

    # The bounds begin at zero frequency, unless a weight is infinite there or the ball says nothing there.
    start = 0.0
    if any(_integrates(asked) for asked in weights.values()):
        start = float(omega[0])
    if plant.ball is not None:
        start = max(start, plant.ball.lowest_rad_s)
    bounds = dict.fromkeys(weights, float("inf"))
    obstacle: str | None = None
    if plant.own_grid is not None:
        obstacle = "the uncertainty is known on its own frequencies only"
    elif not stable:
        obstacle = "the nominal loop is unstable"
    else:
        for name, asked in weights.items():
            if not np.isfinite(worst[name]):
                obstacle = f"{name}: some member of the uncertainty is unstable at {worst_at[name]:.4g} rad/s"
                continue
            level = worst[name] * (1 + EXCESS)
            if worst[name] <= 1.0 < level:
                # A requirement that is met has to stay met, and the limit 1 is a bound that says so.
                level = max(1.0, worst[name] * (1 + LEAST_EXCESS))
            loop = _scaled_loop(controller, plant, asked)
            ends_at = _bound_ends_at(loop, level, np.abs(s), log_scalings[name], start)
            if ends_at is None:
                bounds[name] = level
            else:
                obstacle = f"{name}: no bound found beyond {ends_at:.4g} rad/s"

    # Robust stability by itself: no weight, the uncertainty enlarged until a member is unstable.
    largest_mu = 0.0
    if n_blocks:
        nothing_asked = gram((None,) * plant.outputs, s)
        unweighted = BoundRows(G, seen, entering, nothing_asked, no_weight_on_u, False)
        largest_mu = float(np.max(stability_bound(unweighted, K)))
    stability_radius = float("inf")
    if largest_mu > 0:
        stability_radius = 1.0 / largest_mu

    # Disk margins of the nominal loop, and the loop at its limits.
    sensitivity = np.linalg.inv(np.eye(plant.outputs) + G @ K)
    sensitivity_at_input = np.linalg.inv(np.eye(plant.inputs) + K @ G)
    limited = None
    if controller.limited_commands.any():
        limited = limited_joints(controller, plant)
    return MultivariableVerdict(
        plant=plant.name,
        stable=stable,
        pole_radius=radius,
        winding=winding,
        worst=worst,
        worst_at=worst_at,
        bounds=bounds,
        from_rad_s=start,
        obstacle=obstacle,
        stability_radius=stability_radius,
        input_disk=_disk_margin(sensitivity_at_input),
        output_disk=_disk_margin(sensitivity),
        frequencies=int(omega.size),
        # With the performance three blocks: up to there the scaled bound is the worst case itself.
        exact=n_blocks <= 2,
        worst_joint=worst_joint,
        limited=limited,
    )


def _matrix_of(controller: Controller, plant: MultivariablePlant, omega_rad_s: Real) -> Complex:
    """Response K (F, U, Y) of the controller without its delay, which `MultivariablePlant.blocks` holds.

    omega_rad_s (F,): rad/s. The shape was checked by `certify_multivariable`.
    """
    response = controller.response(omega_rad_s, with_delay=False)
    return response.reshape(omega_rad_s.size, plant.inputs, plant.outputs)


def _integrates(asked: ChannelWeights) -> bool:
    """Whether a weight of any channel has a pole at zero frequency, and is infinite there.

    False where every weight is None. A `RationalWeight` has no other fault to look for.
    """
    denominators = [weight.denominator for weight in asked.weights if weight is not None]
    return any(np.any(np.roots(denominator) == 0) for denominator in denominators)


def _disk_margin(sensitivity: Any) -> DiskMargin:
    """Disk margin of a loop with the sensitivity S (F, n, n): 1 / max mu(S - I/2) over the frequencies.

    mu is over a diagonal of complex factors, of one channel by itself the modulus of its diagonal entry.

    Not checked: a nan gives nan; a loop with S = I/2 at all frequencies would be a division by zero.
    """
    half = sensitivity - 0.5 * np.eye(sensitivity.shape[1])
    diagonal = np.diagonal(half, axis1=1, axis2=2)
    largest_by_channel = np.max(np.abs(diagonal), axis=0)
    alpha = 1.0 / float(np.max(structured_norm(half)))
    return DiskMargin(alpha, tuple((1.0 / largest_by_channel).tolist()))


def _dense_grid(
    controller: Controller,
    plant: MultivariablePlant,
    loop_poles: Complex,
    weights: dict[str, ChannelWeights],
    points: int,
) -> Real:
    """Frequencies of the dense check, rad/s, (F,) ascending, below Nyquist.

    They are logarithmic, denser around modes, zeros and whatever is near the circle; of a plant known on its
    own frequencies only these. loop_poles (n,): of the nominal closed loop. points: logarithmic ones.

    weights: of which the denominators' roots are corners. What `frequency_grid` raises (a lowest frequency
    above Nyquist: IndexError) goes up.
    """
    dt_s = plant.dt_s
    nyquist_rad_s = np.pi / dt_s
    if plant.own_grid is not None:
        below_nyquist = plant.own_grid < nyquist_rad_s
        return plant.own_grid[below_nyquist]
    roots = np.concatenate([plant.poles, plant.zeros, controller.poles, loop_poles])

    # The grid begins below the corners of the weights and below the slowest root.
    lowest_corner = np.inf
    for asked in weights.values():
        for weight in asked.weights:
            if weight is None:
                continue
            corners = np.abs(np.roots(weight.denominator))
            lowest_corner = np.min(corners, initial=lowest_corner, where=corners > 0)
    low = min(_BELOW_CORNERS * lowest_corner, lowest_rad_s(dt_s, roots))

    light: list[Mode] = []
    for mode in modes_of(roots, dt_s):
        if mode.omega_rad_s < nyquist_rad_s:
            light.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), _LEAST_DAMPING)))
    return frequency_grid(
        _SHARE_OF_NYQUIST * np.pi / dt_s,
        light,
        omega_min_rad_s=low,
        n_log=points,
        n_mode=_POINTS_PER_MODE * len(light),
        extra=near_the_circle(roots, dt_s),
    )


def _in_s(system: Any, dt_s: float) -> StateSpace:
    """State space in Tustin's s of a discrete one, by the inverse of Tustin's rule s = (2/dt)(z - 1)/(z + 1).

    Both have the same value where s and z belong together, so a frequency keeps its response. system: has
    matrices A, B, C, D, and no eigenvalue of A at -1.

    dt_s in seconds. With such an eigenvalue numpy raises LinAlgError, or rounding decides.
    """
    A = np.asarray(system.A, dtype=np.float64)
    B = np.asarray(system.B, dtype=np.float64)
    C = np.asarray(system.C, dtype=np.float64)
    D = np.asarray(system.D, dtype=np.float64)
    eye = np.eye(A.shape[0])
    inverse = np.linalg.inv(A + eye)
    return StateSpace(
        A=2 / dt_s * (A - eye) @ inverse,
        B=4 / dt_s * inverse @ inverse @ B,
        C=C,
        D=D - C @ inverse @ B,
    )


def _weights_in_s(weights: tuple[RationalWeight | None, ...]) -> StateSpace:
    """Diagonal of N weights (None: zero) as a state space in s, N inputs and N outputs, in companion form.

    A `RationalWeight` is proper with a first coefficient that is not zero, so nothing is checked.
    """
    parts: list[StateSpace] = []
    for weight in weights:
        if weight is None:
            weight = RationalWeight(numerator=(_NO_WEIGHT,), denominator=(1.0,))
        bottom = np.array(weight.denominator)
        missing = bottom.size - len(weight.numerator)
        top = np.concatenate([np.zeros(missing), np.array(weight.numerator)])
        top = top / bottom[0]
        bottom = bottom / bottom[0]

        # Unit of time in which the companion form is well scaled: the geometric mean of the roots' sizes.
        order = bottom.size - 1
        unit = 1.0
        if order:
            unit = max(float(abs(bottom[-1])) ** (1 / order), _SMALLEST_ROOT_RAD_S)
        powers = unit ** np.arange(order + 1)
        b = bottom / powers
        c = top / powers

        A = np.zeros((order, order))
        A[:-1, 1:] = np.eye(max(order - 1, 0))
        B = np.zeros((order, 1))
        if order:
            A[-1] = -b[:0:-1]
            B[-1] = 1.0
        C = (c[1:] - b[1:] * c[0])[::-1][None, :]
        D = np.array([[c[0]]])
        parts.append(StateSpace(unit * A, unit * B, C, D))
    return _side_by_side(parts)


def _side_by_side(parts: Sequence[StateSpace]) -> StateSpace:
    """Block-diagonal state space: the parts with their own inputs and outputs, one after the other.

    At least one part (ValueError without any); the matrices of a part fit, not checked.
    """
    A, B, C, D = (scipy.linalg.block_diag(*blocks) for blocks in zip(*parts, strict=True))
    n_states = sum(part.A.shape[0] for part in parts)
    n_outputs, n_inputs = D.shape
    # `block_diag` gives parts without states other shapes, so the shapes are stated.
    return StateSpace(
        A.reshape((n_states, n_states)),
        B.reshape((n_states, n_inputs)),
        C.reshape((n_outputs, n_states)),
        D,
    )


class _BlockSize(NamedTuple):
    """Signals of one block of uncertainty w = Delta z: how many it sees (z) and how many it makes (w)."""

    n_seen: int
    n_made: int


class _ScaledLoop(NamedTuple):
    """Closed loop in s that waits for scalings and for the blocks of uncertainty.

    system: from (w of every block, disturbance d at the plant's output) to (z of every block, weighted signal
    e). blocks: their sizes, in the order of `MultivariablePlant.blocks`.
    """

    system: StateSpace
    blocks: list[_BlockSize]


def _slices(sizes: Iterable[int]) -> list[slice]:
    """Positions of vectors of these sizes that are stacked, a slice each.

    Sizes are not negative (not checked); none gives none.
    """
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(start, stop) for start, stop in pairwise(ends)]


def _scaled_loop(controller: Controller, plant: MultivariablePlant, asked: ChannelWeights) -> _ScaledLoop:
    """Closed loop of one requirement: asked.signal says whether e is a weighted S d ("y") or K S d ("u").

    The parts (plant with delay, controller, weights, ball, weights of the channels' errors) stand side by
    side; constant matrices say which output goes where, and the loop is then closed at once.

    plant: with `ball` (Lo, Li, radius) and the weights of channel errors. LinAlgError of numpy where the loop
    is algebraic; shapes were checked by `certify_multivariable`.
    """
    n_u = plant.inputs
    n_y = plant.outputs
    n_e = len(asked.weights)
    parts = [
        _in_s(plant.delayed(controller.computational_delay_samples), plant.dt_s),
        _in_s(controller, plant.dt_s),
        _weights_in_s(asked.weights),
    ]
    blocks: list[_BlockSize] = []
    if plant.ball is not None:
        parts.append(_in_s(plant.ball.Li, plant.dt_s))
        blocks.append(_BlockSize(n_seen=plant.ball.Li.noutputs, n_made=plant.ball.Lo.shape[1]))
    channel_errors = plant.input_error or plant.output_error
    if channel_errors:
        parts.append(_weights_in_s(channel_errors))
        blocks += [_BlockSize(n_seen=1, n_made=1)] * len(channel_errors)
    A, B, C, D = _side_by_side(parts)

    # Where the signals of each part, of each block, and last d and e stand in the stacked vectors.
    inputs_of = _slices(part.D.shape[1] for part in parts)
    outputs_of = _slices(part.D.shape[0] for part in parts)
    made_by = _slices([*(block.n_made for block in blocks), n_y])
    seen_by = _slices([*(block.n_seen for block in blocks), n_e])
    n_inputs = inputs_of[-1].stop
    n_outputs = outputs_of[-1].stop
    n_made = made_by[-1].stop
    n_seen = seen_by[-1].stop

    # Inputs of the parts = link (their outputs) + enter (w, d); (z, e) = see (their outputs).
    link = np.zeros((n_inputs, n_outputs))
    enter = np.zeros((n_inputs, n_made))
    see = np.zeros((n_seen, n_outputs))
    direct = np.zeros((n_seen, n_made))

    # The command u = -K y and the loop's output y = G u + d, as rows over the parts' outputs and over (w, d).
    command = np.zeros((n_u, n_outputs))
    command[:, outputs_of[1]] = -np.eye(n_u)
    output = np.zeros((n_y, n_outputs))
    output[:, outputs_of[0]] = np.eye(n_y)
    output_of_w = np.zeros((n_y, n_made))
    output_of_w[:, made_by[-1]] = np.eye(n_y)
    link[inputs_of[0]] = command

    if plant.ball is not None:
        # The ball Lo Delta Li sees the command and joins the output.
        link[inputs_of[3]] = command
        see[seen_by[0], outputs_of[3]] = plant.ball.radius * np.eye(blocks[0].n_seen)
        output_of_w[:, made_by[0]] = plant.ball.Lo
    # The blocks of the channels' errors stand after that of the ball, and their weights are the last part.
    if plant.input_error:
        # They see the command, and their w, weighted, joins it at the plant.
        made_by_errors = slice(made_by[-1].start - n_u, made_by[-1].start)
        seen_by_errors = slice(seen_by[-1].start - n_u, seen_by[-1].start)
        enter[inputs_of[-1], made_by_errors] = np.eye(n_u)
        link[inputs_of[0], outputs_of[-1]] = np.eye(n_u)
        see[seen_by_errors] = command
    if plant.output_error:
        # They see the nominal plant's output, weighted, and join the loop's.
        made_by_errors = slice(made_by[-1].start - n_y, made_by[-1].start)
        seen_by_errors = slice(seen_by[-1].start - n_y, seen_by[-1].start)
        link[inputs_of[-1], outputs_of[0]] = np.eye(n_y)
        see[seen_by_errors, outputs_of[-1]] = np.eye(n_y)
        output_of_w[:, made_by_errors] = np.eye(n_y)

    # The controller takes the output; the weights take what the requirement is about.
    link[inputs_of[1]] = output
    enter[inputs_of[1]] = output_of_w
    if asked.signal == "y":
        link[inputs_of[2]] = output
        enter[inputs_of[2]] = output_of_w
    else:
        link[inputs_of[2]] = command
    see[seen_by[-1], outputs_of[2]] = np.eye(n_e)

    # Close the loop: outputs = C x + D (link outputs + enter w), solved for the outputs.
    solve = np.linalg.inv(np.eye(n_outputs) - D @ link)
    outputs_of_x = solve @ C
    outputs_of_w = solve @ D @ enter
    closed = StateSpace(
        A=A + B @ link @ outputs_of_x,
        B=B @ (link @ outputs_of_w + enter),
        C=see @ outputs_of_x,
        D=see @ outputs_of_w + direct,
    )
    return _ScaledLoop(closed, blocks)


def _bound_ends_at(
    loop: _ScaledLoop,
    level: float,
    size_s: Real,
    log_t: Real,
    start: float,
) -> float | None:
    """Where |s| (rad/s) the worst case could not be shown to stay below `level`; None if it does everywhere.

    Parameters
    ----------
    loop : _ScaledLoop
        Of one requirement.
    level : float
        The bound that is to be shown, above the worst case on the grid.
    size_s : (F,) array
        |s| of the dense grid, rad/s, ascending.
    log_t : (F, N) array
        Logarithm of the best scaling of each of the N blocks there.
    start : float
        Where the bound has to begin, rad/s. It ends at infinity, which is the Nyquist frequency in z.

    Notes
    -----
    Everything from `start` to `covered` is proved. Each piece is an interval around a trial frequency within
    which the scaled gain does not cross `level`; it counts where it holds `covered`, which then moves to its
    end. Trials go ahead as far as the last piece suggests, then closer. After `_MOST_PIECES` it ends where it
    is. Not checked: F >= 1, ascending above 0.
    """
    # The block that each scalar signal belongs to. The performance (d and e) counts as one more, the last.
    A, B, C, D = loop.system
    n_seen = [block.n_seen for block in loop.blocks]
    n_made = [block.n_made for block in loop.blocks]
    block_numbers = np.arange(len(loop.blocks) + 1)
    block_of_z = np.repeat(block_numbers, [*n_seen, C.shape[0] - sum(n_seen)])
    block_of_w = np.repeat(block_numbers, [*n_made, B.shape[1] - sum(n_made)])

    # Well-scaled coordinates of the states, once.
    _, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    A = A * scale / scale[:, None]
    B = B / scale[:, None]
    C = C * scale

    covered = start
    stride = _FIRST_STRIDE
    pieces = 0
    last = size_s.size - 1
    while pieces < _MOST_PIECES:
        first = min(int(np.searchsorted(size_s, covered)), last)
        # A quarter of the stride is the second trial; the least stride is 4, so that it is a point ahead.
        trials = [size_s[min(first + ahead, last)] for ahead in (stride, stride // 4, 0)]
        trials += [covered + share * (size_s[first] - covered) for share in _SHARES_OF_A_STEP]
        for number, trial in enumerate(trials):
            # Scalings between those of the neighbouring grid points; that of the performance is 1. Half of
            # the logarithm on either side: a scaling t multiplies signals by its root.
            centre = float(trial)
            log_here = [np.interp(np.log(centre), np.log(size_s), column) for column in log_t.T]
            on_z = np.append(np.exp(-0.5 * np.array(log_here)), 1.0)[block_of_z]
            on_w = np.append(np.exp(0.5 * np.array(log_here)), 1.0 / level)[block_of_w]
            scaled = StateSpace(A, B * on_w, C * on_z[:, None], D * on_z[:, None] * on_w)
            low, high = _interval_below_one(scaled, centre)
            pieces += 1
            if low <= covered < high:
                covered = high
                farthest_trial = number == 0
                # Doubled and halved, as usual for lengths of which only the order of magnitude counts.
                longer = min(2 * stride, _LARGEST_STRIDE)
                shorter = max(stride // 2, _LEAST_STRIDE)
                stride = longer if farthest_trial else shorter
                break
        else:
            # No trial reaches back to what is proved.
            return covered
        if not np.isfinite(covered):
            return None
    return covered


def _interval_below_one(system: StateSpace, centre: float) -> tuple[float, float]:
    """Ends, rad/s, of the interval around |s| = centre in which the largest singular value stays below 1.

    The end is inf where nothing crosses above; both are `centre` where the value is not below 1 there.
    Singular values of G(jw) = C (jw - A)^-1 B + D are 1 only where jw is an eigenvalue of

        [[A + B R D^T C, B R B^T], [-C^T (I + D R D^T) C, -(A + B R D^T C)^T]],   R = (I - D^T D)^-1.

    system: in s, with inputs and outputs scaled. LinAlgError of numpy where D has a singular value of 1
    exactly, or j centre is an eigenvalue of A; else nothing is checked.
    """
    A, B, C, D = system
    n_outputs, n_inputs = D.shape
    inner = np.linalg.inv(np.eye(n_inputs) - D.T @ D)
    upper_left = A + B @ inner @ D.T @ C
    upper_right = B @ inner @ B.T
    lower_left = -C.T @ (np.eye(n_outputs) + D @ inner @ D.T) @ C
    hamiltonian = np.block([[upper_left, upper_right], [lower_left, -upper_left.T]])
    gain = C @ np.linalg.solve(1j * centre * np.eye(A.shape[0]) - A, B) + D
    if not np.linalg.norm(gain, 2) < 1.0:
        return centre, centre

    eigenvalues = scipy.linalg.eigvals(hamiltonian)
    imaginary = np.abs(eigenvalues.real) <= _IMAGINARY_SHARE * np.abs(eigenvalues)
    crossings = np.abs(eigenvalues.imag[imaginary])
    low = np.max(crossings, initial=0.0, where=crossings < centre)
    high = np.min(crossings, initial=np.inf, where=crossings > centre)
    return float(low), float(high)
