"""The controller as C99 source: the same state-space loop, limits and anti-windup where it has any."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from control_design.controllers.law import in_sections

if TYPE_CHECKING:
    from control_design.controllers.controller import Controller
    from control_design.plants.ellipses import Real

Number = Literal["double", "float"]
_ROUNDED = 0.01  # of the response: more than this, 0.1 dB, single precision must not change it
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

    Raises ValueError if the prefix is no C identifier, the number is neither, or does not hold the law.

    Same law and same order of operations as `ControllerStepper`: x+ = A x + B e + M (u_limited - u). In
    `double` the two differ by the rounding of sums only; `float` may have other states: see `law_in`. The
    code is `K_without_delay` of `Controller.to_control`: the computational delay, which margins are about, is
    the machine's. A real-time loop that writes its command one sample later has it by itself.

    No fixed point: word lengths that keep the certificate depend on the scaling on the processor. An error
    that is not finite gives NaN, limits or not, which states keep until `<prefix>_reset`: check the sensor.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01, input_limit=24.0)
    >>> code = flexlink.c_source(given, prefix="hub", number="float")
    >>> "float hub_step(hub_state *state, float error)" in code, "INPUT_LIMIT = 24.0f" in code
    (True, True)
    """
    Dialect(prefix, number)
    controller = law_in(number, controller)
    assert controller.anti_windup_gain is not None
    kind: type[np.floating[Any]] = np.float32 if number == "float" else np.float64
    suffix = "f" if number == "float" else ""

    def literal(value: float) -> str:
        # The shortest decimal that reads back as the same number.
        with np.errstate(over="ignore", under="ignore"):
            text = str(kind(value))
        return text + suffix if any(mark in text for mark in ".e") else f"{text}.0{suffix}"

    def constant(what: str, value: float) -> str:
        with np.errstate(over="ignore", under="ignore"):
            if value and not 0 < abs(float(kind(value))) < np.inf:
                raise ValueError(f"{what} = {value:.6g} does not fit in a C {number}; use number = 'double'")
        return literal(value)

    def vector(values: Real) -> str:
        return "{" + ", ".join(literal(value) for value in (values if values.size else [0.0])) + "}"

    values = {"f": suffix}
    if (given := controller.feedforward) is not None:
        own: dict[str, float] = {
            "level": given.level,
            "turn": given.turn(controller.dt_s),
            "share": given.share(controller.dt_s),
        }
        own |= {"excess": given.excess, "fall": given.fall * controller.dt_s}
        values |= {name: constant(f"feedforward {name}", value) for name, value in own.items()}
    one = controller.D.size == 1

    def table(matrix: Real) -> str:
        return ",\n    ".join(vector(row) for row in matrix) or vector(np.zeros(matrix.shape[1]))

    for name, key, factor in (
        ("input_limit", "input_limit", 1.0),
        ("rate_limit", "largest_change", controller.dt_s),
    ):
        if getattr(controller, name) is not None:
            most = np.minimum(factor * controller.limits(name), _NO_LIMIT)
            values[key] = constant(name, float(most[0])) if one else vector(most)
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


def law_in(number: Number, controller: Controller) -> Controller:
    """The controller in the states that its code has: its own, or those of `in_sections` where `float` would
    change what it does by rounding its own. Raises ValueError where it does in both."""
    if number == "double" or controller.order == 0:
        return controller
    assert controller.anti_windup_gain is not None
    own, there, back = in_sections(controller.A)
    sections = replace(
        controller,
        A=own,
        B=back @ controller.B,
        C=controller.C @ there,
        anti_windup_gain=back @ controller.anti_windup_gain,
    )
    omega = np.geomspace(1e-4, 1.0, 400) * np.pi / controller.dt_s
    exact = controller.response(omega).reshape(omega.size, -1)
    size = _ROUNDED * np.linalg.norm(exact, axis=1)
    radius = max(1.0, _radius(controller)) * (1 + np.finfo(np.float32).eps)
    for form in (controller, sections):
        rounded: dict[str, Any] = {
            name: np.clip(getattr(form, name), -_NO_LIMIT, _NO_LIMIT).astype(np.float32)
            for name in ("A", "B", "C", "D", "anti_windup_gain")
        }
        law = replace(controller, **rounded, input_limit=None, rate_limit=None)
        off = np.linalg.norm(law.response(omega).reshape(exact.shape) - exact, axis=1)
        if np.all(off <= size) and _radius(law) <= radius:
            return form
    raise ValueError(
        f"single precision changes the response of {controller.name!r} by more than {_ROUNDED:.0%}: use "
        "number = 'double', or give the controller in sections"
    )


def _radius(law: Controller) -> float:
    """Of the poles, with a limit active or not."""
    assert law.anti_windup_gain is not None
    return float(np.max(np.abs(np.linalg.eigvals([law.A, law.A - law.anti_windup_gain @ law.C]))))


def _filled(template: str, controller: Controller, **values: object) -> str:
    """A template with its values. A line that begins with `@what:` is for controllers that have it (`!what`:
    that have it not; several with commas: all of them)."""
    given = controller.feedforward
    has = {
        "input_limit": controller.input_limit is not None,
        "rate_limit": controller.rate_limit is not None,
        "limits": controller.input_limit is not None or controller.rate_limit is not None,
        "friction": given is not None,
        "breakaway": given is not None and given.excess != 0,
        "matrix": controller.D.size > 1,
        "signals": bool(controller.signals),
        "delay": controller.computational_delay_samples > 0,
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
    return tuple((files("control_design.controllers") / name).read_text("ascii").splitlines(keepends=True))
