"""Identified dry friction, and what a certificate over the ellipses is about."""

from __future__ import annotations

from typing import TYPE_CHECKING

from workflow.text.formats import number, si

if TYPE_CHECKING:
    from ident.friction import EquivalentFriction, FrictionFit


def friction_law(friction: FrictionFit, input_unit: str, output_unit: str) -> str:
    """Law of the friction that was identified."""
    words = (
        f"Coulomb friction worth {si(friction.level, input_unit)} at the input (standard deviation "
        f"{si(friction.level_std, input_unit)}"
    )
    if not friction.significant:
        words += ", not significant in these records"
    words += ")"
    law = friction.law
    if law.excess > 0:
        fades = f"{number(law.fall)} units of position per second"
        if output_unit:
            fades = si(law.fall, f"{output_unit}/s")
        words += f", and {si(law.excess, input_unit)} more to break away (Stribeck, fading above {fades})"
    if friction.lag:
        lag_s = friction.lag * friction.arm.dt_s
        words += f". The command reaches the shaft through a drive that lags by {si(lag_s, 's', 2)}"
    return words


def certified_for(response: str, equivalent: EquivalentFriction | None, input_unit: str) -> str:
    """What a certificate over the ellipses is about.

    Args:
        response: Which response the ellipses describe (`UncertaintyOptions.response`).
        equivalent: Viscous friction that acts like the dry one, where they are about an amplitude.
        input_unit: "" where nobody stated it.
    """
    if response in ("without friction", "without remote friction"):
        return "the linear dynamics without friction"
    if response == "as recorded" or equivalent is None:
        return "linear dynamics at the recorded amplitudes"
    rms = si(equivalent.rms, input_unit)
    return f"the dynamics with friction (best linear approximation) at an rms of {rms} at the input"
