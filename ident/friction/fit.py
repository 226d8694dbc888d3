"""Dry friction and the linear arm behind it from records of the shaft's own position.

The position is G (u - f) with f set by the motion itself (Armstrong-Helouvry, Dupont and Canudas de Wit,
Automatica 30(7), 1994). Given the arm, the motion under friction is simulated; law and coefficients of the
arm on its poles, each taken twice, are one least-squares problem (Gauss-Newton). The poles come from the
search of `ident.one_input` on the records with the friction taken off; both are repeated until the residual
no longer falls. How much the level differs between records is estimated, and at least a thousandth. What this
does not explain, friction that falls with speed (Stribeck) or at the load among it, an observer follows
(`ident.friction.estimator`).

Neglected: a level that depends on position or load; records start at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.checks.plausible_modes import LARGEST_DAMPING, LIGHT
from ident.checks.residual_tests import whiteness_test
from ident.data.record import Record
from ident.friction.arm import PRESLIDING, FrictionLaw
from ident.friction.command_causes import BY_CHANCE, recorded_in_loop
from ident.friction.estimator import fit_friction_in_loop
from ident.friction.gauss_newton import (
    WORTH,
    FrictionFit,
    LostError,
    descended,
    simulated_rss,
    started,
)
from ident.friction.inverse_dynamics import presliding_of, with_measured_direction
from ident.one_input import untested_model
from ident.search.order_selection import Progress

# Searches for the poles, each anew with a better level. Two or three are usual; the bound only ends a fit
# whose residual creeps, so twice as many change no usual fit.
_MOST_SEARCHES = 8
# Smallest level that is tried, as a share of the rms command: a level of zero has no derivative by the
# deflection. Chosen; small beside any friction that is seen.
_LEAST_LEVEL_SHARE = 1e-6
# Lowest level near a fit that is moved to other poles, as a share of its own level. Chosen: nearby poles do
# not turn the friction into another one.
_LEAST_MOVED_SHARE = 0.1

# Different positions: with 21 the level was within its standard deviation (7 %), with 11 a third too low.
_FEWEST_VALUES = 15
# A position of which noise is this share of the variance has not moved. Chosen, against a stuck shaft whose
# noise gave a level; doubled it would never refuse.
_MOSTLY_NOISE = 0.9
# A driven shaft's speed is within 90 degrees of its force, with a lag on top; beyond a mode it is opposite.
# Half way from 90 to 180 degrees.
_MOST_DEG = 135.0
# Place of the first mode where the model has none, as a share of the Nyquist frequency. Chosen.
_WITHOUT_MODE = 0.3
# Share of the friction that the motion shows, by inverse dynamics, which a fit at the sensor takes at least
# where it acts there. Of 43 fits of machines with the friction at the sensor or at the load behind it (series
# 4, 21 and 32 of benchmarks.closed_loop_machines) the least was .30; one with its sensor at the load took
# .004, and its certificate was false.
_LEAST_TAKEN = 0.1
# How every refusal of `refuse_unseen_shaft` begins, and how it ends.
_UNSEEN = "the friction of the shaft cannot be told: "
_ANYWAY = "; response = 'as recorded' needs none"


def fit_friction(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    free: bool = False,
    progress: Progress | None = None,
) -> FrictionFit:
    """Law of the friction and the arm behind it.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position of the shaft that the friction acts on as the one output; at rest at their
        first sample, unless made in a loop (`ident.friction.estimator`).
    options : IdentOptions, optional
        Of the search for the arm's poles; integrators at most 1.
    free : bool
        The arm's free run is asked for, even where it leaves more than noise. Otherwise an observer follows
        such records, too.
    progress : callable, optional
        Called with a share of the work (0 to 1) and a message.

    Returns
    -------
    FrictionFit
        Level and other forces in units of the input, positions in units of the output.

    Raises
    ------
    ValueError
        The shaft does not move, there is more than one integrator or a direct term, or `identify` refuses the
        records. `LostError`, a ValueError, where nothing follows them.
    """
    options = options or IdentOptions()
    if (options.zeta_min or 0.0) < LARGEST_DAMPING:
        # Pairs that can be modes: one that does not swing follows what a wrong level leaves.
        largest_damping = min(options.zeta_max or LARGEST_DAMPING, LARGEST_DAMPING)
        options = options.model_copy(update={"zeta_max": largest_damping})
    if recorded_in_loop(records):
        return fit_friction_in_loop(records, options, progress=progress)
    for record in records:
        if not np.ptp(record.output[:, 0]) > 0:
            raise ValueError(f"{record.label}: the shaft does not move, so that its friction cannot be seen")

    report = progress or (lambda fraction, message: None)
    try:
        fit = _running_free(records, options, report)
    except LostError:
        if free:
            raise
        return fit_friction_in_loop(records, options, progress=progress)

    residuals = [fit.residual(record) for record in records]
    # At the level of the report one good free run in a hundred would be given up.
    if not free and fit.significant and whiteness_test(residuals).probability < BY_CHANCE:
        # What is wrong with arm or law adds up in a free run, whose first order does not reach far then.
        with suppress(ValueError):
            followed = fit_friction_in_loop(records, options, progress=progress)
            if followed.significant:
                fit = followed
    report(1.0, "friction identified")
    return fit


def _running_free(records: Sequence[Record], options: IdentOptions, report: Progress) -> FrictionFit:
    """The fit whose simulation starts at rest with every record and sees nothing of it but the input.

    `records` are as in `fit_friction`. Raises LostError where the simulation runs away.
    """
    report(0.0, "friction: start")
    structure = options.structure()
    least_level = _LEAST_LEVEL_SHARE * max(float(np.std(record.input)) for record in records)
    level, frictionless = with_measured_direction(
        records, presliding_of(records), options.input_delay_samples, stiff=not options.integrators
    )
    level = max(level, least_level)
    # One pair more than asked for: what a wrong level leaves would otherwise take the place of a weak mode.
    n_pairs = None if options.n_pairs is None else options.n_pairs + 1
    model = untested_model(frictionless, options.model_copy(update={"n_pairs": n_pairs}))

    best: FrictionFit | None = None
    for search in range(_MOST_SEARCHES):
        report(0.2 + 0.8 * search / _MOST_SEARCHES, "friction: arm and level together")
        law = FrictionLaw(level, PRESLIDING) if best is None else best.law
        fit = descended(started(model, structure, law), records, PRESLIDING, least_level)
        if best is not None:
            worth = WORTH * fit.noise_std**2
            # Written with "not", so that a sum that is not a number ends the search, too.
            if not simulated_rss(fit, records) + worth < simulated_rss(best, records):
                break
        best = fit
        # The poles may have been led astray by friction that was not yet right: search for them again.
        model = untested_model([fit.taken_off(record) for record in records], options)
    assert best is not None
    return descended(best, records, PRESLIDING, least_level, held=False)


def moved_to(fit: FrictionFit, records: Sequence[Record], model: GobfModel) -> FrictionFit:
    """A fit of friction on the poles of another model of its arm, descended again from the law it had.

    Parameters
    ----------
    fit : FrictionFit
        Of these records, without an observer.
    records : sequence of Record
    model : GobfModel
        Of the arm; its poles are near those the fit was made with.

    Returns
    -------
    FrictionFit
    """
    start = started(model, fit.arm.structure, fit.law)
    return descended(start, records, fit.law.presliding, _LEAST_MOVED_SHARE * fit.level)


def refuse_missed_friction(fit: FrictionFit, shown: float, name: str) -> None:
    """Nothing, unless a fit takes hardly any of the friction that the motion shows: then it acts elsewhere.

    Parameters
    ----------
    fit : FrictionFit
    shown : float
        Level by inverse dynamics (`ident.friction.inverse_dynamics.level_of`), units of the input.
    name : str
        Of the output, for the error.

    Raises
    ------
    ValueError
        One line: the arm behind such a fit is one whose friction was left in.
    """
    if fit.level < _LEAST_TAKEN * shown:
        raise ValueError(
            f"{_UNSEEN}the motion shows about {shown:.3g} (in the unit of the input), of which the fit finds "
            f"{fit.level:.2g}, so that it does not act where '{name}' is measured{_ANYWAY}"
        )


def refuse_unseen_shaft(fit: FrictionFit, records: Sequence[Record]) -> None:
    """Raise ValueError, one line, where the friction of a fit rests on nothing.

    Parameters
    ----------
    fit : FrictionFit
    records : sequence of Record
        Of which it was made; one output.

    Raises
    ------
    ValueError
        The position comes in steps too coarse to tell its direction, is lost in noise, or is not that of the
        driven shaft.
    """
    name = records[0].output_names[0]
    n_values = max(np.unique(record.output).size for record in records)
    if n_values < _FEWEST_VALUES:
        raise ValueError(
            f"{_UNSEEN}'{name}' takes {n_values} different values only, too few to see which way it turns "
            f"(expected {_FEWEST_VALUES} or more){_ANYWAY}"
        )
    squares = [(record.output - record.output.mean()) ** 2 for record in records]
    moved_rms = float(np.sqrt(np.mean(np.concatenate(squares))))
    if fit.noise_std**2 > _MOSTLY_NOISE * moved_rms**2:
        raise ValueError(
            f"{_UNSEEN}the motion of '{name}' (rms {moved_rms:.3g}) is lost in its noise "
            f"({fit.noise_std:.3g}), as if the shaft stuck: larger inputs are needed{_ANYWAY}"
        )
    omega_rad_s, angle_deg = _off_the_force(fit.model)
    if angle_deg > _MOST_DEG:
        raise ValueError(
            f"{_UNSEEN}'{name}' is no position of the driven shaft, or has the wrong sign: around "
            f"{omega_rad_s:.3g} rad/s its speed is {angle_deg:.0f} degrees off the input "
            f"(at most {_MOST_DEG:.0f}){_ANYWAY}"
        )


def _off_the_force(model: GobfModel) -> tuple[float, float]:
    """Frequency (rad/s) at which the speed is farthest off the input, and how far (degrees, 0 to 180).

    Looked at are bands around the first light mode and around a tenth of its frequency; (0, 0) where the
    speed has the direction of the input in both.
    """
    dt_s = model.dt_s
    is_light = model.poles.zeta() < LIGHT
    modes_rad_s = model.poles.omega_rad_s(dt_s)[is_light]
    if modes_rad_s.size:
        first = float(modes_rad_s.min())
        places = [0.1 * first, first]
    else:
        first = float(_WITHOUT_MODE * np.pi / dt_s)
        places = [0.1 * first]

    worst_place = 0.0
    worst_deg = 0.0
    for place in places:
        # Summed over a band, a narrow mode or zero of the model does not decide by itself.
        omega = np.geomspace(0.8 * place, min(1.6 * place, np.pi / dt_s), 200)
        # The hold is half a sample late.
        late_samples = model.input_delay_samples + 0.5
        undelayed = np.exp(1j * omega * dt_s * late_samples)
        speed = 1j * omega * undelayed * model.frequency_response(omega)
        angle_deg = float(np.degrees(np.abs(np.angle(speed.sum()))))
        if angle_deg > worst_deg:
            worst_place = place
            worst_deg = angle_deg
    return worst_place, worst_deg
