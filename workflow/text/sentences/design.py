"""What a synthesis reached, what a controller of any order could, and what of a specification gave way."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from workflow.text.formats import at_least, at_most, frequency, number, share

if TYPE_CHECKING:
    from control_design.analysis.joint_coverage import JointCoverage
    from control_design.convex.youla import YoulaBracket
    from control_design.specification import Specification
    from control_design.synthesis.joint_synthesis import JointDesign
    from control_design.synthesis.multivariable import MultivariableResult
    from control_design.synthesis.synthesis_result import BlockingPoint, SynthesisResult
    from ident.uncertainty.nominal import NominalAgreement

# Percent that a higher order has to promise before it is a number: less is within what a search leaves open.
_LEAST_GAIN_PERCENT = 0.5
# Relative: bandwidths are rounded to three digits, so a difference below this is none.
_SAME_BANDWIDTH = 0.999

# Said in place of the uncertainty where the design file has none.
NOTHING_STATED = (
    "no uncertainty is specified ([uncertainty] in the design file): design and certificate hold for exactly "
    "this model"
)
# Why there are no posterior samples.
NOTHING_TO_DRAW = "no uncertainty is specified: there is nothing to draw from"
# Why there are none though there is an uncertainty.
NOT_DRAWN = "no responses were drawn (joint_draws = 0)"
# Why it is not known what other orders reach.
BRACKET_NOT_ASKED = "not computed (compute = false)"


def undrawable(plant: str, own_grid: bool) -> str:
    """Why posterior samples of a plant cannot be drawn."""
    known = "known at its own frequencies only" if own_grid else "a bound, not a distribution"
    return f"responses of {plant} cannot be sampled: its uncertainty is {known}"


def nominal_inside(agreement: NominalAgreement, ellipses: int) -> str:
    """How well the nominal model agrees with its ellipses."""
    return (
        f"nominal model inside {agreement.share_inside_percent:.3g} % of the {ellipses} ellipses, at most "
        f"{agreement.largest_distance:.3g} of one from the centre ({agreement.at_rad_s:.4g} rad/s)"
    )


def outcome(synthesis: SynthesisResult | MultivariableResult) -> str:
    """What a synthesis came to, with its gamma and the active constraint."""
    name = synthesis.outcome.name
    blocking = synthesis.blocking[0] if synthesis.blocking else None
    active = ""
    if blocking is not None:
        active = f"{blocking.weight} of '{blocking.plant}' at {frequency(blocking.omega_rad_s, 4)}"
    if name == "NOT_CONVERGED":
        words = "no stabilising controller was found"
        if active:
            words += f"; the closest attempt failed on {active}"
        fixed = getattr(getattr(synthesis, "specification", None), "fixed", None)
        if fixed is not None and fixed.kp is not None:
            words += f"; fixed.kp = {number(fixed.kp)} may have the wrong sign, or be too large"
        return words
    words = "the loop is stable on the dense grid of frequencies, but a requirement is missed"
    if name == "MET_ON_GRID":
        words = "every requirement is met for every plant, on the dense grid of frequencies"
    reached = [f"γ = {at_most(synthesis.gamma, 4)}"]
    if synthesis.gamma > 1:
        reached[0] += ", at most 1 is needed"
    if active:
        reached.append(f"active constraint: {active}")
    return f"{words} ({'; '.join(reached)})"


def would_meet(change: tuple[str, float] | None) -> str:
    """Another value of one key that a design meets; "" for none."""
    if change is None:
        return ""
    key, value = change
    return f"; {key} = {number(value)} would meet it"


def draws_stable(design: JointDesign) -> str:
    """How many models drawn from the posterior a design leaves unstable."""
    if not design.unstable:
        return "no stable design: no models were drawn"
    enough = "enough" if design.reached else "NOT enough"
    words = (
        f"{design.unstable[-1]} of {design.draws} models drawn from the posterior are unstable "
        f"({enough} are stable)"
    )
    if design.guards:
        words += f"; the design takes {len(design.guards)} unstable ones into account"
    return words


def bracket_unfit(why: str) -> str:
    """Why there is no bracket of what any order reaches."""
    return f"the parametrisation does not take this plant: {why}"


def any_order(bracket: YoulaBracket | None, reason: str | None, gamma: float | None, order: int | str) -> str:
    """How far the order chosen is from what a controller of any order is known to reach.

    Args:
        bracket: What any order reaches; None: not known, for `reason`.
        reason: Why it is not known; None where nobody asked.
        gamma: Weighted worst case of the design; None or infinite without a stable controller.
        order: Of the controller.
    """
    if bracket is None:
        return f"not compared with controllers of other orders: {reason}" if reason else ""
    if gamma is None or not math.isfinite(gamma):
        if math.isfinite(bracket.ellipse):
            return f"some controller of a higher order reaches γ = {number(bracket.ellipse, 4)}"
        return "no controller of any order is known to stabilise every plant in the uncertainty set"
    reached = f"order {order} reaches γ = {at_most(gamma, 4)}"
    if not math.isfinite(bracket.ellipse):
        return (
            f"{reached}; no other controller is known to stabilise every plant in the uncertainty set (lower "
            f"bound: {at_least(bracket.floor)})"
        )
    if gamma < bracket.floor:
        return (
            f"{reached} (needed: 1 or less), below the lower bound for any order, "
            f"{at_least(bracket.floor, 4)}. That bound is approximate (limited basis, on a grid), so higher "
            "orders may still help"
        )
    # No order comes below the floor, so that is the most there is to gain.
    left_percent = 100 * (1 - bracket.floor / gamma)
    gain = f"can gain at most {at_most(left_percent, 2)} %"
    if left_percent < _LEAST_GAIN_PERCENT:
        gain = f"gains less than {_LEAST_GAIN_PERCENT} %"
    about = "any order" if len(bracket.plants) == 1 else "any order, one controller per plant"
    return (
        f"{reached} (needed: 1 or less); a higher order {gain} (lower bound for {about}: "
        f"{at_least(bracket.floor)})"
    )


def order_advice(
    bracket: YoulaBracket | None, gamma: float, order: int | str, structure: str = "biquads"
) -> str:
    """Whether a higher order could meet what was missed; "" where that is not known.

    The bound knows neither structure nor damping of the controller's poles, and with several plants it is
    what one controller per plant reaches: more than that no order gives.
    """
    if bracket is None or not math.isfinite(bracket.ellipse):
        return ""
    reach = number(bracket.ellipse, 4)
    this_one = f"this one {at_most(gamma, 4)}, at most 1 is needed"
    if bracket.ellipse > 1:
        return (
            f"a higher order is not enough: controllers of very high order reach γ = {reach} ({this_one}); "
            "lower the requirements"
        )
    each = ", one for each plant," if len(bracket.plants) > 1 else ""
    if structure != "biquads":
        beside = f" ({this_one})" if math.isfinite(gamma) else ""
        return (
            f"structure {json.dumps(structure)} with what is fixed of it may be too little (order {order}): "
            f"controllers of very high order{each} reach γ = {reach}{beside}; fix less, add a notch or (for "
            "effort) a low_pass, or leave structure out"
        )
    if math.isfinite(gamma):
        return (
            f"controller_order = {order} may be too low: controllers of very high order{each} reach "
            f"γ = {reach} ({this_one})"
        )
    return (
        f"the search found no stable loop of order {order}, which does not prove that none exists: "
        f"controllers of very high order{each} reach γ = {reach}; try more starts, another seed or a higher "
        "controller_order"
    )


def held_by_samples(
    joint: JointCoverage,
    held_interval: Sequence[float] | None = None,
    stable_interval: Sequence[float] | None = None,
) -> str:
    """For how many sampled responses the worst case of the ellipses holds; intervals: of the shares, 95 %."""
    held = (
        f" ({share(held_interval[0])} to {share(held_interval[1])} with 95 % confidence)"
        if held_interval
        else ""
    )
    stable = f" (at least {share(stable_interval[0])})" if stable_interval else ""
    drawn = f"of {joint.draws} models drawn from the posterior, "
    if not math.isfinite(joint.gamma_given):
        return (
            f"{drawn}{share(joint.stable_share)} give a stable loop; there is no worst case of the ellipses"
        )
    return (
        f"{drawn}{share(joint.coverage_given)} stay within the worst case of the {share(joint.given_level)} "
        f"ellipses{held} and {share(joint.stable_share)} give a stable loop{stable}"
    )


def no_filter(why: str = "there is no controller") -> str:
    """Why there is no reference filter."""
    return f"no reference filter: {why}"


def lowered(
    specified: Specification,
    designed_for: Specification | None,
    blocking: Sequence[BlockingPoint],
    certified_rad_s: float,
) -> str:
    """Which bandwidth is which where a lower one was taken than specified; "" elsewhere.

    Args:
        specified: What the configuration asks for.
        designed_for: What was designed for; None: as specified.
        blocking: Active constraints of the design.
        certified_rad_s: Bandwidth that is certified; 0 for none.
    """
    if designed_for is None or specified.lowest_bandwidth_rad_s is None:
        return ""
    wanted = specified.bandwidth_rad_s
    used = designed_for.bandwidth_rad_s
    if wanted is None or used is None or used >= _SAME_BANDWIDTH * wanted:
        return ""
    words = f"bandwidth_rad_s = {number(wanted)} was not met"
    if blocking:
        words += f" (active constraint: {blocking[0].weight} at {frequency(blocking[0].omega_rad_s)})"
    words += f"; designed for {number(used)} rad/s"
    if certified_rad_s > 0:
        words += f"; reaches at least {at_least(certified_rad_s)} rad/s"
    return words


def tracking_begins(specified: Specification, designed_for: Specification | None) -> str:
    """From where on tracking is asked, where the ellipses hold a gain of zero below; "" elsewhere."""
    if designed_for is None or not designed_for.tracking_from_rad_s or specified.tracking_from_rad_s:
        return ""
    begins = frequency(designed_for.tracking_from_rad_s)
    return (
        f"tracking is asked from {begins} on: below, the logs do not tell the "
        "response from none; record slower motion (flexlink excite --band)"
    )


def untold(below_rad_s: float) -> str:
    """Up to where the ellipses are wider than the gain; "" where they are nowhere (0)."""
    if not below_rad_s:
        return ""
    return (
        f"below {frequency(below_rad_s)} the logs do not show the response (its ellipses are wider than the "
        "gain); record slower motion: flexlink excite --band (of a loop --closed-loop, too)"
    )
