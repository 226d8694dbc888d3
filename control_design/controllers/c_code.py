"""The controller as C99 source: the same state-space loop, limits and anti-windup where it has any."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

if TYPE_CHECKING:
    from control_design.controllers.controller import Controller
    from control_design.plants.ellipses import Real

Number = Literal["double", "float"]
_NO_LIMIT = 3e38  # written for an actuator without a limit beside others that have one; fits a float


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
    return _filled(
        "controller.h.in",
        controller,
        about=_ascii(controller.name),
        delay=controller.computational_delay_samples,
        dt_s=repr(controller.dt_s),
        guard=f"{prefix.upper()}_H",
        name=prefix,
        number=number,
        signals=_ascii(controller.signals),
    )


def _ascii(text: str) -> str:
    """As it may stand in a comment."""
    return re.sub(r"[^ -~]|\*/", "?", text)


def c_source(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """A self-contained C99 translation unit (it repeats the declarations of `c_header`).

    controller : Controller
    prefix : str. Start of every name, a C identifier.
    number : "double" or "float". Type of states, coefficients and arithmetic.

    `<prefix>_step(&state, error)` returns the command for the error at this sample. One call every `dt_s`;
    order n costs (n + 1)^2 multiplications. A controller with limits has them and the anti-windup in
    the code, and its state keeps in `limited` whether one was active. A controller of Y errors and U commands
    has `<prefix>_step(&state, error, command)` with arrays of these lengths. With a friction feed-forward it
    is `<prefix>_step(&state, error, reference)`.

    Raises ValueError if the prefix is no C identifier, or the number is neither.

    Same law and same order of operations as `ControllerStepper`: x+ = A x + B e + M (u_limited - u). In
    `double` the two differ by the rounding of sums only. The computational delay is not in the code: a
    real-time loop that writes its command one sample later has it by itself.

    No fixed point: word lengths that keep the certificate depend on the scaling on the processor. An error
    that is not finite gives a command that is not finite: check the sensor before the call.

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

    values = {"f": suffix}
    if (given := controller.feedforward) is not None:
        values |= {
            "level": literal(given.level),
            "turn": literal(given.turn(controller.dt_s)),
            "share": literal(given.share(controller.dt_s)),
            "excess": literal(given.excess),
            "fall": literal(given.fall * controller.dt_s),
        }
    one = controller.D.size == 1

    def table(matrix: Real) -> str:
        return ",\n    ".join(vector(row) for row in matrix) or vector(np.zeros(matrix.shape[1]))

    def limits(name: str, factor: float) -> str:
        most = np.minimum(factor * controller.limits(name), _NO_LIMIT)
        return literal(float(most[0])) if one else vector(most)

    if controller.input_limit is not None:
        values["input_limit"] = limits("input_limit", 1.0)
    if controller.rate_limit is not None:
        values["largest_change"] = limits("rate_limit", controller.dt_s)
    return _filled(
        "controller.c.in",
        controller,
        header=c_header(controller, prefix, number),
        A=table(controller.A) if controller.order else vector(controller.C[0]),
        B=vector(controller.B[:, 0]) if one else table(controller.B),
        C=vector(controller.C[0]) if one else table(controller.C),
        D=literal(float(controller.D[0, 0])) if one else table(controller.D),
        M=vector(controller.anti_windup_gain[:, 0]) if one else table(controller.anti_windup_gain),
        name=prefix,
        number=number,
        **values,
    )


def _filled(template: str, controller: Controller, **values: object) -> str:
    """A template with its values. A line that begins with `@what:` is for controllers that have it (`!what`:
    that have it not; several with commas: all of them)."""
    given = controller.feedforward
    has = {
        "input_limit": controller.input_limit is not None,
        "rate_limit": controller.rate_limit is not None,
        "limits": controller.input_limit is not None or controller.rate_limit is not None,
        "friction": given is not None,
        "breakaway": given is not None and given.excess > 0,
        "matrix": controller.D.size > 1,
        "signals": bool(controller.signals),
    }
    lines = []
    for line in _template(template):
        tags, _, text = line[1:].partition(":") if line.startswith("@") else ("", "", line)
        if all(has[tag.lstrip("!")] is not tag.startswith("!") for tag in tags.split(",") if tag):
            lines.append(text)
    # C has no arrays of length zero.
    commands, errors = controller.D.shape
    shape = {
        "order": controller.order,
        "size": max(controller.order, 1),
        "commands": commands,
        "errors": errors,
    }
    return Template("".join(lines)).substitute(values, **shape)


@cache
def _template(name: str) -> tuple[str, ...]:
    text = (files("control_design.controllers") / name).read_text("ascii")
    return tuple(text.splitlines(keepends=True))
