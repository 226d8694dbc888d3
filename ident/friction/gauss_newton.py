"""A linear arm and its dry friction as least squares: derivatives, Gauss-Newton steps, covariance.

The simulation of `ident.friction.arm` is differentiated with respect to the coefficients of the arm on its
doubled poles and to the parameters of the friction's law; the poles themselves stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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

# Standard deviation of the logarithms in the law (pre-sliding deflection, Stribeck speed), a priori.
STD_LOG = 1.5
_HELD = 1e4  # over the deviation of a logarithm that is to stay: 1e-4
# How well a joint's friction repeats from record to record at best, as a share of its level.
_REPEATS = 1e-3
# Gauss-Newton steps at most; a step, and its parts where the whole does not lower the residual.
_STEPS, LENGTHS = 8, (1.0, 0.5, 0.25, 0.1)
# A residual sum of squares that falls by less than this many noise variances is at its end.
WORTH = 0.5
# Sizes of the changes that derivatives are taken from, relative to the motion and to the level: of the
# simulation, whose friction turns at other times after a large change, and where an observer tells it.
_CHANGE = 1e-6
_CHANGE_OF_LEVEL, CHANGE_OF_LOG, _CHANGE_BEYOND = 2e-3, 0.02, 0.05


class LostError(ValueError):
    """No simulation or observer follows the logs with this arm and law."""

    def __init__(self) -> None:
        super().__init__(
            "no model of the arm with dry friction follows the logs; response = 'as recorded' needs none, "
            "n_real and n_pairs state the number of poles"
        )


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """A linear arm with dry friction, fitted to records of its shaft's position.

    law: in units of the input. model: the arm without friction, each pole once; arm, coefficients (P,): on
    each pole twice. covariance_factor (P + Q, .): of the coefficients and the Q parameters of the law (level,
    logarithm of the deflection; excess, logarithm of its speed). noise_std: output units. between: standard
    deviation of the level from record to record.

    Where an observer follows the records: correction (N,), the observer's (`step_through`) for a force of
    `ratio` at the input (in its unit per unit of the noise); the constant force, bias, and the level beyond
    the first spring (`spring`), both in units of the input, each with a row of the covariance. centre: from
    where positions of an arm that does not integrate are told. lag: of the drive, in samples: the command
    reaches the shaft through 1 / (1 + lag (1 - q^-1)), the friction does not.
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
        """An observer follows the records (`ident.friction.in_loop`): those of a loop, and what no free run
        explains."""
        return self.correction is not None

    @property
    def level(self) -> float:
        """Coulomb friction in units of the input, on both sides of a spring."""
        return self.law.level + self.beyond

    @property
    def level_std(self) -> float:
        """Standard deviation of the level that the records have in common."""
        rows = [self.coefficients.size, *([-1] if self.spring is not None else [])]
        return float(np.linalg.norm(self.covariance_factor[rows].sum(axis=0)))

    def moved(self, change: RealArray) -> tuple[RealArray, FrictionLaw]:
        """Coefficients and law after a change (P + Q, or more), no parameter below zero."""
        n, parameters = self.coefficients.size, parameters_of(self.law)
        return self.coefficients + change[:n], law_of(parameters + change[n : n + parameters.size])

    @property
    def significant(self) -> bool:
        """The level is more than three of its standard deviations above zero."""
        return self.level > 3 * self.level_std

    def motion(self, record: Record, law: FrictionLaw | None = None) -> tuple[RealArray, RealArray]:
        """Simulated position (T,) and friction in units of the input (T,), held over each sample, under the
        fit's law or the one given."""
        law = law or self.law
        if self.correction is None:
            return self.arm.run(self.coefficients, record.input[:, 0], law)
        delay, position = self.arm.structure.input_delay_samples, self.observed_position(record)
        driving = less_friction(self.behind_drive(record), self.steady(record), delay).input[:, 0]
        return self.arm.run(self.coefficients, driving, law, position, self.correction)

    def observed_position(self, record: Record) -> RealArray:
        """(T,) from where an observer counts: the start, where the arm integrates."""
        position = record.output[:, 0]
        return np.asarray(position - (position[0] if self.arm.structure.integrators else self.centre))

    def steady(self, record: Record) -> RealArray:
        """(T,) bias and friction beyond the spring, at the shaft: what the observer need not simulate."""
        force = np.full(record.n_samples, self.bias)
        return force if self.spring is None else force + self.force_beyond(record, self.beyond, self.law)

    def force_beyond(self, record: Record, level: float, law: FrictionLaw) -> RealArray:
        """(T,) friction of a level beyond the spring, as it acts at the shaft; law: that of the shaft."""
        assert self.spring is not None
        return level * self.spring.force(record.output[:, 0], level, law)

    def residual(self, record: Record) -> RealArray:
        """(T - delay,) what the simulation leaves of the position, less its mean, in rows that answer to the
        input."""
        left = answered(record.output[:, 0] - self.motion(record)[0], self.arm.structure.input_delay_samples)
        return np.asarray(left - left.mean())

    def behind_drive(self, record: Record) -> Record:
        """The record with what the drive's lag makes of its input."""
        if not self.lag:
            return record
        pole = self.lag / (1 + self.lag)
        return replace(
            record,
            input=record.input[0] + lfilter([1 - pole], [1, -pole], record.input - record.input[0], axis=0),
        )

    def forced(self, record: Record) -> Record:
        """The record with the force on a linear arm as its input: command behind the drive less friction.
        Raises LostError where that is not finite."""
        return less_friction(
            self.behind_drive(record), self._friction(record), self.arm.structure.input_delay_samples
        )

    def taken_off(self, record: Record) -> Record:
        """The record with its input smaller by the friction, as a command makes it. Raises LostError."""
        friction = self._friction(record)
        return less_friction(
            record,
            friction + self.lag * np.diff(friction, prepend=friction[0]),
            self.arm.structure.input_delay_samples,
        )

    def _friction(self, record: Record) -> RealArray:
        friction = self.motion(record)[1]
        if not np.all(np.isfinite(friction)):
            raise LostError
        return friction + self.steady(record) if self.observed else friction

    def drive_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """(F,) of the drive's lag."""
        return np.asarray(1 / (1 + self.lag * (1 - np.exp(-1j * omega_rad_s * self.arm.dt_s))))


def parameters_of(law: FrictionLaw) -> RealArray:
    """(Q,) level, logarithm of the pre-sliding deflection; of Stribeck friction excess, logarithm of its
    speed."""
    plain = [law.level, np.log(law.presliding)]
    return np.array([*plain, law.excess, np.log(law.fall)] if np.isfinite(law.fall) else plain)


def law_of(parameters: RealArray) -> FrictionLaw:
    level, presliding, *falling = parameters.tolist()
    law = FrictionLaw(max(level, 0.0), float(np.exp(presliding)))
    return replace(law, excess=max(falling[0], 0.0), fall=float(np.exp(falling[1]))) if falling else law


def linearised(
    arm: SteppedArm, coefficients: RealArray, law: FrictionLaw, u: RealArray
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """The simulation with input u (T,) to first order: position and friction (T,), and the derivatives of
    both (T, P + Q) with respect to the coefficients and the law; the friction follows every change."""
    position, friction = arm.run(coefficients, u, law)
    structure = arm.structure
    effort = filter_input(u, 0, structure.input_delay_samples) - friction
    columns = regressor(arm.poles.doubled(), filter_input(effort, structure.integrators, 0))
    speed = float(np.std(np.diff(position)))
    parameters = parameters_of(law)
    by = np.empty((u.size, columns.shape[1] + parameters.size))
    friction_by = np.empty_like(by)

    def differentiate(j: int, size: float, changed: RealArray, by_changed: FrictionLaw) -> None:
        ends = arm.run(changed, u, by_changed)
        by[:, j], friction_by[:, j] = (ends[0] - position) / size, (ends[1] - friction) / size

    for j, column in enumerate(columns.T):
        change = np.zeros(coefficients.size)
        change[j] = _CHANGE * speed / max(float(np.std(np.diff(column))), np.finfo(np.float64).tiny)
        differentiate(j, change[j], coefficients + change, law)
    for k in range(parameters.size):
        change = np.zeros(parameters.size)
        # An excess has no size of its own before it is known, and cannot be negative.
        change[k] = _CHANGE if k % 2 else _CHANGE * law.level
        differentiate(columns.shape[1] + k, change[k], coefficients, law_of(parameters + change))
    return position, friction, by, friction_by


def equations(found: FrictionFit, records: Sequence[Record]) -> tuple[list[RealArray], list[RealArray]]:
    """Of every record the derivatives (T - delay, P + Q) of the simulated position, and what it leaves."""
    delay = found.arm.structure.input_delay_samples
    local = [linearised(found.arm, found.coefficients, found.law, record.input[:, 0]) for record in records]
    both = zip(records, local, strict=True)
    left = [answered(record.output[:, 0] - position, delay) for record, (position, *_) in both]
    return [answered(by, delay) for _, _, by, _ in local], left


def driven_by_law(found: FrictionFit, record: Record) -> RealArray:
    """(T, Q) derivatives of the arm's (stabilised) position with respect to the parameters of the law, to the
    drive's lag where there is one, to the bias of an integrating arm and to the level beyond a spring, where
    an observer tells the friction of a record."""
    arm = replace(found.model.stable_part, input_delay_samples=0)
    friction, parameters = found.motion(record)[1], parameters_of(found.law)
    beyond = 0.0 if found.spring is None else found.force_beyond(record, found.beyond, found.law)
    columns = []
    for k in range(parameters.size):
        change = np.zeros(parameters.size)
        change[k] = size = CHANGE_OF_LOG if k % 2 else _CHANGE_OF_LEVEL * found.level
        law = law_of(parameters + change)
        columns.append((found.motion(record, law)[1] - friction) / size)
        if found.spring is not None and np.isfinite(found.law.fall):
            columns[-1] = columns[-1] + (found.force_beyond(record, found.beyond, law) - beyond) / size
    if found.lag:
        faster = np.diff(found.behind_drive(found.behind_drive(record)).input[:, 0], prepend=record.input[0])
        columns.append(filter_input(faster, 0, found.arm.structure.input_delay_samples))
    if found.arm.structure.integrators:
        columns.append(np.ones(friction.size))
    if found.spring is not None:
        size = _CHANGE_BEYOND * found.level
        columns.append((found.force_beyond(record, found.beyond + size, found.law) - beyond) / size)
    return np.column_stack([-arm.simulate(column) for column in columns])


def started(model: GobfModel, structure: Structure, law: FrictionLaw) -> FrictionFit:
    """Where Gauss-Newton steps on the poles of a model begin; nothing is known of the noise yet."""
    arm = SteppedArm.of(model.poles, structure, model.dt_s)
    # Of the model's response on its poles taken twice.
    z = np.exp(1j * np.linspace(1e-3, np.pi, 400))
    basis, response = basis_response(arm.poles.doubled(), z), basis_response(model.poles, z)
    target = real_rows(response @ model.coefficients)
    coefficients = np.asarray(np.linalg.lstsq(real_rows(basis), target, rcond=None)[0])
    nothing = np.zeros((coefficients.size + parameters_of(law).size, 1))
    return FrictionFit(law, model, arm, coefficients, nothing, 0.0, 0.0)


def descended(
    found: FrictionFit, records: Sequence[Record], presliding: float, least: float, *, held: bool = True
) -> FrictionFit:
    """Gauss-Newton steps from found, as long as the residual falls; the level stays above least.

    held: logarithms in the law stay, for far from the arm they would take up what is wrong with it. Otherwise
    the pre-sliding deflection is expected near presliding, a Stribeck speed where it begins.
    """
    n = sum(found.residual(record).size for record in records)
    expected = parameters_of(found.law if held else replace(found.law, presliding=presliding))
    p, q = found.coefficients.size, expected.size
    logs, trust = np.arange(1, q, 2), _HELD if held else 1 / STD_LOG
    noise = np.sqrt(simulated_rss(found, records) / n)
    for left in reversed(range(_STEPS)):
        blocks, targets = equations(found, records)
        # What is expected of a logarithm is one more measurement of it.
        known = np.zeros((logs.size, p + q + 1))
        known[:, p + logs] = np.eye(logs.size)
        known[:, -1] = (expected - parameters_of(found.law))[logs]
        change, _, rss, rest = least_squares(blocks, targets, trust * noise * known)
        noise = np.sqrt(rest / n)
        for length in LENGTHS if left else ():
            step = length * change
            step[p] = max(step[p], max(0.6 * found.level, least) - found.level)
            step[p + logs] = np.clip(step[p + logs], -1, 1)
            coefficients, law = found.moved(step)
            there = replace(found, coefficients=coefficients, law=law)
            off = trust * noise * (parameters_of(law) - expected)[logs]
            if simulated_rss(there, records) + off @ off < rss - WORTH * noise**2:
                found = there
                break
        else:
            break
    return with_covariance(found, blocks, targets, float(noise))


def with_covariance(
    found: FrictionFit, blocks: Sequence[RealArray], targets: Sequence[RealArray], noise: float
) -> FrictionFit:
    """The fit with what its equations (`equations`) and a noise of this size leave open.

    Every record has a level of its own, about the common one; it and the logarithms in the law are known
    beforehand, as further measurements.
    """
    count, n = len(blocks), sum(target.size for target in targets)
    p, q = found.coefficients.size, parameters_of(found.law).size
    logs = np.arange(1, q, 2)
    between = _between_records(blocks, targets, p, _REPEATS * found.level)
    own = [np.outer(between * block[:, p], np.arange(count) == k) for k, block in enumerate(blocks)]
    known = np.zeros((logs.size + count, blocks[0].shape[1] + count + 1))
    known[: logs.size, p + logs] = noise / STD_LOG * np.eye(logs.size)
    known[logs.size :, -count - 1 : -1] = noise * np.eye(count)
    _, triangle, rss, rest = least_squares(
        [np.hstack(pair) for pair in zip(blocks, own, strict=True)], targets, known
    )
    scale = np.linalg.norm(triangle, axis=0)
    if not np.all(scale > 0):  # beside numbers of a simulation that runs away
        raise LostError
    # The covariance is that of the noise, not of a residual that another step would still lower.
    factor = np.sqrt(rest / n) * solve_triangular(triangle / scale, np.eye(scale.size)) / scale[:, None]
    factor = np.asarray(np.linalg.qr(factor[: blocks[0].shape[1]].T, mode="r")).T
    return replace(found, covariance_factor=factor, noise_std=float(np.sqrt(rss / n)), between=between)


def _between_records(
    blocks: Sequence[RealArray], targets: Sequence[RealArray], p: int, least: float
) -> float:
    """Standard deviation of the level (column p) from record to record, not below least (DerSimonian and
    Laird, Controlled Clinical Trials 7, 1986)."""
    count = len(blocks)
    if count == 1:
        return least
    own = [
        np.hstack([np.delete(block, p, axis=1), np.outer(block[:, p], np.arange(count) == k)])
        for k, block in enumerate(blocks)
    ]
    n = sum(target.size for target in targets)
    change, triangle, _, rest = least_squares(own, targets, np.zeros((0, own[0].shape[1] + 1)))
    scale = np.linalg.norm(triangle, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(triangle / scale)[-count:] / scale[-count:, None]
    weight = n / rest / np.sum(inverse**2, axis=1)
    levels = change[-count:]
    spread = float(np.sum(weight * (levels - np.average(levels, weights=weight)) ** 2))
    variance = (spread - (count - 1)) / (weight.sum() - np.sum(weight**2) / weight.sum())
    return float(np.sqrt(max(variance, least**2)))


def simulated_rss(found: FrictionFit, records: Sequence[Record]) -> float:
    """Sum of squares of the residuals, each record's less its mean."""
    return float(sum(np.sum(found.residual(record) ** 2) for record in records))


def least_squares(
    blocks: Sequence[RealArray], targets: Sequence[RealArray], known: RealArray
) -> tuple[RealArray, RealArray, float, float]:
    """Solution of the stacked rows, each record less its mean, and of known (., P + 1), rows and target, as
    they are; the triangle R, the sum of squares of the targets and what the solution leaves of it. Raises
    LostError where something is not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        a = np.vstack([*(block - block.mean(axis=0) for block in blocks), known[:, :-1]])
        b = np.concatenate([*(target - target.mean() for target in targets), known[:, -1]])
        length = np.linalg.norm(a, axis=0)
        length[length == 0] = 1.0
        triangle = triangle_of(np.column_stack([a / length, b]))
    if not np.all(np.isfinite(triangle)):
        raise LostError
    solution = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=1e-12)[0] / length
    return solution, triangle[:-1, :-1] * length, float(b @ b), float(triangle[-1, -1] ** 2)
