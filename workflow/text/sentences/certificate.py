"""What a certificate says, what it stands on, and what it leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from workflow.text.formats import at_most, bound, frequency, hertz, number, si

if TYPE_CHECKING:
    from control_design.analysis.certificate import Certificate, PlantVerdict
    from control_design.analysis.limited_loop import LimitedLoop
    from control_design.specification.requirement import SpecificationItem

# Relative difference of two frequencies up to which a pole pair of the nominal plant is an identified mode.
_SAME_MODE = 0.1

# Why nothing is said of a loop at its controller's limits, by the name of the obstacle.
LIMITED_OBSTACLES = {
    "LOOP_UNSTABLE": "the nominal loop is unstable",
    "PLANT_UNSTABLE": "the plant is unstable, no controller with a limit follows every step",
    "TOO_SLOW": "it settles too slowly to be simulated",
    "ALGEBRAIC": "the plant answers in the same sample",
    "ENDS_UNKNOWN": "the command has no end under a constant error",
}

# Why nothing is proved between the frequencies of a grid, by the name of the obstacle.
NOT_PROVED = {
    "OWN_FREQUENCIES": "the uncertainty is known on its own frequencies only",
    "OWN_PERFORMANCE_FREQUENCIES": "the performance channel is known on its own frequencies only",
    "NO_DERIVATIVES": "the uncertainty does not say how it changes between frequencies",
    "INEXACT": "zeros and poles do not reproduce the responses (relative difference)",
    "NOT_STABLE": "the loop is not robustly stable on the dense grid",
    "NO_DISTANCE": "no positive distance from -1 could be shown at one frequency (rad/s)",
    "WINDING": "1 + K c does not wind as a stable loop's",
}

# Of a controller that is only scaled, until its design is there.
LIMITS_NOT_LOOKED_AT = "nothing is said before the design ends"


def met(item: SpecificationItem) -> str:
    """Whether a requirement is met."""
    words = "met" if item.met else "NOT met"
    return (
        f"{words} (enough on the grid, but not proved for all frequencies)" if item.only_unproved else words
    )


def item_value(item: SpecificationItem) -> str:
    """Number of a requirement beside the one required, and where: "0.41 against 0.5 at 12 rad/s (1.9 Hz)"."""
    words = f"{bound(item.achieved, item.at_least)} against {si(item.required, item.unit, 4)}"
    return words if item.omega_rad_s is None else f"{words} at {frequency(item.omega_rad_s, 4)}"


def requirement(item: SpecificationItem) -> str:
    """A requirement on a plant: "hub: modulus margin: 0.41 against 0.5 at 12 rad/s (1.9 Hz): NOT met"."""
    words = f"{item.plant}: {item.requirement}: {item_value(item)}"
    if item.met and item.bound is not None:
        words += f" ({bound(item.bound, item.at_least)} proved for all frequencies)"
    return f"{words}: {met(item)}"


def certificate_reason(certificate: Certificate) -> str:
    """Why a certificate holds or does not."""
    doubts = []
    for verdict in certificate.plants:
        if verdict.stable:
            continue
        doubt = f"{verdict.plant}: nominal closed loop unstable"
        if verdict.own_grid_rad_s and verdict.nyquist.matches:
            doubt += (
                ", though its measured points alone encircle -1 as a stable loop does: the fitted poles lie "
                "between or outside them"
            )
        doubts.append(doubt)
    doubts += [requirement(item) for item in certificate.items if not item.met]
    if doubts:
        return "; ".join(doubts)
    return "every item is met" if certificate.certified else "an ellipse reaches -1"


def grounds(certificate: Certificate) -> str:
    """What the items that are met stand on: "4 for every plant in the set, proved for all frequencies"."""
    items = [item for item in certificate.items if item.met]
    worst = [item for item in items if item.about == "worst case"]
    by_ground = {
        "for every plant in the set, proved for all frequencies": [item for item in worst if item.proved],
        "for every plant in the set, on a dense grid of frequencies": [
            item for item in worst if not item.proved
        ],
        "for the nominal loop only": [item for item in items if item.about == "nominal loop"],
        "for the controller alone": [item for item in items if item.about == "controller"],
        "for sampled responses": [item for item in items if item.about == "sampled responses"],
    }
    counted = [f"{len(on_ground)} {ground}" for ground, on_ground in by_ground.items() if on_ground]
    return "; ".join(counted)


def limited_loops(certificate: Certificate) -> str:
    """What a certificate says of the loop at the limits of its controller, in one line."""
    loops = certificate.limited
    if loops is None:
        return "nothing is said: this certificate is of a version that did not look"
    if not loops:
        return "nothing is said: the controller has no input_limit and no rate_limit"
    parts = [
        f"{loop.plant}: does NOT end where it must ({at_most(100 * loop.worst, 3)} % away)"
        for loop in loops
        if not loop.ends
    ]
    good = [loop.plant for loop in loops if loop.steps and loop.ends]
    if good:
        parts.append(
            f"{', '.join(good)}: constant errors and steps beyond the limit end where they must (simulated)"
        )
    for loop in loops:
        if loop.obstacle is not None:
            parts.append(f"{loop.plant}: nothing is said: {LIMITED_OBSTACLES[loop.obstacle.name]}")
    for loop in loops:
        if not loop.steps and loop.obstacle is None:
            parts.append(f"{loop.plant}: nothing is said: no step within reach meets the limit")
    return "; ".join(parts)


def damping_lost(certificate: Certificate, modes_rad_s: Sequence[float] | None = None) -> str:
    """Which modes a stable loop damps less than nothing does, each once, where it loses most; "" for none.

    Args:
        certificate: Several plants are called by their names.
        modes_rad_s: Frequencies of those that were identified; others of the nominal plant describe what no
            mode explains, and are passed over. None: all of the plant count.
    """
    lost: dict[str, str] = {}
    least_share: dict[str, float] = {}
    for plant in certificate.plants:
        if not plant.stable:
            continue
        for change in plant.mode_changes:
            if not change.loses_damping:
                continue
            before = change.open_loop
            after = change.closed_loop
            place = number(hertz(before.omega_rad_s))
            is_mode = modes_rad_s is None or any(
                abs(mode / before.omega_rad_s - 1) < _SAME_MODE for mode in modes_rad_s
            )
            damping_before = number(before.zeta, 2)
            damping_after = number(after.zeta, 2)
            # A loss that does not show in two digits is none that a reader could see.
            if not is_mode or damping_before == damping_after:
                continue
            left = after.zeta / before.zeta
            if left < least_share.get(place, 1):
                least_share[place] = left
                name = f"{plant.plant}: " if len(certificate.plants) > 1 else ""
                lost[place] = (
                    f"{name}the mode at {place} Hz loses damping: {damping_before} in open loop, "
                    f"{damping_after} in closed loop"
                )
    return "; ".join(lost.values())


def checked(certificate: Certificate) -> list[str]:
    """What a certificate stands on, a sentence a plant."""
    sentences = []
    for plant in certificate.plants:
        words = (
            f"{plant.plant}: nominal poles, encirclements of -1, and every ellipse at {plant.frequencies} "
            "frequencies"
        )
        if plant.all_frequencies.proved:
            words += f"; proved in the {plant.all_frequencies.intervals} intervals between them"
            if plant.assumed_linear:
                words += ", on straight lines between its own frequencies"
        sentences.append(words)
    return sentences


def not_checked(certificate: Certificate, *, sampled: bool, friction: bool = False) -> list[str]:
    """What a certificate of one loop leaves open, a sentence each.

    Args:
        certificate: Of one loop.
        sampled: Whether posterior samples were drawn in a step of their own.
        friction: Whether the loop was looked at with it.
    """
    left = [_not_proved(plant) for plant in certificate.plants]
    if sampled:
        left.append("all frequencies together: checked on models drawn from the posterior, not certified")
    elif certificate.joint is None:
        left.append("all frequencies together: the ellipses hold at their level at each frequency by itself")
    if friction:
        left.append(
            "nonlinear effects other than Coulomb friction (quantisation, backlash), and plants outside the "
            "uncertainty set"
        )
    else:
        left.append(
            "nonlinear effects (friction, quantisation, backlash) and plants outside the uncertainty set"
        )
    if not certificate.limited:
        left.append(f"the command at a limit: {limited_loops(certificate)}")
    else:
        left.append(
            "the command at its limits, other than steps and constant errors from rest on the nominal plants"
        )
        left += [
            f"{loop.plant} at the limits of the command: {why}"
            for loop, why in unknown_at_limits(certificate.limited)
        ]
    for resonance in certificate.resonances:
        left.append(
            f"the controller has a pole pair at {frequency(resonance.mode.omega_rad_s, 4)} with a damping "
            f"ratio of {number(resonance.mode.zeta, 2)}, where |K| = {at_most(resonance.gain)}: the plant's "
            "response there has to be as it is taken to be; controller_damping = 0.1 in the specification "
            "forbids such poles"
        )
    left.append("that the true plant has as many unstable poles and integrators as the nominal")
    for plant in certificate.plants:
        left += _not_known(plant)
    return left


def unknown_at_limits(loops: Sequence[LimitedLoop]) -> list[tuple[LimitedLoop, str]]:
    """Loops of which nothing is said, with the reason."""
    return [(loop, LIMITED_OBSTACLES[loop.obstacle.name]) for loop in loops if loop.obstacle is not None]


def _not_proved(plant: PlantVerdict) -> str:
    proof = plant.all_frequencies
    if proof.proved or proof.obstacle is None:
        return (
            f"{plant.plant}: rounding errors of double precision; gain, phase and delay margins are searched "
            "between grid points, not proved"
        )
    place = "" if proof.obstacle_at is None else f": {number(proof.obstacle_at)}"
    return f"{plant.plant}: between grid points: not proved: {NOT_PROVED[proof.obstacle.name]}{place}"


def _not_known(plant: PlantVerdict) -> list[str]:
    """What is not known of the uncertainty of a plant."""
    left = []
    if plant.own_grid_rad_s is not None:
        between = "a straight line is assumed" if plant.assumed_linear else "nothing is known"
        low, high = plant.own_grid_rad_s
        left.append(
            f"{plant.plant}: the uncertainty is known on its own grid only; between its points {between}, "
            f"and below {low:.4g} and above {high:.4g} rad/s the nominal alone was used, without uncertainty"
        )
    elif not plant.stated:
        left.append(f"{plant.plant}: no uncertainty was given; only the nominal plant was checked")
    if plant.own_performance:
        left.append(
            f"{plant.plant}: the uncertainties of the measured and the performance channel are taken as "
            "independent"
        )
    return left
