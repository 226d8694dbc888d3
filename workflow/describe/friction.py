"""Dry friction: as it was identified, and what it does to the loop."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ident.friction import EquivalentFriction, FrictionFit
from workflow.describe.facts import Block, Picture, Remarks, Row, worded
from workflow.tasks.results import FrictionCheck, LoopCheck, SettlingRange, SlowSine
from workflow.text.formats import at_least, at_most, frequency, interval, number, percent, sentence, si
from workflow.text.sentences.friction import friction_law

if TYPE_CHECKING:
    from workflow.figures.subjects import RunView

# Median settling time beside the recorded loop's from which on the new loop counts as slower; chosen.
_SLOWER = 1.2


def friction_row(friction: FrictionFit, input_unit: str, output_unit: str) -> Row:
    """Law of the identified friction."""
    return worded("dry friction", friction_law(friction, input_unit, output_unit))


def amplitude_row(equivalent: EquivalentFriction | None, input_unit: str) -> Row | None:
    """At which amplitude ellipses with friction hold; None where they are about no amplitude."""
    if equivalent is None:
        return None
    return worded("ellipses", f"describe the dynamics with friction at {si(equivalent.rms, input_unit)} rms")


def friction_range(found: FrictionCheck, output_unit: str) -> str:
    """Over which sizes of the reference the certified peak of |S| is what friction leaves to be measured."""
    tolerance = percent(found.tolerance_percent)
    if not math.isfinite(found.certified_peak):
        holds = "no peak of |S| is certified, with friction or without"
    elif found.certified_from is None:
        holds = friction_exceeds(found, output_unit)
    else:
        holds = (
            f"with friction, the peak of |S| is predicted to be at most {tolerance} above the certified "
            f"{number(found.certified_peak, 4)} for references from {si(found.certified_from, output_unit)} "
            f"to {si(found.sizes[0], output_unit)} (rms)"
        )
    if found.linear_from is None:
        raised = found.low[0] * found.high[0] > found.nominal_peak**2
        linear = (
            f"That is an upper bound. The nominal peak without friction, {number(found.nominal_peak, 4)}, is "
            f"{'raised' if raised else 'lowered'} by friction by more than {tolerance}, even at the largest "
            "size"
        )
    elif found.linear_from > found.sizes[-1]:
        linear = (
            f"Below {si(found.linear_from, output_unit)} friction changes the peak by more than {tolerance}"
        )
    else:
        linear = (
            f"The linear prediction holds within {tolerance} down to {si(found.sizes[-1], output_unit)}, the "
            "smallest size simulated"
        )
    return f"{holds}. {linear}"


def friction_exceeds(found: FrictionCheck, output_unit: str) -> str:
    """Where friction may push the peak of |S| beyond the certified one at every size; "" elsewhere."""
    if not math.isfinite(found.certified_peak) or found.certified_from is not None:
        return ""
    return (
        f"with friction, the peak of |S| may exceed the certified {number(found.certified_peak, 4)} by more "
        f"than {percent(found.tolerance_percent)} even for references of {si(found.sizes[0], output_unit)} "
        "(rms), the largest size simulated"
    )


def sticking(found: FrictionCheck, output_unit: str) -> str:
    """From which size of a step on the arm moves at all; "" where it always does."""
    if found.sticking_step <= 0:
        return ""
    size = si(found.sticking_step, output_unit)
    return f"reference steps below {size} ({interval(found.sticking_interval)}) do not move the arm"


def stands_still(sine: SlowSine, output_unit: str, *, feedforward: bool) -> str:
    """Says that friction holds the arm on the slow sine; "" where it does not. feedforward: it is on."""
    if not sine.stands_still:
        return ""
    without, with_feedforward = sine.rms
    remedy = "friction_feedforward = true in [closed_loop]"
    if feedforward:
        remedy = "the feed-forward of this run"
    return (
        f"{'without feed-forward' if feedforward else 'with friction'} the arm stands still on a sine of "
        f"{si(sine.amplitude, output_unit)} at {frequency(sine.omega_rad_s)}, and follows it only from about "
        f"{si(sine.moves_from, output_unit)} on; {remedy} takes the rms error of this sine from "
        f"{si(without, output_unit)} to {si(with_feedforward, output_unit)}"
    )


def settling_range(found: SettlingRange) -> str:
    """Settling times over sizes of the step: "1.3 to 6.9 s"."""
    settled_s = found.settled_s
    if not settled_s:
        return f"over {si(found.watched_s, 's', 2)}"
    first = at_least(settled_s[0], 2)
    last = at_most(settled_s[-1], 2)
    if found.worst_s is None:
        return f"{first} to over {number(found.watched_s, 2)} s"
    return f"{first} s" if first == last else f"{first} to {last} s"


def settle(found: SettlingRange) -> str:
    """What steps of several sizes do: "settle to 2 % in 1.3 to 6.9 s"."""
    if found.settled_s:
        return f"settle to 2 % in {settling_range(found)}"
    return f"do not settle to 2 % in {si(found.watched_s, 's', 2)}"


def friction_step(found: FrictionCheck, output_unit: str) -> str:
    """What the identified friction does to the reference step."""
    return (
        f"steps of half to twice the size {settle(found.settling)}; the error of this one stays within "
        f"{si(found.left, output_unit)} after {si(found.watched_s / 2, 's')}"
    )


def beside_recorded(found: FrictionCheck, output_unit: str) -> str:
    """What the loop that made the logs did, beside the new one; "" where the logs do not tell it."""
    if found.recorded is None or found.recorded_settling is None:
        return ""
    measured, simulated, new = (si(error, output_unit) for error in found.errors[:3])
    return (
        f"steps of half to twice the size {settle(found.recorded_settling)} with the controller that made "
        f"the logs; with this one they {settle(found.settling)} (both simulated with the identified "
        f"friction). On the reference of the first log its rms error was {measured} ({simulated} simulated); "
        f"this one leaves {new}"
    )


def waits(check: LoopCheck) -> str:
    """Says that friction lets the step settle later than the recorded loop, or much later than the linear
    one; "" where it does neither."""
    friction = check.friction
    if friction is None:
        return ""
    if friction.times_slower > _SLOWER:
        said_of = "slower than the recorded loop with friction"
        if math.isfinite(friction.times_slower):
            said_of += f": {number(friction.times_slower, 2)} times"
        return said_of
    return "friction holds the step back" if check.waits_for_friction else ""


def friction_blocks(check: LoopCheck, view: RunView) -> list[Block]:
    """What the identified friction does to the loop, for a page; nothing where none was identified."""
    friction = check.friction
    if friction is None:
        return []
    unit = view.output_unit
    sizes = friction_range(friction, unit)
    all_inside = True
    if friction.measured is not None:
        all_inside = friction.inside == len(friction.sizes)
        of_all = f"{friction.inside} of {len(friction.sizes)}"
        sizes += f". {of_all} peaks measured on the arm lie in their predicted intervals"
    stands = "Every step moves the arm in the end: the integral action raises the command"
    stuck = sticking(friction, unit)
    if stuck:
        deflection = si(friction.presliding, unit)
        until = "until the command settles"
        stands = f"{stuck}: the shaft stays within its pre-sliding deflection ({deflection}) {until}"
    stands += f". With friction {friction_step(friction, unit)}"
    level = f"{si(friction.level, view.input_unit, 4)} ({interval(friction.level_interval)})"
    at_rest = f"Friction at standstill: {level}"
    if friction.error_at_rest > 0:
        error = si(friction.error_at_rest, unit)
        at_rest = (
            f"Friction of {level} at standstill leaves at most {error} of error at rest "
            f"({interval(friction.error_interval)})"
        )
        if check.tracking and friction.measured is not None:
            left = max(abs(row.steady_error) for row in check.achieved)
            at_rest += f"; the runs ended with {si(left, unit)} at most"
    items = tuple(sentence(text) for text in (sizes, stands, at_rest, _feedforward(friction, view)))
    return [
        Remarks(items, "good" if all_inside else "warning"),
        Picture(
            "friction-in-the-loop",
            "Left: peak of |S| by size of the reference. Right: error on that sine.",
            (view,),
        ),
    ]


def _feedforward(found: FrictionCheck, view: RunView) -> str:
    """What friction feed-forward does to the error on a slow sine."""
    unit = view.output_unit
    sine = found.tracking
    without, with_feedforward = sine.rms
    state = "off: friction_feedforward = true in [closed_loop]"
    if view.config.closed_loop.friction_feedforward:
        state = "on"
    certificate = view.results.certify.certificate
    plants = () if certificate is None else certificate.plants
    bandwidth = min((plant.bandwidth_rad_s for plant in plants), default=0.0)
    times = ""
    if bandwidth > 0:
        times = f", {number(sine.omega_rad_s / bandwidth, 2)} times the certified bandwidth"
    stands = ": on this one it stands still without feed-forward" if sine.stands_still else ""
    return (
        f"Friction feed-forward ({state}) takes the rms error on a sine ({si(sine.amplitude, unit)} at "
        f"{frequency(sine.omega_rad_s)}{times}) from {si(without, unit)} to {si(with_feedforward, unit)} "
        f"({si(sine.linear_rms, unit)} without friction and noise). At this frequency sines from about "
        f"{si(sine.moves_from, unit)} on move the arm{stands}"
    )
