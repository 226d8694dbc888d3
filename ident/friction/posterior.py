"""Ellipses around the response behind the friction, whose level is estimated with it.

The level of the friction, and for a free run the motion it depends on, are columns beside the basis functions
in the regression of `ident.uncertainty.embedding`: what is not known of the friction widens the ellipses
(`without_friction`). Behind an observer the friction is known from the measured motion; the ellipses are then
widened by what parts of the logs differ in, and by a share of the friction that looks like a linear force
(`_behind_observed`). What is open adds to the arm's force, not to its response: `of_force` bends the ellipses
along arcs of circles. `other_output_without_friction` does as much for the tip of an arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.autoregressive_noise import WHITE_NOISE
from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.data.ellipses import LEVEL, chi2_radius
from ident.data.record import Record
from ident.friction.arm import less_friction
from ident.friction.fit import moved_to
from ident.friction.further_poles import frequencies_of, on_further_poles
from ident.friction.gauss_newton import STD_LOG, FrictionFit, driven_by_law, linearised
from ident.friction.inverse_dynamics import smoothed, speed_classes
from ident.friction.rate_members import RateMember, below_modes, rate_members
from ident.friction.widths import heterogeneity
from ident.response_uncertainty import NOISE_ORDERS
from ident.uncertainty.embedding import tangent_beside
from ident.uncertainty.embedding_rows import Beside
from ident.uncertainty.pole_intervals import laurent_rows, pole_intervals

# Share of the friction that a linear force which shows in no residual may have, one standard deviation.
# Chosen: no law of friction is exact (docs/closed_loop_logs.md). Doubled, ellipses at low frequency are
# nearly twice as wide where friction is much of the command.
_SHAPE = 0.05
# Normals along which the response is bent: damping, stiffness and friction.
_MOST_CURVED = 3
# Points of an arc, even in force, and as many even in gain. Chosen: an arc is smooth.
_STEPS = 17
# Parts of an arc that count, as a share of the largest. Chosen, far below an ellipse.
_SMALL = 1e-3
# Largest gain of an arc, over the centre: a damping that is not told from none has no end. Larger gains only
# make a loop with integral action tighter (docs/closed_loop_logs.md).
_MOST_GAIN = 3.0
# Size of an ellipse over the rms of even points of the arc it holds: 1.7, the square root of 3, of a line.
_REACH = 1.7
# Size of an ellipse at most, where the sign of the gain is known, as a share of the gain: zero is outside.
_LARGEST = 0.9
# Lowest missing mode, over the highest of the model: a nearer one the search would have found.
_ABOVE_MODES = 1.1
# Largest change of the logarithm of a decay rate in a round: a factor of e.
_LARGEST_LOG_STEP = 1
# Logarithm of the factor by which a tangent raises a decay rate at most. Chosen: with twice the rate the
# gain at rest is halved, and a tangent has it at none.
_LINEAR_LOG_STEP = 0.7
# Rounds in which real poles are moved, at most. Chosen: they end where none is outside its interval.
_ROUNDS = 6
# Powers of s that a part of the friction may look like: stiffness, damping, inertia.
_FORCES = 3


@dataclass(frozen=True, eq=False)
class BehindFriction:
    """What records say of an arm and of the friction at its shaft, together.

    Attributes
    ----------
    response : ResponsePosterior
        From the input to an output, as if there were no dry friction.
    shaft : ResponsePosterior
        From the input to the shaft's position, to first order.
    level : float
        Of the friction, units of the input.
    level_factor : ndarray, shape (P',)
        The level is `level` + level_factor times unit normals; response and shaft stand on the same P' ones.
    friction : FrictionFit
    poles : Poles
        Of the arm, which shaft has twice: those of the model, the real ones moved to where the records have
        them beside an unknown level.
    members : tuple of RateMember
        Instead of `response`, where the slow rate of an axis is hardly known: they hold it together.
    """

    response: ResponsePosterior
    shaft: ResponsePosterior
    level: float
    level_factor: RealArray
    friction: FrictionFit
    poles: Poles
    members: tuple[RateMember, ...] = ()


def without_friction(
    records: Sequence[Record],
    fit: FrictionFit,
    model: GobfModel | None = None,
    options: EmbeddingOptions | None = None,
) -> BehindFriction:
    """Posterior of the response from input to the shaft's position, as if there were no dry friction.

    Parameters
    ----------
    records : sequence of Record
        Those of the fit, as measured.
    fit : FrictionFit
    model : GobfModel, optional
        Of the arm, fitted with the friction taken off; default that of the fit.
    options : EmbeddingOptions, optional
        Of the regression.

    Returns
    -------
    BehindFriction
        The level of the friction is estimated again with the response.

    Raises
    ------
    ValueError
        As `tangent`.

    Notes
    -----
    With D the derivatives of the simulated position by the coefficients c, d those by the law, y = y0 +
    D (c - c0) + d (law - law0): the columns of D stand in place of the basis functions, d beside them.
    """
    if fit.correction is not None:
        return _behind_observed(records, fit, model or fit.model, options)
    if model is not None:
        fit = moved_to(fit, records, model)
    n = fit.coefficients.size
    n_logs = fit.law.n_logs
    delay = fit.arm.structure.input_delay_samples
    corrected = []
    beside = []
    for k, record in enumerate(records):
        local = linearised(fit.arm, fit.coefficients, fit.law, record.input[:, 0])
        by = local.position_by
        # Rows for the coefficients c themselves, not for what they change by.
        target = record.output[:, 0] - local.position + by[:, :n] @ fit.coefficients
        frictionless = less_friction(record, local.friction, delay)
        corrected.append(replace(frictionless, output=target[:, None]))
        # Known beforehand, to one: logarithms in the law, and how far this record's level is off.
        forces = by[:, n::2]
        logs = STD_LOG * by[:, n + 1 :: 2]
        own_level = np.outer(fit.between * forces[:, 0], np.arange(len(records)) == k)
        beside.append(Beside(by[:, :n], np.hstack([forces, logs, own_level])))
    n_known = n_logs + len(records)
    response, change, factor = tangent_beside(corrected, fit.model, beside, options, n_known=n_known)
    level = fit.level + float(change[0])
    return BehindFriction(response, response, level, factor[0], fit, fit.model.poles)


def _behind_observed(
    records: Sequence[Record], found: FrictionFit, model: GobfModel, options: EmbeddingOptions | None
) -> BehindFriction:
    """Posterior behind a friction that an observer tells from the measured motion.

    To first order this friction does not depend on the arm. `records` are those of the fit `found`, `model`
    is the arm behind its friction. Raises ValueError as `tangent`, LostError where the observer does not
    follow.
    """
    n_logs = found.law.n_logs
    frictionless = []
    beside = []
    for k, record in enumerate(records):
        # Columns: level, log deflection (excess, log speed), lag, bias, level beyond a spring.
        by_law = driven_by_law(found, record)
        logs = STD_LOG * by_law[:, 1::2][:, :n_logs]
        no_forces = [1 + 2 * place for place in range(n_logs)]
        if found.lag:
            # The basis has the drive's lag; how far that moves the friction which is taken off is neglected.
            no_forces.append(2 * n_logs)
        forces = np.delete(by_law, no_forces, axis=1)
        own_level = np.outer(found.between * forces[:, 0], np.arange(len(records)) == k)
        columns = np.hstack([forces, logs, own_level])
        beside.append(Beside(np.zeros((record.n_samples, 0)), columns))
        frictionless.append(found.taken_off(record))

    # What drives an arm away from its simulation is never white: as missed modes five slow ones were added.
    options = options or EmbeddingOptions()
    ar_order = max(options.max_ar_order, NOISE_ORDERS[-1])
    options = options.model_copy(update={"coloured_noise": True, "max_ar_order": ar_order})
    # Above those of the model, where logs excite little, one may be missing.
    poles = model.poles
    is_moving = poles.real > 0
    highest = poles.pairs if poles.pairs.size else poles.real[is_moving]
    missed_above = _ABOVE_MODES * float(np.max(np.abs(np.log(highest)), initial=0.0))

    # Viscous and dry friction trade: a pole moved far beyond its interval would turn the tangent round below
    # the data. So real poles are moved, and the regression is repeated, until each is within its interval,
    # and is not raised by more than a tangent follows: a slow axis about a rate that is far too low gets a
    # mean with a zero below the data. A rate that falls towards none has no better tangent.
    classes = [speed_classes(record) for record in records]
    for rounds_left in reversed(range(_ROUNDS)):
        response, change, factor = tangent_beside(
            frictionless,
            replace(model, poles=poles),
            beside,
            options,
            n_known=n_logs + len(records),
            missed_above=missed_above,
            classes=classes,
        )
        stable = poles.without(model.unstable)
        n = response.poles.order
        real = stable.real.copy()
        decays = stable.real > 0
        moves = []
        for pole in real[decays].tolist():
            moves.append(np.real(laurent_rows(response.poles, pole)) @ response.mean[:n])
        simple, double = np.reshape(moves, (-1, 2)).T
        # Changes of the logarithm of the decay rate, to first order, and the half width of its interval.
        log_change = double / simple / (real[decays] * np.log(real[decays]))
        rate = -np.log(real[decays]) / model.dt_s
        upper = pole_intervals(response, stable).decay_per_s[decays, 1]
        half_width = np.log(upper / rate)
        rises = log_change > np.minimum(half_width, _LINEAR_LOG_STEP)
        outside = rises | (log_change < -half_width)
        if rounds_left == 0 or not outside.any():
            break
        steps = np.where(outside, np.clip(log_change, -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP), 0.0)
        real[decays] **= np.exp(steps)
        poles = Poles(real, stable.pairs).appended(model.unstable)

    # Wider by what parts of the logs differ in, and by forces that no residual shows.
    noise = response.report.noise if response.report else WHITE_NOISE
    wider = np.sqrt(heterogeneity(found, records, noise.without_start))
    by_force = _by_linear_force(found, records, frictionless, response)
    response = replace(response, covariance_factor=np.hstack([wider * response.covariance_factor, by_force]))
    longest_s = max(record.n_samples for record in frictionless) * model.dt_s
    members = rate_members(response, poles, longest_s)
    response, straight, onto = of_force(response, poles, longest_s)

    # The level at the shaft is the first column of the forces, that beyond a spring the last.
    levels = [0]
    if found.spring is not None:
        levels.append(forces.shape[1] - 1)
    level = found.level + float(change[levels].sum())
    spread = np.append(wider * factor[levels].sum(axis=0), np.zeros(by_force.shape[1]))
    return BehindFriction(response, straight, level, onto @ spread, found, poles, members)


def of_force(
    response: ResponsePosterior, poles: Poles, longest_s: float
) -> tuple[ResponsePosterior, ResponsePosterior, RealArray]:
    """A posterior where what the data leave open adds to the arm's force, not to its response.

    Parameters
    ----------
    response : ResponsePosterior
        Whose covariance is that of the response, to first order, on P' unit normals.
    poles : Poles
        Of the arm, which the response has twice.
    longest_s : float
        Length of the longest record, s.

    Returns
    -------
    tuple of ResponsePosterior, ResponsePosterior and ndarray of shape (P'', P')
        The bent posterior; the straight one on the P'' unit normals it stands on now; these normals in terms
        of those before.

    Notes
    -----
    An arm answers with G = 1 / D, and what is not known of it at low frequency (damping, stiffness, friction
    like them) adds to D: with x the relative change of G along a normal t, G becomes G / (1 - x t), an arc of
    a circle. Along the normals that move the gain below the first light mode most, ellipses about the middle
    of the arc's ends hold the arc as far as the level's radius goes. Where the arm would be turned against
    its command at the lowest frequency, which no passive arm is, the arc ends before. Neglected: gains more
    than `_MOST_GAIN` times the centre's; the bends of an unstable arm, which no stable poles follow.
    """
    if response.unstable.order:
        return response, response, np.eye(response.covariance_factor.shape[1])
    omega = frequencies_of(response, longest_s)
    rows = response.frequency_rows(omega)
    gain = rows @ response.mean
    moved = rows @ response.covariance_factor
    change = moved / gain[:, None]

    # Directions that move the gain most at low frequency.
    low = below_modes(omega, change, poles, response.dt_s)
    low_change = real_rows(np.where(low[:, None], change, 0.0))
    directions = np.linalg.svd(low_change, full_matrices=False)[2][:_MOST_CURVED]

    # An arc along each; its centre moves that of all, its parts stand in place of the normal.
    radius = chi2_radius(LEVEL)
    least = 1 / _MOST_GAIN
    lowest_gain = np.real((1j * omega[0]) ** response.integrators * gain[0])
    upright = lowest_gain > 0
    centre = np.ones(omega.size, np.complex128)
    columns = list[ComplexArray]()
    onto = [np.eye(directions.shape[1]) - directions.T @ directions]
    for k, direction in enumerate(directions):
        x = change @ direction
        at_rest = x[0].real
        ends = np.array([-radius, radius])
        if abs(at_rest) > least:
            if upright:
                # The arc ends where the gain is the largest that is held.
                turns = (1 - least) / at_rest
                bounds = sorted((-np.sign(turns) * np.inf, turns))
                ends = np.clip(ends, *bounds)
            elif k == 0:
                # The centre is turned against its command: the arc begins where it no longer is.
                turns = (1 + least) / at_rest
                ends = turns + np.array([0.0, np.sign(turns) * radius])
        # Even steps of the force, and of the gain, at standstill.
        first_gain = 1 / (1 - at_rest * ends[0])
        last_gain = 1 / (1 - at_rest * ends[1])
        even_in_force = np.linspace(ends[0], ends[1], _STEPS)
        even_in_gain = 1 - 1 / np.linspace(first_gain, last_gain, _STEPS)
        force = 1 - np.outer(x, np.concatenate([even_in_force, even_in_gain / at_rest]))
        # Near a force of zero the gain has no end. Above the low frequencies to first order, as before.
        divisor = np.where(np.abs(force) > 0.5 * least, force, least)
        arc = np.where(low[:, None], 1 / divisor, 2 - force)
        middle = (arc[:, 0] + arc[:, -1]) / 2
        parts = _parts_of(np.asarray(arc - middle[:, None], np.complex128), np.asarray(middle))
        centre += middle - 1
        columns.append(parts)
        # Of its parts the first takes the normal's place.
        further = np.zeros((parts.shape[1] - 1, direction.size))
        onto.append(np.vstack([direction, further]))

    straight_part = (moved @ onto[0]) / gain[:, None]
    wanted = np.column_stack([centre, straight_part, *columns])
    # Errors as a share of the gain, or of what is not known of it: a zero between the modes would outweigh
    # them all.
    weight = 1 / np.hypot(1, np.linalg.norm(change, axis=1))
    bent = on_further_poles(response, poles, omega, wanted, weight)
    normals = np.vstack(onto)
    straight = replace(response, covariance_factor=response.covariance_factor @ normals.T)
    return bent, straight, normals


def _parts_of(arc: ComplexArray, middle: ComplexArray) -> ComplexArray:
    """Columns (F, N) whose ellipses at the level hold an arc, relative to the gain.

    The points (F, K) of the arc are told from the middle (F,) of its ends. Zero is outside at the lowest
    frequency, where everything is real and only the first column counts.
    """
    left, sizes, _ = np.linalg.svd(real_rows(arc) / np.sqrt(arc.shape[1]), full_matrices=False)
    n = int(np.count_nonzero(sizes > _SMALL * sizes[0]))
    parts = left[: middle.size, :n] * sizes[:n] + 1j * left[middle.size :, :n] * sizes[:n]
    # Turned so that only the first part moves the gain at the lowest frequency.
    turn = np.linalg.qr(np.column_stack([parts[0].real, np.eye(n)]))[0]
    parts = parts @ turn
    without_zero = _LARGEST * abs(middle[0]) / abs(parts[0, 0])
    reach = np.append(min(_REACH, without_zero), np.full(n - 1, _REACH))
    return np.asarray(parts * reach / chi2_radius(LEVEL), np.complex128)


def _by_linear_force(
    friction: FrictionFit,
    records: Sequence[Record],
    frictionless: Sequence[Record],
    response: ResponsePosterior,
) -> RealArray:
    """Changes (P, S) of a response's coefficients by a part of the friction that looks like a linear force.

    No data tell such a part. A force k y^(i) changes G by k s^i G^2 (i up to 2; no stiffness in an arm that
    integrates), each a share of the friction, rms over the records. `frictionless` are the records with the
    friction taken off.
    """
    omega = frequencies_of(response, max(record.n_samples for record in records) * response.dt_s)
    rows = response.frequency_rows(omega)
    gain = rows @ response.mean
    forces = []
    for record, driven in zip(records, frictionless, strict=True):
        forces.append((record.input - driven.input)[:, 0])
    motions = [smoothed(record.output[:, 0]) for record in records]
    # On the doubled poles, which hold G^2 s^i but for the delay, relative to G.
    n_doubled = response.poles.order
    basis = real_rows(rows[:, :n_doubled] / gain[:, None])
    columns = list[RealArray]()
    for power in range(_FORCES):
        if power >= response.integrators:
            size = _SHAPE * np.sqrt(sum(map(np.var, forces)) / sum(map(np.var, motions)))
            change = size * (1j * omega) ** power * gain / friction.drive_response(omega)
            columns.append(np.asarray(np.linalg.lstsq(basis, real_rows(change), rcond=None)[0]))
        motions = [np.gradient(motion, response.dt_s) for motion in motions]
    n_others = response.mean.size - n_doubled
    return np.pad(np.column_stack(columns), ((0, n_others), (0, 0)))


def other_output_without_friction(
    records: Sequence[Record],
    fit: FrictionFit,
    model: GobfModel,
    options: EmbeddingOptions | None = None,
) -> BehindFriction:
    """Posterior of the response to another output of the arm, as if there were no dry friction at its shaft.

    Parameters
    ----------
    records : sequence of Record
        With that output; the friction reaches it through the motor's shaft.
    fit : FrictionFit
        Of the shaft's position in the same experiments, a free run.
    model : GobfModel
        Fitted to the records with the friction taken off.
    options : EmbeddingOptions, optional
        Of the regression.

    Returns
    -------
    BehindFriction
        `shaft` is the fit's response, moved by what the other output says of it.

    Raises
    ------
    ValueError
        As `tangent`.
    """
    undelayed = replace(model, input_delay_samples=0)
    structure = fit.arm.structure
    n = fit.coefficients.size
    frictionless = []
    beside = []
    for k, record in enumerate(records):
        local = linearised(fit.arm, fit.coefficients, fit.law, record.input[:, 0])
        frictionless.append(less_friction(record, local.friction, structure.input_delay_samples))
        # What the friction may be beside the fit's: along its normals, and by this record's own level.
        along_normals = -local.friction_by @ fit.covariance_factor
        by_own_level = -fit.between * local.friction_by[:, n]
        columns = np.column_stack([along_normals, by_own_level])
        driven = np.column_stack([undelayed.simulate(column) for column in columns.T])
        own_level = np.outer(driven[:, -1], np.arange(len(records)) == k)
        beside.append(Beside(np.zeros((record.n_samples, 0)), np.hstack([driven[:, :-1], own_level])))
    n_normals = fit.covariance_factor.shape[1]
    n_known = n_normals + len(records)
    response, mean, factor = tangent_beside(frictionless, model, beside, options, n_known=n_known)
    moved = fit.covariance_factor @ mean[:n_normals]
    spread = fit.covariance_factor @ factor[:n_normals]
    shaft = ResponsePosterior(
        fit.arm.poles.doubled(),
        fit.coefficients + moved[:n],
        spread[:n],
        model.dt_s,
        integrators=structure.integrators,
        input_delay_samples=structure.input_delay_samples,
    )
    return BehindFriction(response, shaft, fit.level + float(moved[n]), spread[n], fit, model.poles)
