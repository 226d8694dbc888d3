"""Whether records show the motion of the shaft that the friction acts on: else a fit of it means nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.basis.model import GobfModel
from ident.data.record import Record
from ident.friction.gauss_newton import FrictionFit

# Of different values that the position takes: with 21 the level of the default arm's friction came out within
# its standard deviation (7 %), with 11 a third too low.
_FEWEST_VALUES = 15
# A position that is noise to this share has not moved.
_MOSTLY_NOISE = 0.9
# The speed of a driven shaft is within 90 degrees of its force, and the drive's own lag comes on top; that of
# a point beyond the first mode is opposite.
_MOST_DEG = 135.0
_LIGHT = 0.3
_UNSEEN, _ANYWAY = "the friction of the shaft cannot be told: ", "; promise = 'as recorded' needs none"


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
    """Where, rad/s, and how far, degrees, the speed of a model of the position is off the input: as a whole
    around the slowest lightly damped mode, or below it, whichever is more."""
    dt_s = model.dt_s
    omega = model.poles.omega_rad_s(dt_s)[model.poles.zeta() < _LIGHT]
    first = float(omega.min()) if omega.size else 0.3 * np.pi / dt_s
    worst = 0.0, 0.0
    for at in (0.1 * first, first) if omega.size else (0.1 * first,):
        around = np.geomspace(0.8 * at, min(1.6 * at, np.pi / dt_s), 200)
        # The hold is half a sample late.
        late = np.exp(1j * around * dt_s * (model.input_delay_samples + 0.5))
        speed = 1j * around * late * model.frequency_response(around)
        worst = max(worst, (at, float(np.degrees(np.abs(np.angle(speed.sum()))))), key=lambda one: one[1])
    return worst
