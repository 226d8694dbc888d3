"""Ellipses around the response behind the friction, whose level and the motion it depends on are estimated,
too: both are columns beside the basis functions in the regression of `ident.uncertainty.embedding`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.autoregressive_noise import WHITE_NOISE
from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.data.ellipses import LEVEL, chi2_radius
from ident.data.frequency_uncertainty import FREQUENCIES
from ident.data.record import Record
from ident.friction.arm import less_friction
from ident.friction.fit import moved_to
from ident.friction.gauss_newton import STD_LOG, FrictionFit, driven_by_law, linearised
from ident.friction.in_loop import ROUNDS, heterogeneity
from ident.friction.inverse_dynamics import smoothed, speed_classes
from ident.response_uncertainty import NOISE_ORDERS
from ident.uncertainty.embedding import tangent_beside
from ident.uncertainty.embedding_rows import Beside
from ident.uncertainty.pole_intervals import laurent_rows, pole_intervals

# Share of the level that a linear force which shows in no residual may have (deviation).
_SHAPE = 0.05
_LENGTHS = 100  # of the longest record: the lowest frequency
# Normals along which the response is bent, points of an arc, its parts that are kept as a share of the
# largest; of powers its square.
_MOST_CURVED, _STEPS, _SMALL = 3, 17, 1e-3
_MOST_GAIN = 3.0  # of an arc, over the centre: a damping that is not told from none has no end
# Size of an ellipse over the rms of even points of the arc it holds (1.7 of a line); at most, where the sign
# of the gain is known, as a share of it.
_REACH, _LARGEST = 1.7, 0.9
# Further real poles over the grid, which bent gains stand on: to .1 %, where four about the slowest left 16.
_FURTHER = 20
# Lowest missing mode, over the highest of the model: a nearer one the search would have found.
_BEYOND = 1.1


@dataclass(frozen=True, eq=False)
class BehindFriction:
    """What records say of an arm and of the friction at its shaft, together.

    response: from the input to an output, as if there were no dry friction; shaft: the same of the shaft's
    position, to first order; level + level_factor (P',) times unit normals: level of the friction. All three
    stand on the same P' unit normals. poles: of the arm, which shaft has twice: those of the model, the real
    ones moved to where the records have them beside an unknown level.
    """

    response: ResponsePosterior
    shaft: ResponsePosterior
    level: float
    level_factor: RealArray
    friction: FrictionFit
    poles: Poles


def without_friction(
    records: Sequence[Record],
    found: FrictionFit,
    model: GobfModel | None = None,
    options: EmbeddingOptions | None = None,
) -> BehindFriction:
    """Posterior of the response from input to the shaft's position, as if there were no dry friction.

    records: those of the fit, as measured. model: of the arm, fitted with the friction taken off; default
    that of the fit. The level of the friction is estimated again with the response. Raises ValueError as
    `tangent`.
    """
    if found.correction is not None:
        return _behind_observed(records, found, model or found.model, options)
    if model is not None:
        found = moved_to(found, records, model)
    corrected, beside, n = [], [], found.coefficients.size
    for k, record in enumerate(records):
        position, friction, by, _ = linearised(found.arm, found.coefficients, found.law, record.input[:, 0])
        # To first order y = y0 + D (c - c0) + d (level - level0): rows for the coefficients c themselves.
        target = record.output[:, 0] - position + by[:, :n] @ found.coefficients
        less = less_friction(record, friction, found.arm.structure.input_delay_samples)
        corrected.append(replace(less, output=target[:, None]))
        # Known beforehand, to one: logarithms in the law, and how far this record's level is off.
        plain, logs = by[:, n::2], STD_LOG * by[:, n + 1 :: 2]
        own = np.outer(found.between * plain[:, 0], np.arange(len(records)) == k)
        beside.append(Beside(by[:, :n], np.hstack([plain, logs, own])))
    response, change, factor = tangent_beside(
        corrected, found.model, beside, options, n_known=logs.shape[1] + len(records)
    )
    return BehindFriction(
        response, response, found.level + float(change[0]), factor[0], found, found.model.poles
    )


def _behind_observed(
    records: Sequence[Record], found: FrictionFit, model: GobfModel, options: EmbeddingOptions | None
) -> BehindFriction:
    """The same where an observer tells the friction from the measured motion: it does not depend on the arm,
    to first order."""
    less, beside, options = list[Record](), list[Beside](), options or EmbeddingOptions()
    for k, record in enumerate(records):
        by_law = driven_by_law(found, record)
        logs = STD_LOG * by_law[:, 1::2][:, : found.law.n_logs]
        # The basis has the drive's lag; how far that moves the friction which is taken off is neglected.
        others = [*(1 + 2 * np.arange(found.law.n_logs)), *([2 * found.law.n_logs] if found.lag else [])]
        plain = np.delete(by_law, others, axis=1)
        own = np.outer(found.between * plain[:, 0], np.arange(len(records)) == k)
        beside.append(Beside(np.zeros((record.n_samples, 0)), np.hstack([plain, logs, own])))
        less.append(found.taken_off(record))
    # What drives an arm away from its simulation is never white: as missed modes five slow ones were added.
    options = options.model_copy(
        update={"coloured_noise": True, "max_ar_order": max(options.max_ar_order, NOISE_ORDERS[-1])}
    )
    # Above those of the model, where logs excite little, one may be missing.
    swinging = model.poles.pairs if model.poles.pairs.size else model.poles.real[model.poles.real > 0]
    above = _BEYOND * float(np.max(np.abs(np.log(swinging)), initial=0.0))
    # Viscous and dry friction trade: a pole moved far beyond its interval would turn the tangent round below
    # the data.
    poles, classes = model.poles, [speed_classes(record) for record in records]
    for left in reversed(range(ROUNDS)):
        response, change, factor = tangent_beside(
            less,
            replace(model, poles=poles),
            beside,
            options,
            n_known=found.law.n_logs + len(records),
            missed_above=above,
            classes=classes,
        )
        stable, n = poles.without(model.unstable), response.poles.order
        real, slow = stable.real.copy(), stable.real > 0
        simple, double = np.reshape(
            [np.real(laurent_rows(response.poles, pole)) @ response.mean[:n] for pole in real[slow].tolist()],
            (-1, 2),
        ).T
        # Of the logarithm of the decay rate, as its interval.
        log, rate = double / simple / (real[slow] * np.log(real[slow])), -np.log(real[slow]) / model.dt_s
        outside = np.abs(log) > np.log(pole_intervals(response, stable).decay_per_s[slow, 1] / rate)
        if not left or not outside.any():
            break
        real[slow] **= np.exp(np.where(outside, np.clip(log, -1, 1), 0.0))
        poles = Poles(real, stable.pairs).appended(model.unstable)
    noise = response.report.noise if response.report else WHITE_NOISE
    wider = np.sqrt(heterogeneity(found, records, noise.without_start))
    by_force = _by_linear_force(found, records, less, response)
    response = replace(response, covariance_factor=np.hstack([wider * response.covariance_factor, by_force]))
    response, straight, onto = of_force(
        response, poles, max(record.n_samples for record in less) * model.dt_s
    )
    both = [0, *([plain.shape[1] - 1] if found.spring is not None else [])]
    spread = np.append(wider * factor[both].sum(axis=0), np.zeros(by_force.shape[1]))
    return BehindFriction(
        response, straight, found.level + float(change[both].sum()), onto @ spread, found, poles
    )


def of_force(
    response: ResponsePosterior, poles: Poles, longest_s: float
) -> tuple[ResponsePosterior, ResponsePosterior, RealArray]:
    """The same where what the data leave open adds to the arm's force, not to its response; to first order;
    the unit normals they stand on now, (P'', P') times those before. poles: of the arm, which the response
    has twice.

    An arm answers with G = 1 / D, and what is not known of it at low frequency (damping, stiffness, friction
    like them) adds to D: with x the relative change of G along a normal t, G becomes G / (1 - x t), an arc of
    a circle. Along the normals that move the gain below the first light mode most, ellipses about the middle
    of the arc's ends hold the arc as far as the level's radius goes. Where the arm would be turned against
    its command at the lowest frequency, which no passive arm is, the arc ends before. Neglected: gains more
    than `_MOST_GAIN` times the centre's; the bends of an unstable arm, which no stable poles follow.
    """
    if response.unstable.order:
        return response, response, np.eye(response.covariance_factor.shape[1])
    omega = _frequencies(response, longest_s)
    rows = response.frequency_rows(omega)
    gain, moved = rows @ response.mean, rows @ response.covariance_factor
    change = moved / gain[:, None]
    # Above the frequency where the gain is known best it is no longer the force of a slow motion.
    low = omega < np.min(
        poles.omega_rad_s(response.dt_s)[poles.zeta() < LARGEST_DAMPING],
        initial=omega[np.argmin(np.linalg.norm(change, axis=1))],
    )
    along = np.linalg.svd(real_rows(np.where(low[:, None], change, 0.0)), full_matrices=False)[2][
        :_MOST_CURVED
    ]
    radius, least = chi2_radius(LEVEL), 1 / _MOST_GAIN
    upright = np.real((1j * omega[0]) ** response.integrators * gain[0]) > 0
    centre, columns = np.ones(omega.size, np.complex128), list[ComplexArray]()
    onto = [np.eye(along.shape[1]) - along.T @ along]
    for k, direction in enumerate(along):
        x = change @ direction
        ends = np.array([-radius, radius])
        if abs(x[0].real) > least:
            turns = (1 - least) / x[0].real if upright else (1 + least) / x[0].real
            if upright:
                ends = np.clip(ends, *sorted((-np.sign(turns) * np.inf, turns)))
            elif k == 0:
                ends = turns + np.array([0.0, np.sign(turns) * radius])
        # Even steps of the force, and of the gain, at standstill.
        even = 1 - 1 / np.linspace(1 / (1 - x[0].real * ends[0]), 1 / (1 - x[0].real * ends[1]), _STEPS)
        left = 1 - np.outer(x, np.concatenate([np.linspace(ends[0], ends[1], _STEPS), even / x[0].real]))
        arc = np.where(low[:, None], 1 / np.where(np.abs(left) > 0.5 * least, left, least), 2 - left)
        middle = (arc[:, 0] + arc[:, -1]) / 2
        parts = _parts_of(np.asarray(arc - middle[:, None], np.complex128), np.asarray(middle))
        centre += middle - 1
        columns += [parts]
        # Of its parts the first takes the normal's place.
        onto += [np.vstack([direction, np.zeros((parts.shape[1] - 1, direction.size))])]
    # On more poles, which take up all of it: real ones, and those of the arm once more.
    poles = poles.appended(
        Poles(np.exp(-np.geomspace(10 * omega[0], omega[-1] / 3, _FURTHER) * response.dt_s))
    )
    nothing = np.zeros((response.mean.size + poles.order, 1))
    bent = replace(
        response, poles=response.poles.appended(poles), mean=nothing[:, 0], covariance_factor=nothing
    )
    wanted = np.column_stack([centre, (moved @ onto[0]) / gain[:, None], *columns])
    # Errors as a share of the gain, or of what is not known of it: a zero between the modes would outweigh
    # them all. Nearly equal poles would get large coefficients, and proofs between grid points fail.
    each = 1 / np.hypot(1, np.linalg.norm(change, axis=1))[:, None]
    basis = real_rows(bent.frequency_rows(omega) / gain[:, None] * each)
    length = np.maximum(np.linalg.norm(basis, axis=0), np.finfo(np.float64).tiny)[:, None]
    found = np.linalg.lstsq(basis / length.T, real_rows(wanted * each), rcond=_SMALL**2)[0] / length
    bent, normals = replace(bent, mean=found[:, 0], covariance_factor=found[:, 1:]), np.vstack(onto)
    return bent, replace(response, covariance_factor=response.covariance_factor @ normals.T), normals


def _parts_of(arc: ComplexArray, middle: ComplexArray) -> ComplexArray:
    """(F, N) columns whose ellipses at the level hold the points (F, K) of an arc about the middle (F,) of
    its ends, but not zero at the lowest frequency, where everything is real and only the first counts."""
    parts, sizes, _ = np.linalg.svd(real_rows(arc) / np.sqrt(arc.shape[1]), full_matrices=False)
    n = int(np.count_nonzero(sizes > _SMALL * sizes[0]))
    parts = parts[: middle.size, :n] * sizes[:n] + 1j * parts[middle.size :, :n] * sizes[:n]
    parts = parts @ np.linalg.qr(np.column_stack([parts[0].real, np.eye(n)]))[0]
    most = np.append(min(_REACH, _LARGEST * abs(middle[0]) / abs(parts[0, 0])), np.full(n - 1, _REACH))
    return np.asarray(parts * most / chi2_radius(LEVEL), np.complex128)


def _frequencies(response: ResponsePosterior, longest_s: float) -> RealArray:
    """(F,) [rad/s], as dense as what a kernel does between them."""
    nyquist = np.pi / response.dt_s
    slow = np.geomspace(1 / (_LENGTHS * longest_s), nyquist, FREQUENCIES)
    return np.union1d(
        slow, nyquist * np.arange(1, 2 * response.fir_length + 1) / (2 * response.fir_length + 1)
    )


def _by_linear_force(
    friction: FrictionFit, records: Sequence[Record], less: Sequence[Record], response: ResponsePosterior
) -> RealArray:
    """(P, S) changes of the response's coefficients by a part of the friction that looks like a linear force,
    which no data tell: k y^(i) changes G by k s^i G^2 (i up to 2; no stiffness in an arm that integrates),
    each a share of the friction, rms over the records. less: the records with the friction taken off."""
    omega = _frequencies(response, max(record.n_samples for record in records) * response.dt_s)
    rows = response.frequency_rows(omega)
    gain = rows @ response.mean
    force = [(one.input - other.input)[:, 0] for one, other in zip(records, less, strict=True)]
    moved = [smoothed(record.output[:, 0]) for record in records]
    columns = list[RealArray]()
    for i in range(3):
        if i >= response.integrators:
            size = _SHAPE * np.sqrt(sum(map(np.var, force)) / sum(map(np.var, moved)))
            change = size * (1j * omega) ** i * gain / friction.drive_response(omega)
            # On the doubled poles, which hold G^2 s^i but for the delay, relative to G.
            basis = real_rows(rows[:, : response.poles.order] / gain[:, None])
            columns.append(np.asarray(np.linalg.lstsq(basis, real_rows(change), rcond=None)[0]))
        moved = [np.gradient(one, response.dt_s) for one in moved]
    return np.pad(np.column_stack(columns), ((0, response.mean.size - response.poles.order), (0, 0)))


def other_output_without_friction(
    records: Sequence[Record],
    found: FrictionFit,
    model: GobfModel,
    options: EmbeddingOptions | None = None,
) -> BehindFriction:
    """The same for another output of the arm, which the same friction reaches through the motor's shaft.
    records: with that output; model: fitted to them with the friction taken off."""
    undelayed = replace(model, input_delay_samples=0)
    less, beside, n = list[Record](), list[Beside](), found.coefficients.size
    for k, record in enumerate(records):
        _, friction, _, by = linearised(found.arm, found.coefficients, found.law, record.input[:, 0])
        less.append(less_friction(record, friction, found.arm.structure.input_delay_samples))
        columns = np.column_stack([-by @ found.covariance_factor, -found.between * by[:, n]])
        driven = np.column_stack([undelayed.simulate(column) for column in columns.T])
        own = np.outer(driven[:, -1], np.arange(len(records)) == k)
        beside.append(Beside(np.zeros((record.n_samples, 0)), np.hstack([driven[:, :-1], own])))
    shared = found.covariance_factor.shape[1]
    response, mean, factor = tangent_beside(less, model, beside, options, n_known=shared + len(records))
    moved, spread = (found.covariance_factor @ part[:shared] for part in (mean, factor))
    shaft = ResponsePosterior(
        found.arm.poles.doubled(),
        found.coefficients + moved[:n],
        spread[:n],
        model.dt_s,
        integrators=found.arm.structure.integrators,
        input_delay_samples=found.arm.structure.input_delay_samples,
    )
    return BehindFriction(response, shaft, found.level + float(moved[n]), spread[n], found, model.poles)
