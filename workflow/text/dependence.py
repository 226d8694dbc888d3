"""What an error depends on, in words: of a finding of `diagnosis.where.dependence` as plain values.

A page, a picture and the terminal say it alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.text.formats import portion, si
from workflow.text.names import stated_name

# A `diagnosis.where.dependence.Dependence` as plain values.
Finding = Mapping[str, Any]

# Units of a torque, as logs and models spell them.
_TORQUES = ("N m", "Nm")
# Units of a force, as logs and models spell them.
_FORCES = ("N",)
# A force per motion in the unit that its parameter has in data sheets.
_USUAL_UNITS = {
    "N m/(rad/s)": "N m s/rad",
    "N/(m/s)": "N s/m",
    "N m/(rad/s²)": "kg m²",
    "N/(m/s²)": "kg",
}
# Share that a constant force explains from which on it is said beside that of the curve. Chosen, as the least
# share of a dependence.
_LEAST_CONSTANT = 0.1
# Quantities of a joint's motion; others are the time, a command or a column beside them.
_MOTIONS = ("position", "speed", "acceleration")


def variable_words(finding: Finding) -> str:
    """The variable: "the angle of elbow", "the speed of hub", "the time", "load"."""
    quantity = finding["quantity"]
    of = stated_name(finding["of"])
    unit = finding.get("unit", "")
    if quantity == "time":
        return "the time since the start"
    if quantity == "command":
        return f"the command {of}"
    if quantity not in _MOTIONS:
        return of
    # "hub angle" is the angle of hub; "angle" alone is that of the only body.
    words = of.split()
    names_motion = words[-1:] in (["angle"], ["position"], ["speed"])
    moving = " ".join(words[:-1] if names_motion else words)
    # Speed and acceleration are of the thing that moves: "the speed of hub", not of "hub angle".
    if quantity != "position":
        return f"the {quantity} of {moving}" if moving else f"the {quantity}"
    if (names_motion and words[-1] != "speed") or of.endswith("deflection"):
        return f"the {of}"
    if not moving:
        return "the way since the start"
    return f"the angle of {moving}" if unit == "rad" else f"the position of {moving}"


def missing_words(finding: Finding) -> str:
    """What depends on it: "missing torque at elbow", "error of the reading of tip"."""
    place = stated_name(finding["place"])
    unit = finding["value_unit"]
    if finding["acts"] == "reading":
        return f"error of the reading of {place}"
    if unit in _TORQUES:
        return "missing torque" if place == "torque" else f"missing torque at {place}"
    if unit in _FORCES:
        return "missing force" if place == "force" else f"missing force at {place}"
    return f"missing part of the command {place}"


def nature_words(finding: Finding) -> str:
    """What kind of force it is: "a spring of 7.8 N m/rad", "dry friction of 0.2 N m", else two points."""
    value_unit = finding["value_unit"].replace("Nm", "N m")
    slope = finding["slope"]
    # A curve that is neither a line nor a jump has no size of its own.
    if slope is None:
        return _points(finding, value_unit)
    if finding["shape"] == "jump":
        height = si(abs(slope), value_unit)
        return f"dry friction of {height}" if _resists(finding) else f"changes sign with it, by {height}"

    unit = finding["unit"]
    slope_unit = f"{value_unit}/({unit})" if "/" in unit else f"{value_unit}/{unit}"
    size = si(abs(slope), _USUAL_UNITS.get(slope_unit, slope_unit).strip("/"))
    if _resists(finding):
        kinds = {"position": "a spring", "speed": "viscous friction", "acceleration": "more inertia"}
        return f"{kinds[finding['quantity']]} of {size}"
    # A force with the motion is less of what the model has; with the position it is no part of any model.
    if finding["acts"] == "force" and finding["own"] and finding["quantity"] == "speed":
        return f"less friction, by {size}"
    if finding["acts"] == "force" and finding["own"] and finding["quantity"] == "acceleration":
        return f"less inertia, by {size}"
    return f"{'grows' if slope > 0 else 'falls'} by {size}"


def _resists(finding: Finding) -> bool:
    """Whether a force is against the motion of its own joint."""
    of_own_motion = finding["own"] and finding["quantity"] in _MOTIONS
    return bool(finding["acts"] == "force" and of_own_motion and finding["slope"] < 0)


def _points(finding: Finding, value_unit: str) -> str:
    """The largest and the smallest value of the curve, where they are."""
    nodes = sorted(zip(finding["values"], finding["centres"], strict=True))
    low, at_low = nodes[0]
    high, at_high = nodes[-1]
    unit = finding["unit"]
    return f"{si(low, value_unit)} at {si(at_low, unit)}, {si(high, value_unit)} at {si(at_high, unit)}"


def dependence_words(finding: Finding) -> str:
    """The finding in one sentence without its full stop.

    Parameters
    ----------
    finding : mapping
        A `Dependence` as plain values.

    Returns
    -------
    str
        "the error depends on the angle of elbow: a missing torque at elbow explains 55 % of it on logs not
        used to draw its curve; a spring of 7.8 N m/rad".
    """
    unused = "logs" if finding["judged_on"] == "logs" else "blocks of the log"
    begins = "beside that, the error depends" if finding["beside"] else "the error depends"
    of_constant = ""
    if finding["constant_share"] >= _LEAST_CONSTANT:
        of_constant = f" (what is constant in it alone: {portion(finding['constant_share'])})"
    what = missing_words(finding)
    article = "an" if what.startswith("error") else "a"
    return (
        f"{begins} on {variable_words(finding)}: {article} {what} that depends on it explains "
        f"{portion(finding['share'])} of the error on {unused} not used to draw the curve{of_constant}; "
        f"{nature_words(finding)}"
    )


def alternatives_words(finding: Finding) -> str:
    """Other variables that explain as much, "" where there is none."""
    rivals = [
        f"{variable_words(rival)} ({portion(rival['share'])}, at {stated_name(rival['place'])})"
        for rival in finding["also"]
    ]
    return f"as much within its uncertainty: {', '.join(rivals)}" if rivals else ""


def dependence_line(finding: Finding) -> str:
    """The finding in a line of the terminal: "the angle of elbow: missing torque at elbow, 55 % of the error
    on logs not used; a spring of 7.8 N m/rad"."""
    unused = "logs" if finding["judged_on"] == "logs" else "blocks"
    return (
        f"{variable_words(finding)}: {missing_words(finding)}, {portion(finding['share'])} of the error on "
        f"{unused} not used; {nature_words(finding)}"
    )


def dependence_short(finding: Finding) -> str:
    """The finding in a few words: "55 % depends on the angle of elbow (a spring of 7.8 N m/rad)"."""
    return f"{portion(finding['share'])} depends on {variable_words(finding)} ({nature_words(finding)})"
