"""From which frequency on tracking can be asked of plants whose ellipses hold a gain of zero.

A plant whose gain may be zero answers to nothing: there S = 1 for every controller, and no tracking can be
certified. `tracking_where_told` begins the tracking requirement above the low frequencies whose ellipses say
so, instead of refusing the design. The modulus margin is asked at all frequencies, so a controller with an
integrator will do only where the ellipses hardly reach beyond zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from control_design.plants.ellipses import nearest_distance
from control_design.plants.frequency_grid import lowest_rad_s
from control_design.plants.plant_set import UncertainPlant
from control_design.specification.specification import Specification

# Frequencies at which ellipses are held against zero, between the lowest of a plant and the bandwidth: 8 %
# from one to the next over seven decades.
_POINTS = 200
# Distance of an ellipse from zero, as a share of its centre, below which it as good as holds zero: |S| below
# -3 dB there would take twenty times the gain of the centre. Chosen.
_AS_GOOD_AS_ZERO = 0.05
# Part of the frequency where ellipses end to hold zero by which tracking begins above it: they still come
# near. Also the least ratio of a bandwidth to where tracking begins.
_ABOVE = 1.1


def tracking_where_told(specification: Specification, plants: Sequence[UncertainPlant]) -> Specification:
    """Specification whose tracking begins where the first ellipse of each plant no longer holds zero.

    Parameters
    ----------
    specification : Specification
        One that states `tracking_from_rad_s`, or has no bandwidth, is returned as it is.
    plants : sequence of UncertainPlant
        Those known on their own frequencies only are not looked at.

    Returns
    -------
    Specification
        With `tracking_from_rad_s`, and a lowest bandwidth above it where that leaves room; the one given
        where the lowest frequency of every plant is told.

    Raises
    ------
    ValueError
        What `UncertainPlant.at` raises.
    """
    bandwidth = specification.bandwidth_rad_s
    if bandwidth is None or specification.tracking_from_rad_s is not None:
        return specification
    untold_rad_s = 0.0
    for plant in plants:
        lowest = lowest_rad_s(plant.dt_s, plant.poles)
        highest = min(bandwidth, plant.nyquist_rad_s)
        if plant.own_grid is None and lowest < highest:
            untold_rad_s = max(untold_rad_s, _zero_held_up_to(plant, lowest, highest))
    if untold_rad_s == 0:
        return specification
    begins = float(f"{_ABOVE * untold_rad_s:.3g}")
    update: dict[str, float] = {"tracking_from_rad_s": begins}
    lowest_bandwidth = specification.lowest_bandwidth_rad_s
    if lowest_bandwidth is not None and lowest_bandwidth < _ABOVE * begins < bandwidth:
        update["lowest_bandwidth_rad_s"] = float(f"{_ABOVE * begins:.3g}")
    return specification.model_copy(update=update)


def _zero_held_up_to(plant: UncertainPlant, lowest_rad_s: float, highest_rad_s: float) -> float:
    """Frequency, rad/s, up to which all ellipses of a plant hold zero, from the lowest on; 0 for none.

    Nothing above a band that is told is looked at: there a lower bandwidth is the answer.
    """
    ellipses = plant.at(np.geomspace(lowest_rad_s, highest_rad_s, _POINTS))
    turned = -ellipses.centre * np.conj(ellipses.direction)
    distance = nearest_distance(turned, ellipses.semi_major, ellipses.semi_minor)
    is_told = distance > _AS_GOOD_AS_ZERO * np.abs(ellipses.centre)
    n_untold = int(np.argmax(is_told)) if is_told.any() else is_told.size
    if n_untold == 0:
        return 0.0
    return float(ellipses.omega_rad_s[n_untold - 1])
