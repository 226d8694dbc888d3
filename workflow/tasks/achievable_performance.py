"""How far a design is from what a controller of any order could reach: the Youla bracket, found and told."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from control_design.convex.youla import youla_bracket
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from workflow.config.design_options import AchievableOptions
from workflow.engine import codec
from workflow.tasks.results import AchievablePerformance

# Requirements that the bracket does not know: a bracket of other values of these is the same.
UNKNOWN_TO_BRACKET = (
    "controller_order",
    "structure",
    "controller_damping",
    "delay_margin_s",
    "mode_damping",
    "input_limit",
    "rate_limit",
)


def find_bracket(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: AchievableOptions,
    progress: Callable[[float, str], None] | None = None,
) -> AchievablePerformance:
    """The bracket, or why there is none."""
    if not options.compute:
        return AchievablePerformance(reason="not asked for (compute = false)")
    try:
        bracket = youla_bracket(plants, specification, options, progress=progress)
    except SpecificationError as impossible:
        return AchievablePerformance(reason=str(impossible))
    except (ValueError, ArithmeticError) as unfit:
        return AchievablePerformance(reason=f"the parametrisation does not take this plant: {unfit}")
    return AchievablePerformance(bracket)


def bracket_numbers(found: AchievablePerformance, gamma: float | None) -> dict[str, Any]:
    """Numbers for JSON and tables: what any order reaches, the floor, how far gamma is above in percent."""
    bracket = found.bracket
    if bracket is None:
        return {"reached": None, "floor": None, "above_percent": None, "reason": found.reason}
    reached, floor = _finite(bracket.ellipse), _finite(bracket.floor)
    known = gamma is not None and math.isfinite(gamma) and reached is not None
    return {
        "reached": reached,
        "floor": floor,
        "above_percent": 100.0 * (gamma / reached - 1.0) if known and gamma and reached else None,
        "reason": None,
        "bracket": codec.plain(bracket),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
