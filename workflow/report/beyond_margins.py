"""Of a design beyond its margins: other orders, whole responses, the prefilter; words from the numbers."""

from __future__ import annotations

import math

from control_design.convex.reference_filter import Prefilter
from workflow.report.data import RunData
from workflow.report.formats import frequency, number, percent, sentence
from workflow.report.page import Block, Code, Remarks, Table, Text, heading, maybe
from workflow.tasks.achievable_performance import achievable_words, order_advice
from workflow.tasks.joint_coverage import joint_numbers, joint_words
from workflow.tasks.reference_filter import filter_words


def beyond_words(data: RunData) -> list[str]:
    """For the verdict: how far from any order, how many whole responses the worst case holds for, and what
    the prefilter buys."""
    if data.synthesis is None or not data.has_controller:
        return []
    gamma, order = data.synthesis.gamma, data.config.specification.controller_order
    words = [_any_order(data, gamma, order), _whole(data), prefilter_sentence(data)]
    if gamma > 1:
        words.append(order_advice(data.achievable, gamma, order))
    return [text for text in words if text]


def _any_order(data: RunData, gamma: float | None, order: int) -> str | None:
    bracket = data.achievable.bracket
    if bracket is None or gamma is None:
        return None
    if not (math.isfinite(bracket.ellipse) and math.isfinite(gamma)):
        return None
    above = percent(100 * abs(bracket.excess(gamma)), 2)
    side = "above" if bracket.excess(gamma) >= 0 else "below"
    return (
        f"the weighted worst case (1 or less is met) is {number(gamma)} with this controller of order "
        f"{order}: {above} {side} the {number(bracket.ellipse)} that a controller of any order is known to "
        f"reach; none goes below about {number(bracket.floor)}"
    )


def _whole(data: RunData) -> str | None:
    joint = data.sampled.joint
    if joint is None:
        return None
    numbers = joint_numbers(data.sampled)
    stable = f"{percent(100 * joint.stable_share, 4)} give a stable loop"
    stable += f" (at least {percent(100 * numbers['stable_interval'][0], 4)} with 95 % confidence)"
    if not math.isfinite(joint.gamma_given):
        return f"of {joint.draws} whole responses drawn from the posterior {stable}"
    low, high = (percent(100 * value, 4) for value in numbers["held_interval"])
    return (
        f"of {joint.draws} whole responses drawn from the posterior {percent(100 * joint.coverage_given, 4)} "
        f"stay within the worst case of the {percent(100 * joint.given_level, 4)} ellipses ({low} to {high} "
        f"with 95 % confidence), and {stable}"
    )


def prefilter_sentence(data: RunData) -> str | None:
    """The prefilter in one sentence; None where none was asked for."""
    words = filter_words(data.reference_filter)
    if words is None:
        return None
    return words if data.reference_filter.filter is None else f"prefilter of {words}"


def order_blocks(data: RunData) -> list[Block]:
    """How far the order chosen is from what any controller could reach."""
    bracket = data.achievable.bracket
    gamma = data.synthesis.gamma if data.synthesis is not None and data.has_controller else None
    order = data.config.specification.controller_order
    words = achievable_words(data.achievable, gamma, order)
    if words is None:
        return []
    if bracket is None:
        return [Text(sentence(words))]
    rows = []
    if gamma is not None:
        rows.append((f"this controller, order {order}", number(gamma, 4), "on the grid of the design"))
    rows += [
        ("a controller of any order", number(bracket.ellipse, 4), "reached: such a controller is known"),
        ("no controller goes below", number(bracket.floor, 4), "lower bound, within the basis searched"),
    ]
    table = Table(
        ("who", "weighted worst case, gamma", "how it is known"),
        tuple(rows),
        "The yardstick: what is left to gain by a higher order, from a convex programme over all stabilising "
        "controllers (Youla). It knows the weights, but neither structure nor damping of the controller's "
        "own poles nor a delay margin, which may cost more.",
    )
    advice = None if gamma is None or gamma <= 1 else order_advice(data.achievable, gamma, order)
    return [
        heading("Against a controller of any order"),
        Text(sentence(_any_order(data, gamma, order) or words)),
        table,
        *maybe(() if advice is None else (sentence(advice),), "warning"),
    ]


def whole_blocks(data: RunData) -> list[Block]:
    """For how many whole responses the worst case holds."""
    words = joint_words(data.sampled)
    if words is None:
        return []
    joint = data.sampled.joint
    if joint is None:
        return [Text(sentence(words))]
    numbers = joint_numbers(data.sampled)
    low, high = (percent(100 * value, 4) for value in numbers["held_interval"])
    stable_low, stable_high = (percent(100 * value, 4) for value in numbers["stable_interval"])
    rows = (
        (
            f"worst case of the {percent(100 * joint.given_level, 4)} ellipses",
            number(joint.gamma_given, 4),
            f"{percent(100 * joint.coverage_given, 4)} ({low} to {high})",
        ),
        (
            f"worst case that holds for {percent(100 * joint.coverage, 4)}",
            number(joint.gamma, 4),
            f"{percent(100 * joint.coverage, 4)} (that of {percent(100 * joint.level, 4)} ellipses)",
        ),
        ("stable loop", "–", f"{percent(100 * joint.stable_share, 4)} ({stable_low} to {stable_high})"),
        (
            f"inside the {percent(100 * joint.given_level, 4)} ellipse at every frequency",
            "–",
            percent(100 * joint.simultaneous_given, 4),
        ),
    )
    table = Table(
        ("statement", "gamma", f"holds for, of {joint.draws} draws"),
        rows,
        "An ellipse holds at one frequency; these are whole responses drawn from the posterior, each through "
        "the closed loop. In brackets the 95 % interval of the share. A response may leave its ellipse where "
        "nothing is at stake.",
    )
    short = joint.level > joint.given_level and not data.sampled.calibrated
    return [
        heading("Whole responses"),
        *(maybe((sentence(words),), "warning") if short else (Text(sentence(_whole(data) or words)),)),
        table,
    ]


def _weight_words(data: RunData) -> str:
    settings = data.config.reference_filter
    weight = None if settings is None else settings.error_weight
    if weight is None:
        return "W = 1."
    shown = [", ".join(number(c, 4) for c in part) for part in (weight.numerator, weight.denominator)]
    return f"W(s) has the coefficients {shown[0]} over {shown[1]}, highest power of s first."


def prefilter_blocks(data: RunData) -> list[Block]:
    """The prefilter: what it buys in the worst case, and its state space."""
    words = prefilter_sentence(data)
    if words is None:
        return []
    found: Prefilter | None = data.reference_filter.filter
    if found is None:
        return [heading("Prefilter"), Remarks((sentence(words),), "warning")]
    table = Table(
        ("reference", "largest weighted model-matching error over the ellipses"),
        (
            ("as it is, F = 1", number(found.error_before, 4)),
            (f"through F, order {found.order}", number(found.error_after, 4)),
        ),
        f"Largest |W (F T - T_ref)| of any member at any of the checked frequencies; with F it lies at "
        f"{frequency(found.worst_rad_s)}. {_weight_words(data)} The feedback "
        "loop, and all that is certified of it, is the same.",
    )
    return [
        heading("Prefilter"),
        Text(sentence(words)),
        table,
        Code("Prefilter as JSON (state space, reference to filtered reference)", found.to_json()),
    ]
