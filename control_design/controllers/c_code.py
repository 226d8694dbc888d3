"""The controller as C99 source: the same state-space loop, limits and anti-windup where it has any."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any, Literal, get_args

if TYPE_CHECKING:
    from control_design.controllers.controller import Controller
    from control_design.plants.ellipses import Real

Number = Literal["double", "float"]


@dataclass(frozen=True)
class Dialect:
    """How C code is written: what its names begin with, a C identifier, and the type of its numbers."""

    prefix: str = "controller"
    number: Number = "double"

    def __post_init__(self) -> None:
        if self.number not in get_args(Number):
            raise ValueError(f"number must be 'double' or 'float'; got {self.number!r:.80}")
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", self.prefix):
            raise ValueError(f"prefix must be a C identifier; got {self.prefix!r:.80}")

    def beside(self, name: str) -> Dialect:
        """That of a second piece of code in the same program."""
        return Dialect(name if self.prefix == "controller" else f"{self.prefix}_{name}", self.number)


def c_header(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """Declarations to include: the state, `<prefix>_reset` and `<prefix>_step`. Raises ValueError."""
    Dialect(prefix, number)
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

    `<prefix>_step(&state, error)` returns the command for the error at this sample. One call every `dt_s`;
    order n costs (n + 1)^2 multiplications. A controller with limits has them and the anti-windup in
    the code, and its state keeps in `limited` whether one was active. With a friction feed-forward it is
    `<prefix>_step(&state, error, reference)`.

    Raises ValueError if the prefix is no C identifier, or the number is neither.

    Same law and same order of operations as `ControllerStepper`: x+ = A x + B e + M (u_limited - u). In
    `double` the two differ by the rounding of sums only. The computational delay is not in the code: a
    real-time loop that writes its command one sample later has it by itself.

    Left out on purpose: fixed point. Which word lengths hold the certificate depends on the scaling of states
    and signals of the one processor, which nothing here knows. Not covered: an error that is not finite (the
    command then is not finite either: check the sensor before the call).

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01, input_limit=24.0)
    >>> code = flexlink.c_source(given, prefix="hub", number="float")
    >>> "float hub_step(hub_state *state, float error)" in code, "INPUT_LIMIT = 24.0f" in code
    (True, True)
    """
    assert controller.anti_windup_gain is not None
    suffix = "f" if number == "float" else ""

    def literal(value: float) -> str:
        # The shortest decimal that reads back as the same double.
        text = repr(float(value))
        return text + suffix if any(mark in text for mark in ".e") else f"{text}.0{suffix}"

    def vector(values: Real) -> str:
        return "{" + ", ".join(literal(value) for value in (values if values.size else [0.0])) + "}"

    constants, limits, kept, strength, given = "", "", "", "LEVEL", controller.feedforward
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
        limits, kept = _template("rate_limit.c.in").template + limits, "    state->last = command;\n"
    limited = _limited(controller)
    if limited:
        constants += f"static const {number} M[{max(controller.order, 1)}] = "
        constants += f"{vector(controller.anti_windup_gain[:, 0])};\n"
        limits += "    state->limited = command != wanted;\n"
    at_rest = ["limited"] * limited + ["last"] * bool(kept) + ["reference", "smoothed"] * (given is not None)
    return _template("controller.c.in").substitute(
        header=c_header(controller, prefix, number),
        A=",\n    ".join(vector(row) for row in controller.A) or vector(controller.C[0]),
        B=vector(controller.B[:, 0]),
        C=vector(controller.C[0]),
        D=literal(float(controller.D[0, 0])),
        constants=constants,
        limits=limits,
        feedforward=""
        if given is None
        else _template("feedforward.c.in").substitute(number=number, strength=strength),
        at_rest="".join(f"    state->{name} = 0;\n" for name in at_rest),
        back=" + M[i] * (command - wanted)" if limited else "",
        kept=kept,
        **_names(controller, prefix, number),
    )


def _limited(controller: Controller) -> bool:
    return controller.input_limit is not None or controller.rate_limit is not None


def _names(controller: Controller, prefix: str, number: Number) -> dict[str, Any]:
    given, limited = controller.feedforward is not None, _limited(controller)
    more = f"    {number} last;  /* previous command */\n" * (controller.rate_limit is not None)
    more += f"    {number} reference, smoothed;  /* previous one, friction at its speed */\n" * given
    more += "    int limited;  /* 1 while a limit was active in the last call */\n" * limited
    command = "u = C x + D e" + " + friction feed-forward" * given
    law = f"{command}; x+ = A x + B e"
    if limited:
        law = f"{command} limited; x+ = A x + B e + M (u_limited - u)"
    return {
        "name": prefix,
        "number": number,
        "order": controller.order,
        # C has no arrays of length zero.
        "size": max(controller.order, 1),
        "reference": f", {number} reference" if given else "",
        "law": law,
        "more": more,
    }


@cache
def _template(name: str) -> Template:
    return Template((files("control_design.controllers") / name).read_text("ascii"))
