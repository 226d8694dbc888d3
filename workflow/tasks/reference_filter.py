"""The reference filter of a design (u = K (F r - y)): designed after K, and told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.signal

from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import design_reference_filter
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import RationalWeight
from workflow.config.design_options import ReferenceFilterSettings
from workflow.engine.errors import InputError
from workflow.tasks.results import ReferenceFilterResult


def find_filter(
    controller: Controller, plants: Sequence[UncertainPlant], settings: ReferenceFilterSettings | None
) -> ReferenceFilterResult:
    """The filter, or why there is none.

    A loop that is not robustly stable has no worst-case error: a result, with the reason. Raises InputError:
    see `check_filter`.
    """
    if settings is None:
        return ReferenceFilterResult()
    check_filter(settings, controller.dt_s)
    try:
        found = design_reference_filter(
            controller, plants, settings.reference_model, settings, weight=settings.error_weight
        )
    except ValueError as unfit:
        return ReferenceFilterResult(reason=f"no reference filter: {unfit}")
    return ReferenceFilterResult(found)


def check_filter(settings: ReferenceFilterSettings | None, dt_s: float, source: str = "") -> None:
    """Refuse frequencies that a sampling time does not allow, before anything is designed.

    source: the file, for the complaint. Raises InputError: one line naming the key.
    """
    if settings is None:
        return
    nyquist, where = np.pi / dt_s, f"{source}: reference_filter" if source else "reference_filter"
    for rate in settings.poles_rad_s or ():
        if not 0 < rate < nyquist:
            raise InputError(
                f"{where}.poles_rad_s: {rate:.4g} is not between 0 and the Nyquist frequency "
                f"{nyquist:.4g} rad/s"
            )
    corner = settings.corner_rad_s
    if corner is not None and not corner < nyquist:
        raise InputError(
            f"{where}.corner_rad_s: {corner:.4g} lies beyond the Nyquist frequency {nyquist:.4g} rad/s"
        )


def model_answer(
    model: RationalWeight, reference: npt.NDArray[np.float64], dt_s: float
) -> npt.NDArray[np.float64]:
    """Answer (T,) of the reference model, by Tustin's map as the design sees it, to a reference (T,)."""
    discrete = scipy.signal.bilinear(model.numerator, model.denominator, 1.0 / dt_s)
    return np.asarray(scipy.signal.lfilter(*discrete, reference), dtype=np.float64)
