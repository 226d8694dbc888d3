"""Dry friction and the linear arm behind it from records of the shaft's own position.

The position is G (u - f) with f set by the motion itself (Armstrong-Helouvry, Dupont and Canudas de Wit,
Automatica 30(7), 1994). Given the arm, the motion under friction is simulated; law and coefficients of the
arm on its poles, each taken twice, are one least-squares problem (Gauss-Newton). The poles come from the
search of `ident.one_input` on the records with the friction taken off; both are repeated until the residual
no longer falls. How much the level differs between records is estimated, and at least a thousandth. What this
does not explain, friction that falls with speed (Stribeck) or at the load among it, an observer follows
(`ident.friction.in_loop`).

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
from ident.friction.gauss_newton import (
    WORTH,
    FrictionFit,
    LostError,
    descended,
    simulated_rss,
    started,
)
from ident.friction.in_loop import BY_CHANCE, fit_friction_in_loop, recorded_in_loop
from ident.friction.inverse_dynamics import presliding_of, with_measured_direction
from ident.one_input import untested_model
from ident.search.order_selection import Progress

_MOST_SEARCHES = 8  # for the poles, anew with each better level; two or three are usual

# Different positions: with 21 the level was within its standard deviation (7 %), with 11 a third too low.
_FEWEST_VALUES = 15
# A position that is noise to this share has not moved.
_MOSTLY_NOISE = 0.9
# A driven shaft's speed is within 90 degrees of its force, with a lag on top; beyond a mode it is opposite.
_MOST_DEG = 135.0
_UNSEEN, _ANYWAY = "the friction of the shaft cannot be told: ", "; response = 'as recorded' needs none"


def fit_friction(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    free: bool = False,
    progress: Progress | None = None,
) -> FrictionFit:
    """Law of the friction and the arm behind it.

    records: one input, and the position of the shaft that the friction acts on as the one output; at rest at
    their first sample, unless made in a loop (`ident.friction.in_loop`). options: of the search for the arm's
    poles; integrators at most 1. free: the arm's free run is asked for, even where it leaves more than noise;
    otherwise an observer follows such records too. Raises ValueError where the shaft does not move, there is
    more than one integrator or a direct term, or `identify` refuses the records.
    """
    options = options or IdentOptions()
    if (options.zeta_min or 0.0) < LARGEST_DAMPING:
        # Pairs that can be modes: one that does not swing follows what a wrong level leaves.
        most = min(options.zeta_max or LARGEST_DAMPING, LARGEST_DAMPING)
        options = options.model_copy(update={"zeta_max": most})
    if recorded_in_loop(records):
        return fit_friction_in_loop(records, options, progress=progress)
    for record in records:
        if not np.ptp(record.output[:, 0]) > 0:
            raise ValueError(f"{record.label}: the shaft does not move, so that its friction cannot be seen")
    report = progress or (lambda fraction, message: None)
    try:
        found = _running_free(records, options, report)
    except LostError:
        if free:
            raise
        return fit_friction_in_loop(records, options, progress=progress)
    residuals = [found.residual(record) for record in records]
    # At the level of the report one good free run in a hundred would be given up.
    if not free and found.significant and whiteness_test(residuals).probability < BY_CHANCE:
        # What is wrong with arm or law adds up in a free run, whose first order does not reach far then.
        with suppress(ValueError):
            followed = fit_friction_in_loop(records, options, progress=progress)
            found = followed if followed.significant else found
    report(1.0, "friction identified")
    return found


def _running_free(records: Sequence[Record], options: IdentOptions, report: Progress) -> FrictionFit:
    """The fit whose simulation starts at rest with every record and sees nothing of it but the input."""
    report(0.0, "friction: start")
    structure = options.structure()
    least = 1e-6 * max(float(np.std(record.input)) for record in records)
    level, less = with_measured_direction(
        records, presliding_of(records), options.input_delay_samples, stiff=not options.integrators
    )
    # One pair more than asked for: what a wrong level leaves would otherwise take the place of a weak mode.
    pairs = None if options.n_pairs is None else options.n_pairs + 1
    level, model = max(level, least), untested_model(less, options.model_copy(update={"n_pairs": pairs}))
    best: FrictionFit | None = None
    for search in range(_MOST_SEARCHES):
        report(0.2 + 0.8 * search / _MOST_SEARCHES, "friction: arm and level together")
        law = FrictionLaw(level, PRESLIDING) if best is None else best.law
        found = descended(started(model, structure, law), records, PRESLIDING, least)
        if best is not None and not (
            simulated_rss(found, records) + WORTH * found.noise_std**2 < simulated_rss(best, records)
        ):
            break
        best = found
        # The poles may have been led astray by friction that was not yet right: search for them again.
        model = untested_model([found.taken_off(record) for record in records], options)
    assert best is not None
    return descended(best, records, PRESLIDING, least, held=False)


def moved_to(found: FrictionFit, records: Sequence[Record], model: GobfModel) -> FrictionFit:
    """The same fit on the poles of another model of the arm, near those it was made with."""
    start = started(model, found.arm.structure, found.law)
    return descended(start, records, found.law.presliding, 0.1 * found.level)


def refuse_unseen_shaft(found: FrictionFit, records: Sequence[Record]) -> None:
    """Raises ValueError, one line, where the friction of a fit to records (one output) rests on nothing: a
    position in steps too coarse to tell its direction, lost in noise, or not that of the driven shaft."""
    name = records[0].output_names[0]
    values = max(np.unique(record.output).size for record in records)
    if values < _FEWEST_VALUES:
        raise ValueError(
            f"{_UNSEEN}'{name}' takes {values} different values only, too few to see which way it turns "
            f"(expected {_FEWEST_VALUES} or more){_ANYWAY}"
        )
    moved = float(np.sqrt(np.mean(np.concatenate([(r.output - r.output.mean()) ** 2 for r in records]))))
    if found.noise_std**2 > _MOSTLY_NOISE * moved**2:
        raise ValueError(
            f"{_UNSEEN}the motion of '{name}' (rms {moved:.3g}) is lost in its noise "
            f"({found.noise_std:.3g}), as if the shaft stuck: larger inputs are needed{_ANYWAY}"
        )
    at, angle_deg = _off_the_force(found.model)
    if angle_deg > _MOST_DEG:
        raise ValueError(
            f"{_UNSEEN}'{name}' is no position of the driven shaft, or has the wrong sign: around {at:.3g} "
            f"rad/s its speed is {angle_deg:.0f} degrees off the input (at most {_MOST_DEG:.0f}){_ANYWAY}"
        )


def _off_the_force(model: GobfModel) -> tuple[float, float]:
    """Where, rad/s, and how far, degrees, the speed is off the input at most, around the first mode or
    below."""
    dt_s = model.dt_s
    omega = model.poles.omega_rad_s(dt_s)[model.poles.zeta() < LIGHT]
    first = float(omega.min()) if omega.size else 0.3 * np.pi / dt_s
    worst = 0.0, 0.0
    for at in (0.1 * first, first) if omega.size else (0.1 * first,):
        around = np.geomspace(0.8 * at, min(1.6 * at, np.pi / dt_s), 200)
        # The hold is half a sample late.
        late = np.exp(1j * around * dt_s * (model.input_delay_samples + 0.5))
        speed = 1j * around * late * model.frequency_response(around)
        worst = max(worst, (at, float(np.degrees(np.abs(np.angle(speed.sum()))))), key=lambda one: one[1])
    return worst
