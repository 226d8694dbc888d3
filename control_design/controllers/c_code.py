"""The controller as C99 source: the same state-space loop with limits and anti-windup, no heap."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from string import Template
from typing import Any, Literal

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real

Number = Literal["double", "float"]


def c_header(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """Declarations to include: the state, `<prefix>_reset` and `<prefix>_step`.

    Raises ValueError if names that start with the prefix are no C identifiers.
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix):
        raise ValueError(f"prefix must be a C identifier; got {prefix!r}")
    return _template("controller.h.in").substitute(
        about=re.sub(r"[^ -~]|\*/", "?", controller.name),
        delay=controller.computational_delay_samples,
        dt_s=repr(controller.dt_s),
        guard=f"{prefix.upper()}_H",
        **_names(controller, prefix, number),
    )


def c_source(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """A self-contained C99 translation unit (it repeats the declarations of `c_header`).

    controller : Controller
    prefix : str. Start of every name, a C identifier.
    number : "double" or "float". Type of states, coefficients and arithmetic.

    `<prefix>_step(&state, error)` returns the limited command for the error at this sample; the state keeps
    whether a limit was active. One call every `dt_s`; order n costs (n + 1)^2 multiplications. With a
    friction feed-forward it is `<prefix>_step(&state, error, reference)`.

    Raises ValueError if the prefix is no C identifier.

    Same law and same order of operations as `ControllerStepper`: x+ = A x + B e + M (u_limited - u). In
    `double` the two differ by the rounding of sums only. The computational delay is not in the code: a
    real-time loop that writes its command one sample later has it by itself. Not covered: fixed point, and an
    error that is not finite (the command then is not finite either: check the sensor before the call).
    """
    assert controller.anti_windup_gain is not None
    suffix = "f" if number == "float" else ""

    def literal(value: float) -> str:
        # The shortest decimal that reads back as the same double.
        text = repr(float(value))
        return text + suffix if any(mark in text for mark in ".e") else f"{text}.0{suffix}"

    def vector(values: Real) -> str:
        return "{" + ", ".join(literal(value) for value in (values if values.size else [0.0])) + "}"

    constants, limits, strength, given = "", "", "LEVEL", controller.feedforward
    if given is not None:
        named = {
            "LEVEL": given.level,
            "TURN": given.turn(controller.dt_s),
            "SHARE": given.share(controller.dt_s),
        }
        if given.excess > 0:
            named |= {"EXCESS": given.excess, "FALL": given.fall * controller.dt_s}
            strength = f"(LEVEL + EXCESS * exp{suffix}(-fabs{suffix}(moved) / FALL))"
            constants = "#include <math.h>\n"
        constants += "".join(
            f"static const {number} {name} = {literal(value)};\n" for name, value in named.items()
        )
    if controller.input_limit is not None:
        constants += f"static const {number} INPUT_LIMIT = {literal(controller.input_limit)};\n"
        limits = _template("input_limit.c.in").template
    if controller.rate_limit is not None:
        change = literal(controller.rate_limit * controller.dt_s)
        constants += f"static const {number} LARGEST_CHANGE = {change};  /* rate_limit * dt_s */\n"
        limits = _template("rate_limit.c.in").template + limits
    return _template("controller.c.in").substitute(
        header=c_header(controller, prefix, number),
        A=",\n    ".join(vector(row) for row in controller.A) or vector(controller.C[0]),
        B=vector(controller.B[:, 0]),
        C=vector(controller.C[0]),
        D=literal(float(controller.D[0, 0])),
        M=vector(controller.anti_windup_gain[:, 0]),
        constants=constants,
        limits=limits,
        feedforward=""
        if given is None
        else _template("feedforward.c.in").substitute(number=number, strength=strength),
        at_rest="" if given is None else "    state->reference = state->smoothed = 0;\n",
        **_names(controller, prefix, number),
    )


def _names(controller: Controller, prefix: str, number: Number) -> dict[str, Any]:
    given = controller.feedforward is not None
    return {
        "name": prefix,
        "number": number,
        "order": controller.order,
        # C has no arrays of length zero.
        "size": max(controller.order, 1),
        "reference": f", {number} reference" if given else "",
        "friction": " + friction feed-forward" if given else "",
        "moving": f"    {number} reference, smoothed;  /* previous one, friction at its speed */\n"
        if given
        else "",
    }


@cache
def _template(name: str) -> Template:
    return Template((files("control_design.controllers") / name).read_text("ascii"))
