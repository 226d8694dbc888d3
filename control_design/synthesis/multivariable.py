"""Synthesis of one controller for plants with several inputs and outputs: fixed order and structure.

`synthesise_multivariable` is the entry. A start is a reduced H-infinity controller (`riccati_starts`), or a
stable static gain with modal blocks that are spread over frequency and do nothing yet (`Programme.starts`).
It is taken down to a local minimum of the worst case (`MatrixDescent`), with the frequencies that a dense
check finds violated added as it goes (`Programme.improved`). Nothing is random.

The controller is u = -K y in real modal form (`ModalForm`), n parameters x; plants have U inputs and Y
outputs. The worst case is gamma: the largest singular value of each weighted function by itself, over every
ball and block of the plants, at every frequency of a grid (`scaled_bound`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from control_design.analysis.limited_loop import limited_joints, with_safe_limits
from control_design.analysis.stability import NominalLoop
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import frequency_grid, local_maxima, lowest_rad_s
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.plant_set import Mode, matrix_response, modes_of
from control_design.plants.scaled_bound import largest_channel, scaled_bound
from control_design.specification.multivariable import MultivariableSpecification
from control_design.specification.specification import SpecificationError
from control_design.synthesis.modal_controller import ModalForm
from control_design.synthesis.multivariable_descent import MatrixDescent, StackedRows, stacked_rows
from control_design.synthesis.riccati_starts import central_controller, reduced, weighted_plant
from control_design.synthesis.synthesis import part_of
from control_design.synthesis.synthesis_options import MultivariableOptions
from control_design.synthesis.synthesis_result import BlockingPoint, Outcome
from ident.data.keywords import clear_constructor
from ident.data.shown import Shown

# "Doubled" says by how much the worst case rises of problem T of `benchmarks.mimo_designs` at order 4, for
# a full and for a decentralised controller, after six rounds of eight steps: other valleys of the same
# search.

# Damping ratio below which poles of loop and controller have frequencies of their own in every check: wider
# ones have several points of the dense grid in their width. Chosen.
_LIGHT = 0.3
# Where they have them, in half-widths (damping ratio times frequency) from the pole: a peak between two of
# the inner points is missed by 2 % at most. Chosen.
_AROUND = np.array([-3, -1.5, -0.7, -0.3, 0, 0.3, 0.7, 1.5, 3])
# Least damping ratio that such a half-width is made of: its points stay apart by far more than rounding.
# Chosen.
_LEAST_DAMPING = 1e-5
# Damping ratio of a plant's mode that its grid is made for, at least: narrower ones have no points inside.
# Chosen.
_LEAST_MODE_DAMPING = 1e-4
# Highest frequency of a grid over Nyquist, where Tustin's s is infinite.
_BELOW_NYQUIST = 0.9999
# Relative excess of the dense check over the lean grid that is accepted, as of one joint
# (EXCHANGE_TOLERANCE).
_EXCESS = 5e-4
# Relative accuracy of gamma in every check: far below the excess that is accepted.
_ACCURACY = 1e-6
# Lowest frequency of the grids over the slowest corner of a weight: a decade below, the weight is constant to
# a half per cent.
_BELOW_CORNERS = 0.1
# Scale over Nyquist, where no joint has a bandwidth or a tracking weight: that of one joint (`Grids`).
# Chosen.
_SCALE_OF_NYQUIST = 0.1
# Unit of the form's corners over the scale. Doubled: 7 and 33 %.
_FORM_SCALE = 2
# Lowest corner of a block over the lowest frequency of the grids, which has to see the corner. Doubled,
# nothing moves.
_SLOWEST_CORNER = 2
# Frequencies over the scale at which a static gain inverts the plant: half decades from a tenth of the scale
# to thirty times it. Chosen.
_INVERTED_AT = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1)
# Lags, in half turns, by which the plant is turned before: plants that integrate lag by a half of one.
_LAGS = (0.0, 0.25, 0.5)
# Gains over the inverse that are tried, the largest first: 16 down to 2^-13. Chosen: a loop gain of 16 is
# mostly unstable, and one of 1e-4 does nothing.
_GAINS = 2.0 ** np.arange(4.0, -14.0, -1.0)
# Corner of integral action over the frequency of inversion. Doubled, nothing moves, with integrators either.
_INTEGRAL_CORNER = 0.1
# Relative difference of worst cases below which two static gains count as one: three digits of a start.
_SAME = 1e-3
# What the ball puts in, over the references, in the weighted plant of an H-infinity start: each gives another
# start, of which the best counts. Chosen, half decades.
_SCALINGS = (0.03, 0.1, 0.3, 1.0)
# Lowest corner of the blocks that do nothing yet, over the form's unit. Doubled: 4 and 33 %.
_LOWEST_IDLE_CORNER = 0.1
# Highest corner of these blocks. Doubled: 10 % and nothing.
_HIGHEST_IDLE_CORNER = 30.0
# Damping ratio of these blocks: no resonance. Doubled: 24 and 8 %.
_IDLE_DAMPING = 0.7
# Violated frequencies that are added in a round, of each plant. Doubled, nothing moves.
_MOST_ADDED = 15
# Points around a mode in the dense grid over those in the lean one. Chosen; the logarithmic points of both
# are options, ten to one by default.
_DENSE_OVER_LEAN = 5


@clear_constructor
@dataclass(frozen=True, repr=False)
class MultivariableResult(Shown):
    """Controller of several joints, and how good it is. Certify it with `certify_multivariable` before use.

    Attributes
    ----------
    outcome : Outcome
        Met on the grid, not met, or not converged: then the controller means nothing, and gamma is inf.
    controller : Controller
        u = -K y.
    gamma : float
        Largest worst case over plants, requirements and the dense grid; at most 1: met.
    worst : dict of str to float
        Worst case of each requirement, by name.
    blocking : tuple of BlockingPoint
        Where each requirement is worst, the largest first: plant, frequency in rad/s, value and joint.
    steps : int
        Of all descents, also those not accepted.

    Examples
    --------
    >>> designed = flexlink.synthesise_multivariable(
    ...     example_joint_plant(), example_joint_specification(), rounds=2, steps=2
    ... )
    >>> designed.outcome.name, designed.gamma <= 1.0
    ('MET_ON_GRID', True)
    """

    outcome: Outcome
    controller: Controller
    gamma: float
    worst: dict[str, float]
    blocking: tuple[BlockingPoint, ...]
    steps: int


def synthesise_multivariable(
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    options: MultivariableOptions | None = None,
    *,
    progress: Callable[[float, str], None] | None = None,
) -> MultivariableResult:
    """One controller u = -K y of fixed order and structure with the smallest worst case.

    Parameters
    ----------
    plants : MultivariablePlant or sequence of MultivariablePlant
        Operating points; all share dt, U and Y. None at all is an IndexError.
    specification : MultivariableSpecification
        What is asked of each joint, order and structure of K.
    options : MultivariableOptions, optional
        Effort of the search.
    progress : callable, optional
        Called with (fraction, message).

    Returns
    -------
    MultivariableResult
        A local minimum, the best of `options.starts`; the same every time.

    Raises
    ------
    SpecificationError
        The plants do not fit one another or the structure, or no static gain of the structure stabilises
        them.
    ValueError
        The order is not one for each integrator and two for each modal block.

    Notes
    -----
    The worst case is the largest singular value of each weighted function by itself, over every ball and
    block of the plants, at every frequency of a grid: `scaled_bound`. Neglected: scheduling over operating
    points; one controller serves all.
    """
    options = options or MultivariableOptions()
    listed = (plants,) if isinstance(plants, MultivariablePlant) else tuple(plants)
    programme = Programme(listed, specification, options)
    tell = progress or (lambda fraction, message: None)
    gamma = np.inf
    best = np.zeros(0)
    starts = programme.starts()[: options.starts]
    for number, start in enumerate(starts):
        x, reached = programme.improved(start, part_of(tell, number, len(starts)))
        if reached < gamma or not best.size:
            gamma = reached
            best = x
        if gamma <= options.sufficient_gamma:
            break
    tell(1.0, "synthesis")
    return programme.result(gamma, best)


class Programme:
    """Plants and specification on two grids: a lean one to begin with, and a dense one for checks.

    Parameters
    ----------
    plants : tuple of MultivariablePlant
        At least one (an IndexError without).
    specification : MultivariableSpecification
        Its `joints` (bandwidth, weights, integrator of each), order, structure, delay and limits.
    options : MultivariableOptions
        Sizes of the grids, rounds and steps.

    Raises
    ------
    SpecificationError
        Two plants differ in dt, U or Y, or the joints do not fit them.
    ValueError
        The order is not one for each integrator and two for each modal block.
    """

    def __init__(
        self,
        plants: tuple[MultivariablePlant, ...],
        specification: MultivariableSpecification,
        options: MultivariableOptions,
    ) -> None:
        """Build grids, nominal loops, the rows of the dense check, and the form of the controller, and refuse
        what does not fit (see the class)."""
        first = plants[0]
        for plant in plants[1:]:
            if (plant.inputs, plant.outputs, plant.dt_s) != (first.inputs, first.outputs, first.dt_s):
                raise SpecificationError(
                    f"plants {first.name!r} and {plant.name!r} differ in dt, inputs or outputs"
                )
        self.plants = plants
        self.spec = specification
        self.options = options
        self.dt_s = first.dt_s
        self.nyquist_rad_s = np.pi / self.dt_s
        self.pattern = specification.pattern(first.inputs, first.outputs)
        requirements = specification.weights(first.inputs, first.outputs)
        self.names = tuple(requirements)

        # The grids begin below the slowest corner of a weight and below what the plants need.
        corners: list[float] = []
        for _, weights in requirements.values():
            for weight in weights:
                if weight is not None:
                    corners += [abs(root) for root in np.roots(weight.denominator) if root]
        below_corners = _BELOW_CORNERS * min(corners, default=np.inf)
        self.lowest_rad_s = min(below_corners, *(lowest_rad_s(self.dt_s, plant.poles) for plant in plants))

        delay = specification.computational_delay_samples
        self.loops = [NominalLoop(plant, delay) for plant in plants]
        self.lean = [self._grid(plant, options.grid_points, options.mode_points) for plant in plants]
        dense_mode_points = _DENSE_OVER_LEAN * options.mode_points
        dense = [self._grid(plant, options.dense_points, dense_mode_points) for plant in plants]
        self.dense = stacked_rows(plants, specification, dense)
        self.scale_rad_s = self._scale()
        self.steps = 0
        # Refuses an order that no form has.
        self.form = self._form(specification.controller_order)

    def _grid(self, plant: MultivariablePlant, points: int, around: int) -> Real:
        """Frequencies (F,) of one plant, rad/s: so many logarithmic points, and so many around each mode.

        Zeros count as modes: a controller may cancel them. Of a plant that is known on its own frequencies
        only, those below Nyquist, and the numbers do not count.
        """
        if plant.own_grid is not None:
            below_nyquist = plant.own_grid < self.nyquist_rad_s
            return plant.own_grid[below_nyquist]
        modes = []
        for mode in [*plant.modes, *modes_of(plant.zeros, self.dt_s)]:
            if mode.omega_rad_s < self.nyquist_rad_s:
                modes.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), _LEAST_MODE_DAMPING)))
        highest_rad_s = _BELOW_NYQUIST * np.pi / self.dt_s
        mode_points = around * len(modes)
        return frequency_grid(
            highest_rad_s, modes, omega_min_rad_s=self.lowest_rad_s, n_log=points, n_mode=mode_points
        )

    def _scale(self) -> float:
        """Frequency, rad/s, around which the controller has to act.

        The geometric mean of the joints' bandwidths and of where their tracking weights fall to one; without
        any, `_SCALE_OF_NYQUIST` of Nyquist.
        """
        bandwidths = [joint.bandwidth_rad_s for joint in self.spec.joints]
        frequencies = [bandwidth for bandwidth in bandwidths if bandwidth is not None]
        # Eighty points a decade: the frequency of a weight is known to 3 %, which a scale need not be. Up to
        # .99 of Nyquist, where Tustin's s is infinite.
        omega = np.geomspace(1e-5, 0.99, 400) * np.pi / self.dt_s
        for joint in self.spec.joints:
            weight = joint.sensitivity_weight
            if weight is None:
                continue
            tracked = np.abs(weight.at(tustin_s(omega, self.dt_s))) > 1.0
            if np.any(tracked):
                frequencies.append(float(omega[tracked][-1]))
        if not frequencies:
            return _SCALE_OF_NYQUIST * float(self.nyquist_rad_s)
        return float(np.exp(np.mean(np.log(frequencies))))

    def _form(self, order: int) -> ModalForm:
        """Map between parameters and a controller with so many states; `ModalForm` refuses an order that is
        not one for each integrator and two for each block (ValueError)."""
        joints = self.spec.joints[: self.plants[0].outputs]
        return ModalForm(
            self.pattern,
            order,
            integrates=np.array([joint.integrator for joint in joints]),
            scale_rad_s=_FORM_SCALE * self.scale_rad_s,
            slowest_rad_s=_SLOWEST_CORNER * self.lowest_rad_s,
            dt_s=self.dt_s,
            damping=self.spec.controller_damping,
        )

    def starts(self) -> list[Real]:
        """Parameters (n,) to begin with, those of the lowest worst case on the dense grid first.

        Returns
        -------
        list of ndarray, shape (n,)
            Reduced H-infinity controllers of the first plant, and static gains with blocks that do nothing
            yet. The former not for a structure with zeros, nor where channels have errors of their own, which
            `weighted_plant` neglects.

        Raises
        ------
        SpecificationError
            There is no H-infinity start, and no static gain of the structure stabilises the plants.
        """
        starts: list[tuple[float, Real]] = []
        has_channel_errors = any(plant.input_error or plant.output_error for plant in self.plants)
        if self.pattern.all() and not has_channel_errors:
            plant = self.plants[0]
            slowest = self.lowest_rad_s
            # LinAlgError: a pole at z = -1, or a problem that rounding spoils.
            with suppress(np.linalg.LinAlgError):
                # Reduction counts errors in the requirements, and not in what the ball sees.
                without_ball = replace(plant, ball=None)
                plain = weighted_plant(without_ball, self.spec, 1.0, self.scale_rad_s, slowest)
                for scaling in _SCALINGS:
                    P = weighted_plant(plant, self.spec, scaling, self.scale_rad_s, slowest)
                    K = central_controller(P)
                    if K is None or K.A.shape[0] < self.form.order:
                        continue
                    # Up to 2/dt, Tustin's frequency of half of Nyquist. Chosen.
                    K = reduced(K, plain, self.form.order, self.lowest_rad_s, 2 / self.dt_s)
                    x = self.form.realised(*K)
                    if x is not None:
                        starts.append((self.worst(x), x))
        starts = [start for start in starts if np.isfinite(start[0])]
        try:
            starts += [(self.worst(x), x) for _, x in self.static()]
        except SpecificationError:
            if not starts:
                raise
        return [x for _, x in sorted(starts, key=lambda start: start[0])]

    def static(self) -> list[tuple[float, Real]]:
        """Static gains with idle blocks, as (worst case on the lean grid, parameters (n,)), the best first.

        Returns
        -------
        list of (float, ndarray of shape (n,))

        Raises
        ------
        SpecificationError
            None is robustly stable.

        Notes
        -----
        A gain is the real part of a pseudo-inverse of the first plant at a frequency around the scale,
        turned by a lag, with zeros where the structure has them. Of its factors the largest ones are mostly
        unstable: going down, the worst case falls from the first stable one, and the search ends where it
        rises again.
        """
        form = self.form
        idle_blocks = form.spread(_LOWEST_IDLE_CORNER, _HIGHEST_IDLE_CORNER, _IDLE_DAMPING)
        descent = MatrixDescent(form, stacked_rows(self.plants, self.spec, self.lean), self.loops)
        gains: list[tuple[float, Real]] = []
        for omega in self.scale_rad_s * np.array(_INVERTED_AT):
            G = matrix_response(self.plants[0].nominal, np.array([omega]))[0]
            for lag in _LAGS:
                turned_plant = G * np.exp(1j * np.pi * lag)
                inverse = np.linalg.pinv(turned_plant).real
                D = np.where(self.pattern, inverse, 0.0)
                # Loop gain of one at this frequency.
                loop_gain = np.linalg.norm(G @ D, 2)
                if loop_gain > 0:
                    D = D / loop_gain
                best: tuple[float, Real] | None = None
                for gain in _GAINS:
                    C_0 = _INTEGRAL_CORNER * omega * gain * D[:, form.integrates]
                    x = form.join(*idle_blocks, gain * D, C_0)
                    bound = descent.bound(x, None)
                    if bound is None and best is None:
                        continue
                    gamma = np.inf if bound is None else float(np.max(bound.gamma))
                    if best is not None and gamma > best[0]:
                        break
                    best = (gamma, x)
                if best is not None:
                    gains.append(best)
        if not gains:
            raise SpecificationError(
                "no static gain of this structure stabilises the plant robustly; allow more entries of K "
                "(structure), or close a stabilising loop first and design around it"
            )
        # One gain may be found at several frequencies.
        gains.sort(key=lambda gain: gain[0])
        previous = [0.0, *(gamma for gamma, _ in gains)]
        pairs = zip(gains, previous, strict=False)
        return [gain for gain, gamma_before in pairs if gain[0] > (1 + _SAME) * gamma_before]

    def improved(
        self, x: Real, tell: Callable[[float, str], None] = lambda fraction, message: None
    ) -> tuple[Real, float]:
        """Local minimum of the worst case, by rounds of descent with violated frequencies added.

        Parameters
        ----------
        x : ndarray, shape (n,)
            Where to begin; one that is not robustly stable on the lean grids is returned at once.
        tell : callable
            Called with (fraction, message) at every round.

        Returns
        -------
        best : ndarray, shape (n,)
        gamma : float
            Its worst case on the dense grid; inf: nothing robustly stable was found.

        Notes
        -----
        Ends where the dense check exceeds the lean grid by no more than `_EXCESS` and the descent has come to
        its end. Frequencies of an end that is not robustly stable join `lean` for later starts as well.
        """
        grids = list(self.lean)
        best = x
        least = self.worst(x)
        for number in range(self.options.rounds):
            message = f"worst case {least:.3g}" if np.isfinite(least) else "looking for robust stability"
            tell(number / self.options.rounds, message)
            light = self._light(x)
            grids = [np.union1d(grid, added) for grid, added in zip(grids, light, strict=True)]
            descent = MatrixDescent(self.form, stacked_rows(self.plants, self.spec, grids), self.loops)
            end, reached, steps = descent.run(x, self.options.steps)
            self.steps += steps
            if not np.isfinite(reached):
                break

            checked = self.check(end)
            worst = max(float(np.max(value)) for _, value in checked)
            gain = least / worst - 1.0 if np.isfinite(least) else np.inf
            if worst < least:
                best = end
                least = worst
            if np.isfinite(worst):
                # Else once more from the same point, with the frequencies that were missing.
                x = end
            grids_agree = worst <= reached * (1 + _EXCESS)
            # A round that gains less than half of the excess accepted is as good as ended.
            has_ended = steps < self.options.steps or gain < _EXCESS / 2
            if (grids_agree and has_ended) or least <= self.options.sufficient_gamma:
                break

            # Half of the excess accepted: what would just pass joins the grid as well.
            limit = reached * (1 + 0.5 * _EXCESS)
            for i, (omega, value) in enumerate(checked):
                maxima = [k for k in local_maxima(value) if value[k] > limit]
                violated = omega[maxima[:_MOST_ADDED]]
                grids[i] = np.union1d(grids[i], violated)
                if not np.isfinite(worst):
                    self.lean[i] = np.union1d(self.lean[i], violated)
        return best, least

    def worst(self, x: Real) -> float:
        """Worst case of parameters x (n,) on the dense grid and around light poles.

        inf for an unstable nominal loop, or where some row shows no robust stability.
        """
        a, b, c, d = self.form.discrete(x)
        if not all(np.all(np.abs(loop.poles(a, b, c, d)) < 1.0) for loop in self.loops):
            return float("inf")
        return max(float(np.max(value)) for _, value in self.check(x))

    def check(self, x: Real) -> list[tuple[Real, Real]]:
        """Worst case over all requirements by frequency, for each plant.

        Parameters
        ----------
        x : ndarray, shape (n,)
            With stable nominal loops (not checked: of an unstable one the values mean nothing).

        Returns
        -------
        list of (omega (F,), gamma (F,))
            Frequencies of the dense check and around light poles, ascending, rad/s; gamma is inf where no
            robust stability is shown.
        """
        light = self._light(x)
        stacks = [(self.dense, self._gamma(x, self.dense))]
        if any(omega.size for omega in light):
            light_rows = stacked_rows(self.plants, self.spec, light)
            stacks.append((light_rows, self._gamma(x, light_rows)))
        checked = []
        for number in range(len(self.plants)):
            omega_parts = []
            gamma_parts = []
            for stack, gamma in stacks:
                of_plant = stack.plant == number
                omega_parts.append(stack.omega_rad_s[of_plant])
                gamma_parts.append(gamma[of_plant])
            # The largest of all requirements at each frequency.
            unique, inverse = np.unique(np.concatenate(omega_parts), return_inverse=True)
            worst = np.zeros(unique.size)
            np.maximum.at(worst, inverse, np.concatenate(gamma_parts))
            checked.append((unique, worst))
        return checked

    def _gamma(self, x: Real, stack: StackedRows) -> Real:
        """Worst case (R,) of every row of a stack under parameters x (n,); inf where no robust stability is
        shown. The stack's rows and its `s` (R,), Tustin's s, are what counts."""
        K = self.form.response(x[None], stack.s)[0]
        return scaled_bound(stack.rows, K, accuracy=_ACCURACY).gamma

    def _light(self, x: Real) -> list[Real]:
        """Frequencies (F,), rad/s, around lightly damped poles of each plant's loop and of the controller.

        Empty where no pole is light, and for plants that are known on their own frequencies only.
        """
        abcd = self.form.discrete(x)
        controller_poles = np.linalg.eigvals(abcd[0])
        frequencies = []
        for plant, loop in zip(self.plants, self.loops, strict=True):
            poles = np.concatenate([controller_poles, loop.poles(*abcd)])
            points = [np.zeros(0)]
            for mode in modes_of(poles, self.dt_s, zeta_below=_LIGHT):
                half_width = max(abs(mode.zeta), _LEAST_DAMPING)
                points.append(mode.omega_rad_s * (1 + half_width * _AROUND))
            omega = np.unique(np.concatenate(points))
            if plant.own_grid is not None:
                omega = omega[:0]
            below_nyquist = omega < _BELOW_NYQUIST * np.pi / self.dt_s
            positive = omega > 0
            frequencies.append(omega[positive & below_nyquist])
        return frequencies

    def result(self, gamma: float, x: Real) -> MultivariableResult:
        """The controller of parameters x and what is known of it.

        Parameters
        ----------
        gamma : float
            Worst case on the dense grid; inf: the controller means nothing. It is taken as given; `worst` and
            `blocking` are computed anew.
        x : ndarray, shape (n,)

        Returns
        -------
        MultivariableResult
            Its outcome: met up to 1, not met above, not converged for inf.

        Raises
        ------
        ValueError
            No anti-windup gain exists for the limits, from `Controller`.
        """
        stack = self.dense
        K = self.form.response(x[None], stack.s)[0]
        bound = scaled_bound(stack.rows, K, accuracy=_ACCURACY)
        value = bound.gamma
        joint = largest_channel(stack.rows, K, bound.right)

        # Where each requirement is worst.
        worst: dict[str, float] = {}
        blocking: list[BlockingPoint] = []
        for which, name in enumerate(self.names):
            rows = np.flatnonzero(stack.requirement == which)
            if not rows.size:
                continue
            at = rows[np.argmax(value[rows])]
            worst[name] = float(value[at])
            plant_name = self.plants[int(stack.plant[at])].name
            omega = float(stack.omega_rad_s[at])
            blocking.append(BlockingPoint(plant_name, name, omega, worst[name], int(joint[at])))
        blocking.sort(key=lambda point: -point.value)

        input_limits, rate_limits = self.spec.limits(self.form.inputs)
        a, b, c, d = self.form.discrete(x)
        controller = Controller(
            a,
            b,
            c,
            d,
            self.dt_s,
            computational_delay_samples=self.spec.computational_delay_samples,
            input_limit=input_limits if any(input_limits) else None,
            rate_limit=rate_limits if any(rate_limits) else None,
        )
        controller = with_safe_limits(
            controller, lambda law: [limited_joints(law, plant) for plant in self.plants]
        )
        if gamma <= 1.0:
            outcome = Outcome.MET_ON_GRID
        elif np.isfinite(gamma):
            outcome = Outcome.NOT_MET
        else:
            outcome = Outcome.NOT_CONVERGED
        return MultivariableResult(outcome, controller, gamma, worst, tuple(blocking), self.steps)
