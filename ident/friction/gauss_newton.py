"""A linear arm and its dry friction as least squares: derivatives, Gauss-Newton steps, covariance.

The simulation of `ident.friction.arm` is differentiated with respect to the coefficients of the arm on its
doubled poles and to the parameters of the friction's law; the poles themselves stay. `descended` steps a free
run from a start (`started`) as long as its residual falls, `with_covariance` says what the records leave
open. `FrictionFit` holds the result and makes of a record its motion, its friction, and the record without
it, also where an observer follows the log (`ident.friction.estimator`). A vector of law parameters is (level,
log presliding) or (level, log presliding, excess, log fall): logarithms stand at odd places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.signal import lfilter

from ident.basis.functions import basis_response, regressor
from ident.basis.model import GobfModel
from ident.basis.structure import Structure, answered, filter_input
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.data.record import Record
from ident.friction.arm import FrictionLaw, SteppedArm, less_friction
from ident.friction.spring import Spring
from ident.uncertainty.embedding_algebra import triangle_of

# Standard deviation of the logarithms in the law (pre-sliding deflection, Stribeck speed), a priori: two of
# them are a factor of twenty. Chosen.
STD_LOG = 1.5
# Weight of what is expected of a logarithm that is to stay: one over its deviation, 1e-4.
_HELD = 1e4
# How well a joint's friction repeats from record to record at best, as a share of its level: a common level
# would be known better than any simulation of friction is right (docs/decisions.md).
_REPEATS = 1e-3
# Gauss-Newton steps at most. Chosen; they end where the residual no longer falls.
_STEPS = 8
# A step, and its parts where the whole does not lower the residual.
_LENGTHS = (1.0, 0.5, 0.25, 0.1)
# Least level after a step, as a share of the level before. Chosen: one step may not lose the friction.
_LEAST_LEVEL_SHARE = 0.6
# Largest step of a logarithm: a factor of e. Beyond that the linearised friction is another law.
_LARGEST_LOG_STEP = 1
# A residual sum of squares that falls by less than this many noise variances is at its end: half of what
# one more parameter explains of noise alone.
WORTH = 0.5
# Size of the changes that derivatives of a simulation are taken from, relative to the motion and to the
# level: its friction turns at other times after a large change.
_CHANGE = 1e-6
# Where an observer tells the friction, changes are relative to the level, large beside its rounding: of the
# level and the excess,
_CHANGE_OF_LEVEL = 2e-3
# of logarithms,
CHANGE_OF_LOG = 0.02
# of the drive's lag, relative to it,
_CHANGE_OF_LAG = 1e-3
# and of the level beyond a spring, whose load stands or slips. All four chosen.
_CHANGE_BEYOND = 0.05
# Smallest singular value that counts, as a share of the largest. Rounding of doubles.
_RANK = 1e-12


class LostError(ValueError):
    """No simulation or observer follows the logs with this arm and law."""

    def __init__(self) -> None:
        """An error that tells the user what to state instead."""
        super().__init__(
            "no model of the arm with dry friction follows the logs; response = 'as recorded' needs none, "
            "n_real and n_pairs state the number of poles"
        )


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """A linear arm with dry friction, fitted to records of its shaft's position.

    Attributes
    ----------
    law : FrictionLaw
        In units of the input.
    model : GobfModel
        The arm without friction, each pole once.
    arm : SteppedArm
        The arm with each pole twice, in continuous time.
    coefficients : ndarray, shape (P,)
        Of `arm`, on the basis functions of the doubled poles.
    covariance_factor : ndarray, shape (P + Q, K)
        F of the covariance F F' of the coefficients and the Q parameters of the law (level, logarithm of the
        deflection; excess, logarithm of its speed); behind an observer further rows follow in the order lag,
        bias, level beyond the spring, each where it was fitted.
    noise_std : float
        Of the residual, output units.
    between : float
        Standard deviation of the level from record to record, units of the input.
    correction : ndarray of complex, shape (N,), or None
        Gain of the observer that follows the records (`step_through`); None: a free run.
    ratio : float
        Force that the observer was made for, in units of the input per unit of the position's noise.
    bias : float
        Constant force, units of the input.
    spring : Spring or None
        The first spring of the arm, where friction acts beyond it.
    beyond : float
        Level of the friction beyond the spring, units of the input.
    centre : float
        From where positions of an arm that does not integrate are told, output units.
    lag : float
        Of the drive, in samples: the command reaches the shaft through 1 / (1 + lag s), s in 1 / samples
        (`lag_filter`), the friction does not.
    """

    law: FrictionLaw
    model: GobfModel
    arm: SteppedArm
    coefficients: RealArray
    covariance_factor: RealArray
    noise_std: float
    between: float
    correction: ComplexArray | None = None
    ratio: float = 0.0
    bias: float = 0.0
    spring: Spring | None = None
    beyond: float = 0.0
    centre: float = field(default=0.0, metadata={"since": 2})
    lag: float = field(default=0.0, metadata={"since": 3})

    @property
    def observed(self) -> bool:
        """An observer follows the records (`ident.friction.estimator`): those of a loop, and what no free run
        explains."""
        return self.correction is not None

    @property
    def level(self) -> float:
        """Coulomb friction in units of the input, on both sides of a spring."""
        return self.law.level + self.beyond

    @property
    def level_std(self) -> float:
        """Standard deviation of the level that the records have in common, units of the input."""
        rows = [self.coefficients.size]
        if self.spring is not None:
            # The level beyond the spring has the last row.
            rows.append(-1)
        return float(np.linalg.norm(self.covariance_factor[rows].sum(axis=0)))

    def moved(self, change: RealArray) -> tuple[RealArray, FrictionLaw]:
        """Coefficients (P,) and law after a change (P + Q, or more), no force of the law below zero."""
        n = self.coefficients.size
        parameters = parameters_of(self.law)
        law = law_of(parameters + change[n : n + parameters.size])
        return self.coefficients + change[:n], law

    @property
    def significant(self) -> bool:
        """The level is more than three of its standard deviations above zero."""
        return self.level > 3 * self.level_std

    def motion(self, record: Record, law: FrictionLaw | None = None) -> tuple[RealArray, RealArray]:
        """Simulated motion of the shaft in a record, free or as the observer predicts it.

        Parameters
        ----------
        record : Record
            One input, and the position as the one output.
        law : FrictionLaw, optional
            Default that of the fit.

        Returns
        -------
        tuple of ndarray, shape (T,) each
            Position; friction at the shaft in units of the input, held over each sample, without the bias and
            the friction beyond a spring.
        """
        law = law or self.law
        if self.correction is None:
            return self.arm.run(self.coefficients, record.input[:, 0], law)
        delay = self.arm.structure.input_delay_samples
        position = self.observed_position(record)
        driving = less_friction(self.behind_drive(record), self.steady(record), delay).input[:, 0]
        return self.arm.run(self.coefficients, driving, law, position, self.correction)

    def observed_position(self, record: Record) -> RealArray:
        """Position (T,) above the point an observer counts from: the start, where the arm integrates."""
        position = record.output[:, 0]
        origin = position[0] if self.arm.structure.integrators else self.centre
        return np.asarray(position - origin)

    def steady(self, record: Record) -> RealArray:
        """Bias and friction beyond the spring (T,), at the shaft, units of the input.

        The observer need not simulate them: they follow from the record.
        """
        force = np.full(record.n_samples, self.bias)
        return force if self.spring is None else force + self.force_beyond(record, self.beyond, self.law)

    def force_beyond(self, record: Record, level: float, law: FrictionLaw) -> RealArray:
        """Friction (T,) of a level beyond the spring, as it acts at the shaft; all in units of the input.

        `law` is that of the shaft; the friction of the load falls with speed alike.
        """
        assert self.spring is not None
        return level * self.spring.force(record.output[:, 0], level, law)

    def residual(self, record: Record) -> RealArray:
        """What the simulation leaves of the position (T - delay,), less its mean, output units.

        Rows that answer to an input before the record are left out.
        """
        position = self.motion(record)[0]
        residual = answered(record.output[:, 0] - position, self.arm.structure.input_delay_samples)
        return np.asarray(residual - residual.mean())

    def behind_drive(self, record: Record) -> Record:
        """A record with what the drive's lag makes of its input, which starts steady: the mean over each
        sample."""
        if not self.lag:
            return record
        numerator, denominator = lag_filter(self.lag)
        start = record.input[0]
        return replace(record, input=start + lfilter(numerator, denominator, record.input - start, axis=0))

    def forced(self, record: Record) -> Record:
        """A record with the force on a linear arm as its input: command behind the drive less friction.

        Raises
        ------
        LostError
            The friction is not finite.
        """
        delay = self.arm.structure.input_delay_samples
        return less_friction(self.behind_drive(record), self._friction(record), delay)

    def taken_off(self, record: Record) -> Record:
        """A record with its input smaller by the friction, as a command before the drive's lag would make it.

        Raises
        ------
        LostError
            The friction is not finite.
        """
        friction = self._friction(record)
        # 1 + lag s, by central differences: to second order what the drive's lag takes away again.
        through_drive = friction + self.lag * np.gradient(friction)
        return less_friction(record, through_drive, self.arm.structure.input_delay_samples)

    def _friction(self, record: Record) -> RealArray:
        """Friction (T,), units of the input; behind an observer with bias and what is beyond a spring.

        Raises LostError where it is not finite.
        """
        friction = self.motion(record)[1]
        if not np.all(np.isfinite(friction)):
            raise LostError
        return friction + self.steady(record) if self.observed else friction

    def drive_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Frequency response (F,) of the drive's lag, without unit, at omega_rad_s (F,)."""
        if not self.lag:
            return np.ones(omega_rad_s.size, np.complex128)
        numerator, denominator = lag_filter(self.lag)
        later = np.exp(-1j * omega_rad_s * self.arm.dt_s)
        over = denominator[0] + denominator[1] * later
        return np.asarray((numerator[0] + numerator[1] * later) / over)


def lag_steps(lag_samples: float) -> RealArray:
    """Pole p of a drive's lag, and share c of a sample by which its mean stays with its state: (2,).

    A held command u reaches the arm through 1 / (1 + lag s), s in 1 / samples. Its state x moves to
    p x + (1 - p) u in a sample, p = exp(-1 / lag), and has the mean u - c (u - x) over it, c = lag (1 - p).
    Both are zero without a lag (`lag_samples` = 0).
    """
    if not lag_samples > 0:
        return np.zeros(2)
    pole = float(np.exp(-1 / lag_samples))
    return np.array([pole, lag_samples * (1 - pole)])


def lag_filter(lag_samples: float) -> tuple[RealArray, RealArray]:
    """Numerator (2,) and denominator (2,), in q^-1, of the mean over each sample behind a drive's lag.

    Of `lag_steps`, (1 - c + (c - p) q^-1) / (1 - p q^-1); `lag_samples` at least zero.
    """
    pole, share = lag_steps(lag_samples).tolist()
    return np.array([1 - share, share - pole]), np.array([1.0, -pole])


def parameters_of(law: FrictionLaw) -> RealArray:
    """Parameters of a law as a vector, shape (2,) or, where friction falls with speed, (4,).

    Level, logarithm of the pre-sliding deflection; excess, logarithm of its speed. Units of `FrictionLaw`.
    """
    parameters = [law.level, np.log(law.presliding)]
    if np.isfinite(law.fall):
        parameters += [law.excess, np.log(law.fall)]
    return np.array(parameters)


def law_of(parameters: RealArray) -> FrictionLaw:
    """Law of the parameters (2,) or (4,) of `parameters_of`, no force below zero."""
    level, log_presliding, *falling = parameters.tolist()
    law = FrictionLaw(max(level, 0.0), float(np.exp(log_presliding)))
    if not falling:
        return law
    excess, log_fall = falling
    return replace(law, excess=max(excess, 0.0), fall=float(np.exp(log_fall)))


class Linearised(NamedTuple):
    """A simulation of T samples to first order in P coefficients and Q parameters of the law.

    position, friction (T,): output and input units; position_by, friction_by (T, P + Q): their derivatives.
    """

    position: RealArray
    friction: RealArray
    position_by: RealArray
    friction_by: RealArray


def linearised(arm: SteppedArm, coefficients: RealArray, law: FrictionLaw, u: RealArray) -> Linearised:
    """The simulation of an arm with friction to first order.

    Parameters
    ----------
    arm : SteppedArm
    coefficients : ndarray, shape (P,)
    law : FrictionLaw
    u : ndarray, shape (T,)
        Input.

    Returns
    -------
    Linearised
        The friction follows every change.

    Notes
    -----
    One-sided differences, for a simulation with a small change runs through the same turns. Each change moves
    the position's rms step by 1e-6 of itself.
    """
    position, friction = arm.run(coefficients, u, law)
    structure = arm.structure
    effort = filter_input(u, 0, structure.input_delay_samples) - friction
    columns = regressor(arm.poles.doubled(), filter_input(effort, structure.integrators, 0))
    speed = float(np.std(np.diff(position)))
    parameters = parameters_of(law)
    position_by = np.empty((u.size, columns.shape[1] + parameters.size))
    friction_by = np.empty_like(position_by)

    def differentiate(j: int, size: float, changed: RealArray, changed_law: FrictionLaw) -> None:
        """Fill columns j from a simulation with coefficients (P,) or law changed by a size."""
        changed_position, changed_friction = arm.run(changed, u, changed_law)
        position_by[:, j] = (changed_position - position) / size
        friction_by[:, j] = (changed_friction - friction) / size

    for j, column in enumerate(columns.T):
        column_speed = max(float(np.std(np.diff(column))), np.finfo(np.float64).tiny)
        change = np.zeros(coefficients.size)
        change[j] = _CHANGE * speed / column_speed
        differentiate(j, change[j], coefficients + change, law)
    for k in range(parameters.size):
        change = np.zeros(parameters.size)
        is_logarithm = k % 2 == 1
        # An excess has no size of its own before it is known, and cannot be negative.
        change[k] = _CHANGE if is_logarithm else _CHANGE * law.level
        differentiate(columns.shape[1] + k, change[k], coefficients, law_of(parameters + change))
    return Linearised(position, friction, position_by, friction_by)


def equations(fit: FrictionFit, records: Sequence[Record]) -> tuple[list[RealArray], list[RealArray]]:
    """Equations of a Gauss-Newton step of a free run, record by record.

    Parameters
    ----------
    fit : FrictionFit
        Without an observer.
    records : sequence of Record

    Returns
    -------
    tuple of two lists of ndarray
        Derivatives (T - delay, P + Q) of the simulated position, and what it leaves of the measured one
        (T - delay,), output units.
    """
    delay = fit.arm.structure.input_delay_samples
    blocks = []
    targets = []
    for record in records:
        local = linearised(fit.arm, fit.coefficients, fit.law, record.input[:, 0])
        blocks.append(answered(local.position_by, delay))
        targets.append(answered(record.output[:, 0] - local.position, delay))
    return blocks, targets


def driven_by_law(fit: FrictionFit, record: Record) -> RealArray:
    """Derivatives (T, Q') of an arm's (stabilised) position where an observer tells the friction of a record.

    Parameters
    ----------
    fit : FrictionFit
        With an observer.
    record : Record

    Returns
    -------
    ndarray, shape (T, Q')
        Output units per unit of: the parameters of the law (2 or 4), the drive's lag where there is one, the
        bias of an integrating arm, the level beyond a spring where there is one.

    Notes
    -----
    The observer follows the measured motion whatever the parameters are, so that a change of the friction is
    a change of the linear arm's input.
    """
    structure = fit.arm.structure
    arm = replace(fit.model.stable_part, input_delay_samples=0)
    friction = fit.motion(record)[1]
    parameters = parameters_of(fit.law)
    force_beyond: RealArray | float = 0.0
    if fit.spring is not None:
        force_beyond = fit.force_beyond(record, fit.beyond, fit.law)
    columns = []
    for k in range(parameters.size):
        is_logarithm = k % 2 == 1
        size = CHANGE_OF_LOG if is_logarithm else _CHANGE_OF_LEVEL * fit.level
        change = np.zeros(parameters.size)
        change[k] = size
        law = law_of(parameters + change)
        column = (fit.motion(record, law)[1] - friction) / size
        if fit.spring is not None and np.isfinite(fit.law.fall):
            # The friction of the load falls with speed as that of the shaft.
            column = column + (fit.force_beyond(record, fit.beyond, law) - force_beyond) / size
        columns.append(column)
    if fit.lag:
        # More lag moves the arm as friction does that takes away what it changes of the command.
        slower = replace(fit, lag=(1 + _CHANGE_OF_LAG) * fit.lag).behind_drive(record).input[:, 0]
        lost = (fit.behind_drive(record).input[:, 0] - slower) / (_CHANGE_OF_LAG * fit.lag)
        columns.append(filter_input(lost, 0, structure.input_delay_samples))
    if structure.integrators:
        columns.append(np.ones(friction.size))
    if fit.spring is not None:
        size = _CHANGE_BEYOND * fit.level
        larger = fit.force_beyond(record, fit.beyond + size, fit.law)
        columns.append((larger - force_beyond) / size)
    return np.column_stack([-arm.simulate(column) for column in columns])


def started(model: GobfModel, structure: Structure, law: FrictionLaw) -> FrictionFit:
    """Where Gauss-Newton steps on the poles of a model begin; nothing is known of the noise yet.

    Parameters
    ----------
    model : GobfModel
        Of the arm without friction; its response is taken over to its poles taken twice.
    structure : Structure
    law : FrictionLaw

    Returns
    -------
    FrictionFit
        With covariance factor, noise and spread of the level zero.

    Raises
    ------
    ValueError
        More than one integrator, or a direct term.
    """
    arm = SteppedArm.of(model.poles, structure, model.dt_s)
    # Least squares over 400 frequencies up to Nyquist's; the doubled poles span the response exactly.
    z = np.exp(1j * np.linspace(1e-3, np.pi, 400))
    doubled_basis = basis_response(arm.poles.doubled(), z)
    basis = basis_response(model.poles, z)
    target = real_rows(basis @ model.coefficients)
    coefficients = np.asarray(np.linalg.lstsq(real_rows(doubled_basis), target, rcond=None)[0])
    no_covariance = np.zeros((coefficients.size + parameters_of(law).size, 1))
    return FrictionFit(law, model, arm, coefficients, no_covariance, 0.0, 0.0)


def descended(
    fit: FrictionFit,
    records: Sequence[Record],
    presliding: float,
    least_level: float,
    *,
    held: bool = True,
) -> FrictionFit:
    """A fit after Gauss-Newton steps of its free run, as long as the residual falls, with its covariance.

    Parameters
    ----------
    fit : FrictionFit
        Where the steps begin.
    records : sequence of Record
        At rest at their first sample.
    presliding : float
        Deflection that is expected, units of the position; of no effect where held.
    least_level : float
        Which the level stays above, units of the input.
    held : bool
        Logarithms in the law stay, for far from the arm they would take up what is wrong with it. Otherwise
        the pre-sliding deflection is expected near `presliding`, a Stribeck speed where it begins.

    Returns
    -------
    FrictionFit

    Raises
    ------
    LostError
        The simulation runs away.
    """
    n = sum(fit.residual(record).size for record in records)
    expected_law = fit.law if held else replace(fit.law, presliding=presliding)
    expected = parameters_of(expected_law)
    trust = _HELD if held else 1 / STD_LOG
    n_coefficients = fit.coefficients.size
    n_parameters = expected.size
    logs = np.arange(1, n_parameters, 2)
    noise = np.sqrt(simulated_rss(fit, records) / n)
    for steps_left in reversed(range(_STEPS)):
        blocks, targets = equations(fit, records)
        # What is expected of a logarithm is one more measurement of it.
        known = np.zeros((logs.size, n_coefficients + n_parameters + 1))
        known[:, n_coefficients + logs] = np.eye(logs.size)
        known[:, -1] = (expected - parameters_of(fit.law))[logs]
        solution = least_squares(blocks, targets, trust * noise * known)
        noise = np.sqrt(solution.residual_rss / n)
        # The last round only makes the equations that the covariance is read from.
        lengths = _LENGTHS if steps_left else ()
        for length in lengths:
            step = length * solution.change
            lowest = max(_LEAST_LEVEL_SHARE * fit.level, least_level)
            step[n_coefficients] = max(step[n_coefficients], lowest - fit.level)
            log_steps = step[n_coefficients + logs]
            step[n_coefficients + logs] = np.clip(log_steps, -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP)
            coefficients, law = fit.moved(step)
            candidate = replace(fit, coefficients=coefficients, law=law)
            off_expected = trust * noise * (parameters_of(law) - expected)[logs]
            candidate_rss = simulated_rss(candidate, records) + off_expected @ off_expected
            if candidate_rss < solution.target_rss - WORTH * noise**2:
                fit = candidate
                break
        else:
            break
    return with_covariance(fit, blocks, targets, float(noise))


def with_covariance(
    fit: FrictionFit, blocks: Sequence[RealArray], targets: Sequence[RealArray], noise: float
) -> FrictionFit:
    """A fit with what its equations leave open: covariance factor, noise and spread of the level.

    Parameters
    ----------
    fit : FrictionFit
        With P coefficients and Q parameters of the law.
    blocks, targets : sequence of ndarray, shapes (M, P + Q, or more) and (M,)
        Equations of each record (`equations`).
    noise : float
        Standard deviation of the residual, in the units of the targets.

    Returns
    -------
    FrictionFit

    Raises
    ------
    LostError
        A column of the equations is lost beside numbers of a simulation that runs away.

    Notes
    -----
    Every record has a level of its own, about the common one; it and the logarithms in the law are known
    beforehand, as further measurements.
    """
    n_records = len(blocks)
    n = sum(target.size for target in targets)
    n_coefficients = fit.coefficients.size
    logs = np.arange(1, parameters_of(fit.law).size, 2)
    between = _between_records(blocks, targets, n_coefficients, _REPEATS * fit.level)
    wider_blocks = []
    for k, block in enumerate(blocks):
        own_level = np.outer(between * block[:, n_coefficients], np.arange(n_records) == k)
        wider_blocks.append(np.hstack([block, own_level]))
    known = np.zeros((logs.size + n_records, blocks[0].shape[1] + n_records + 1))
    known[: logs.size, n_coefficients + logs] = noise / STD_LOG * np.eye(logs.size)
    known[logs.size :, -n_records - 1 : -1] = noise * np.eye(n_records)
    solution = least_squares(wider_blocks, targets, known)
    scale = np.linalg.norm(solution.triangle, axis=0)
    if not np.all(scale > 0):
        raise LostError

    # The covariance is that of the noise, not of a residual that another step would still lower.
    noise_std = np.sqrt(solution.residual_rss / n)
    inverse = solve_triangular(solution.triangle / scale, np.eye(scale.size))
    factor = noise_std * inverse / scale[:, None]
    # Without the levels of the single records, and with no more columns than rows.
    factor = np.asarray(np.linalg.qr(factor[: blocks[0].shape[1]].T, mode="r")).T
    target_std = float(np.sqrt(solution.target_rss / n))
    return replace(fit, covariance_factor=factor, noise_std=target_std, between=between)


def _between_records(
    blocks: Sequence[RealArray], targets: Sequence[RealArray], level_column: int, least: float
) -> float:
    """Standard deviation of the level from record to record, in units of the input, not below `least`.

    `blocks` (M, P + Q) and `targets` (M,) are equations of each record; the level has one column of them.
    Each record is given a level of its own; of their spread that is taken off which their own errors explain
    (DerSimonian and Laird, Controlled Clinical Trials 7, 1986). `least` where there is one record.
    """
    n_records = len(blocks)
    if n_records == 1:
        return least
    with_own_levels = []
    for k, block in enumerate(blocks):
        common = np.delete(block, level_column, axis=1)
        own_level = np.outer(block[:, level_column], np.arange(n_records) == k)
        with_own_levels.append(np.hstack([common, own_level]))
    n = sum(target.size for target in targets)
    nothing_known = np.zeros((0, with_own_levels[0].shape[1] + 1))
    solution = least_squares(with_own_levels, targets, nothing_known)
    scale = np.linalg.norm(solution.triangle, axis=0)
    is_empty = scale == 0
    scale[is_empty] = 1.0
    inverse = np.linalg.pinv(solution.triangle / scale)[-n_records:] / scale[-n_records:, None]
    weight = n / solution.residual_rss / np.sum(inverse**2, axis=1)
    levels = solution.change[-n_records:]
    spread = float(np.sum(weight * (levels - np.average(levels, weights=weight)) ** 2))
    effective_weight = weight.sum() - np.sum(weight**2) / weight.sum()
    variance = (spread - (n_records - 1)) / effective_weight
    return float(np.sqrt(max(variance, least**2)))


def simulated_rss(fit: FrictionFit, records: Sequence[Record]) -> float:
    """Sum of squares of the residuals, each record's less its mean, output units squared."""
    return float(sum(np.sum(fit.residual(record) ** 2) for record in records))


class Solution(NamedTuple):
    """Least squares of P unknowns.

    change (P,): the unknowns; triangle (P, P): R of the equations, R'R their normal matrix; target_rss: sum
    of squares of the targets, residual_rss: of what the solution leaves of them.
    """

    change: RealArray
    triangle: RealArray
    target_rss: float
    residual_rss: float


def least_squares(blocks: Sequence[RealArray], targets: Sequence[RealArray], known: RealArray) -> Solution:
    """Solution of the stacked equations of all records, each less its mean, and of what is known beforehand.

    Parameters
    ----------
    blocks, targets : sequence of ndarray, shapes (M, P) and (M,)
        Equations of each record.
    known : ndarray, shape (K, P + 1)
        Further rows, taken as they are, and their targets in the last column; K may be 0.

    Returns
    -------
    Solution

    Raises
    ------
    LostError
        Something is not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        rows = np.vstack([*(block - block.mean(axis=0) for block in blocks), known[:, :-1]])
        target = np.concatenate([*(target - target.mean() for target in targets), known[:, -1]])
        # Columns of length one: units differ by many decades.
        length = np.linalg.norm(rows, axis=0)
        is_empty = length == 0
        length[is_empty] = 1.0
        triangle = triangle_of(np.column_stack([rows / length, target]))
    if not np.all(np.isfinite(triangle)):
        raise LostError
    change = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=_RANK)[0] / length
    residual_rss = float(triangle[-1, -1] ** 2)
    return Solution(change, triangle[:-1, :-1] * length, float(target @ target), residual_rss)
