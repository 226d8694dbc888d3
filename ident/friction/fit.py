"""Coulomb friction and the linear arm behind it from records of the shaft's own position.

Friction acts where the motor's torque does, so that the position is G (u - f) with f set by the motion itself
(Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30(7), 1994). Given the arm, the motion under
friction is simulated between the samples, and everything is one least-squares problem in the level of the
friction and the coefficients of the arm on its poles, each taken twice: Gauss-Newton steps from derivatives
of the simulation, in which a change of the arm also changes the friction. The poles come from the search of
`ident.identify` on the records with the friction taken off their input; both are repeated until the residual
no longer falls.

Neglected: a level that depends on speed, position or load; the deflection before slipping is taken as known;
records start at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.signal import butter, sosfiltfilt

from ident.basis.functions import basis_response, regressor
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import Structure, filter_input
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.friction.arm import SteppedArm, less_friction
from ident.identify import untested_model
from ident.uncertainty.embedding_algebra import triangle_of

# Ten microradians: what a stiff bearing or gear deflects before it slips.
PRESLIDING = 1e-5
# The start takes the sign of the measured speed, smoothed below this share of the Nyquist frequency; speeds
# below a fiftieth of the usual one count as part of the turn.
_SMOOTHING, _SLOW = 0.15, 0.02
_START_ROUNDS, _MOST_SEARCHES, _LOCAL_STEPS = 4, 8, 8
# A Gauss-Newton step, and its parts where the whole does not lower the residual.
_LENGTHS = (1.0, 0.5, 0.25, 0.1)
# A residual sum of squares that falls by less than this many noise variances is at its end.
_WORTH = 0.5
# Sizes of the changes that derivatives are taken from, relative to the motion and to the level.
_CHANGE, _CHANGE_OF_LEVEL = 1e-3, 2e-3

Report = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """A linear arm with Coulomb friction, fitted to records of its shaft's position.

    level: Coulomb friction in units of the input (times the motor's torque per unit of input: N m), level_std
    its standard deviation. model: the arm without friction, each pole once. arm, coefficients (P,): the same
    on each pole taken twice, as they were fitted. covariance_factor (P+1, P+1): of (coefficients, level).
    noise_std: of the residual, in output units. presliding: deflection before slipping, in output units.
    """

    level: float
    level_std: float
    model: GobfModel
    arm: SteppedArm
    coefficients: RealArray
    covariance_factor: RealArray
    noise_std: float
    presliding: float

    @property
    def significant(self) -> bool:
        """The level is more than three of its standard deviations above zero."""
        return self.level > 3 * self.level_std

    def motion(self, record: Record) -> tuple[RealArray, RealArray]:
        """Simulated position (T,) and friction in units of the input (T,), mean of each sample."""
        return self.arm.run(self.coefficients, record.input[:, 0], self.level, self.presliding)

    def residual(self, record: Record) -> RealArray:
        """(T,) what the simulation leaves of the position, less its mean."""
        left = record.output[:, 0] - self.motion(record)[0]
        return np.asarray(left - left.mean())

    def taken_off(self, record: Record) -> Record:
        """The record (one input; any outputs) as if its input had been smaller by the friction."""
        return less_friction(record, self.motion(record)[1], self.arm.structure.input_delay_samples)


@dataclass(frozen=True, eq=False)
class Linearised:
    """The simulation of one record to first order in (coefficients, level).

    position, friction (T,) as simulated; by_coefficients (T, P), by_level (T,) derivatives of the position,
    friction_by (T, P + 1) those of the friction.
    """

    position: RealArray
    friction: RealArray
    by_coefficients: RealArray
    by_level: RealArray
    friction_by: RealArray


def linearised(
    arm: SteppedArm, coefficients: RealArray, level: float, presliding: float, u: RealArray
) -> Linearised:
    """Central differences of the simulation with input u (T,): the friction follows every change."""
    position, friction = arm.run(coefficients, u, level, presliding)
    structure = arm.structure
    effort = filter_input(u, 0, structure.input_delay_samples) - friction
    columns = regressor(arm.poles.doubled(), filter_input(effort, structure.integrators, 0))
    speed = float(np.std(np.diff(position)))
    by, friction_by = np.empty_like(columns), np.empty((u.size, columns.shape[1] + 1))
    for j, column in enumerate(columns.T):
        size = _CHANGE * speed / max(float(np.std(np.diff(column))), np.finfo(np.float64).tiny)
        change = np.zeros(coefficients.size)
        change[j] = size
        ends = [arm.run(coefficients + sign * change, u, level, presliding) for sign in (1, -1)]
        by[:, j], friction_by[:, j] = ((a - b) / (2 * size) for a, b in zip(*ends, strict=True))
    size = _CHANGE_OF_LEVEL * level
    ends = [arm.run(coefficients, u, level + sign * size, presliding) for sign in (1, -1)]
    by_level, friction_by[:, -1] = ((a - b) / (2 * size) for a, b in zip(*ends, strict=True))
    return Linearised(position, friction, by, by_level, friction_by)


def fit_friction(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    presliding: float = PRESLIDING,
    progress: Report | None = None,
) -> FrictionFit:
    """Level of the Coulomb friction and the arm behind it.

    records: one input, and the position of the shaft that the friction acts on as the one output; at rest at
    their first sample. options: of the search for the arm's poles; integrators at most 1. presliding in
    output units.

    Raises ValueError where the shaft does not move, there is more than one integrator or a direct term, or
    `identify` refuses the records.
    """
    options = options or IdentOptions()
    report = progress or (lambda fraction, message: None)
    for record in records:
        if not np.ptp(record.output[:, 0]) > 0:
            raise ValueError(f"{record.label}: the shaft does not move, so that its friction cannot be seen")
    report(0.0, "friction: start")
    structure = options.structure()
    level, model = _start(records, options)
    least = 1e-6 * max(float(np.std(record.input)) for record in records)
    best: FrictionFit | None = None
    for search in range(_MOST_SEARCHES):
        report(0.2 + 0.8 * search / _MOST_SEARCHES, "friction: arm and level together")
        found = _descended(records, model, structure, max(level, least), presliding, least)
        if best is not None and not _rss(found, records) < _rss(best, records) - _WORTH * found.noise_std**2:
            break
        best, level = found, found.level
        # The poles may have been led astray by friction that was not yet right: search for them again.
        model = untested_model([found.taken_off(record) for record in records], options)
    assert best is not None
    report(1.0, "friction identified")
    return best


def moved_to(found: FrictionFit, records: Sequence[Record], model: GobfModel) -> FrictionFit:
    """The same fit on the poles of another model of the arm, near those it was made with."""
    return _descended(records, model, found.arm.structure, found.level, found.presliding, 0.1 * found.level)


def _rss(found: FrictionFit, records: Sequence[Record]) -> float:
    return found.noise_std**2 * sum(record.n_samples for record in records)


def _start(records: Sequence[Record], options: IdentOptions) -> tuple[float, GobfModel]:
    """Level and arm with the friction that the sign of the measured speed gives."""
    sections = butter(2, _SMOOTHING, output="sos")
    signs = []
    for record in records:
        speed = np.gradient(sosfiltfilt(sections, record.output[:, 0]))
        sign = np.tanh(speed / (_SLOW * np.std(speed)))
        signs.append(0.5 * (sign + np.append(sign[1:], sign[-1])))
    # One pair more than asked for: what a wrong level leaves would otherwise take the place of a weak mode.
    options = options.model_copy(update={"n_pairs": None if options.n_pairs is None else options.n_pairs + 1})
    level = 0.0
    for _ in range(_START_ROUNDS):
        less = [
            less_friction(record, level * sign, options.input_delay_samples)
            for record, sign in zip(records, signs, strict=True)
        ]
        model = untested_model(less, options)
        undelayed = replace(model, input_delay_samples=0)
        blocks = [
            np.column_stack([_basis(model.poles.doubled(), record, options), -undelayed.simulate(sign)])
            for record, sign in zip(less, signs, strict=True)
        ]
        before, level = (
            level,
            max(level + float(_least_squares(blocks, [r.output[:, 0] for r in less])[0][-1]), 0.0),
        )
        if abs(level - before) < 0.02 * level:
            break
    return level, model


def _descended(
    records: Sequence[Record],
    model: GobfModel,
    structure: Structure,
    level: float,
    presliding: float,
    least: float,
) -> FrictionFit:
    """Gauss-Newton steps on the poles of the model, as long as the residual falls."""
    arm = SteppedArm.of(model.poles, structure, model.dt_s)
    coefficients = _on_doubled(arm.poles, model)
    n = sum(record.n_samples for record in records)
    for _ in range(_LOCAL_STEPS):
        local = [linearised(arm, coefficients, level, presliding, record.input[:, 0]) for record in records]
        blocks = [np.column_stack([part.by_coefficients, part.by_level]) for part in local]
        change, triangle, rss, rest = _least_squares(
            blocks, [record.output[:, 0] - part.position for record, part in zip(records, local, strict=True)]
        )
        scale = np.linalg.norm(triangle, axis=0)
        # The covariance is that of the noise, not of a residual that another step would still lower.
        factor = np.sqrt(rest / n) * solve_triangular(triangle / scale, np.eye(scale.size)) / scale[:, None]
        found = FrictionFit(
            level=level,
            level_std=float(np.linalg.norm(factor[-1])),
            model=model,
            arm=arm,
            coefficients=coefficients,
            covariance_factor=factor,
            noise_std=float(np.sqrt(rss / n)),
            presliding=presliding,
        )
        for length in _LENGTHS:
            coefficients = found.coefficients + length * change[:-1]
            level = float(np.clip(found.level + length * change[-1], max(0.6 * found.level, least), None))
            there = replace(found, coefficients=coefficients, level=level)
            if _simulated_rss(there, records) < rss - _WORTH * found.noise_std**2:
                break
        else:
            break
    return found


def _simulated_rss(found: FrictionFit, records: Sequence[Record]) -> float:
    """Sum of squares of the residuals, each record's less its mean."""
    return float(sum(np.sum(found.residual(record) ** 2) for record in records))


def _least_squares(
    blocks: Sequence[RealArray], targets: Sequence[RealArray]
) -> tuple[RealArray, RealArray, float, float]:
    """Solution of the stacked rows, each record less its mean; the triangle R, the sum of squares of the
    targets and what the solution leaves of it.
    """
    a = np.vstack([block - block.mean(axis=0) for block in blocks])
    b = np.concatenate([target - target.mean() for target in targets])
    length = np.linalg.norm(a, axis=0)
    length[length == 0] = 1.0
    triangle = triangle_of(np.column_stack([a / length, b]))
    solution = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=1e-12)[0] / length
    return solution, triangle[:-1, :-1] * length, float(b @ b), float(triangle[-1, -1] ** 2)


def _basis(poles: Poles, record: Record, options: IdentOptions) -> RealArray:
    return regressor(
        poles, filter_input(record.input[:, 0], options.integrators, options.input_delay_samples)
    )


def _on_doubled(poles: Poles, model: GobfModel) -> RealArray:
    """Coefficients (2 order,) of the model's response on its poles taken twice."""
    z = np.exp(1j * np.linspace(1e-3, np.pi, 400))
    basis = basis_response(poles.doubled(), z)
    response = basis_response(model.poles, z) @ model.coefficients
    return np.asarray(
        np.linalg.lstsq(
            np.vstack([basis.real, basis.imag]), np.concatenate([response.real, response.imag]), rcond=None
        )[0]
    )
