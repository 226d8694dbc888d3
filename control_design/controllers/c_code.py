"""The controller as C99 source: the same state-space loop, limits and anti-windup where it has any.

`c_header` and `c_source` fill two templates that stand beside this file. A line of a template that begins
with `@what:` is written only for controllers that have it (limits, friction, several loops). Single precision
may change what a law does: `law_in` chooses states that survive it, or refuses. The order of operations is
that of `ControllerStepper`, so that a simulation and the processor agree to rounding.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from control_design.controllers.engineers_numbers import engineers_numbers
from control_design.controllers.law import in_sections

if TYPE_CHECKING:
    from control_design.controllers.controller import Controller
    from control_design.plants.ellipses import Real

Number = Literal["double", "float"]

# Largest relative change of the response that single precision may make: 0.1 dB, far below what margins
# leave.
_LARGEST_ROUNDING_SHARE = 0.01

# Written for an actuator without a limit beside others that have one, and where a value is clipped to single
# precision: close to the largest float, 3.4e38.
_NO_LIMIT = 3e38

# Frequencies at which single precision is compared with double: from 1e-4 of Nyquist on, a hundred a decade,
# two across a resonance of damping ratio .02.
_COMPARED_FREQUENCIES = 400

# Share of the Nyquist frequency at which they begin: 0.3 rad/s at 1 kHz, below the band of most loops.
# Chosen.
_LOWEST_NYQUIST_SHARE = 1e-4


@dataclass(frozen=True)
class Dialect:
    """How C code is written.

    prefix : what its names begin with, a C identifier. number : type of its numbers, "double" or "float".
    Raises ValueError for other values.
    """

    prefix: str = "controller"
    number: Number = "double"

    def __post_init__(self) -> None:
        """Check both (ValueError)."""
        if self.number not in get_args(Number):
            raise ValueError(f"number must be 'double' or 'float'; got {self.number!r:.80}")
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", self.prefix):
            raise ValueError(f"prefix must be a C identifier; got {self.prefix!r:.80}")

    def beside(self, name: str) -> Dialect:
        """Dialect of a second piece of code, called `name`, in the same program: its names begin with another
        prefix, `name` beside the default one, else both with an underscore. Raises ValueError if that is no C
        identifier."""
        prefix = name
        if self.prefix != "controller":
            prefix = f"{self.prefix}_{name}"
        return Dialect(prefix, self.number)


def c_header(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """Declarations to include, as C text: the state, `<prefix>_reset` and `<prefix>_step`.

    Of one loop the law stands there in an engineer's numbers as well (`engineers_numbers`), as a comment and
    as constants `<PREFIX>_KP`, `<PREFIX>_NOTCH_1_HZ` ... with all digits; the code does not use them. The
    arguments are those of `c_source`. Raises ValueError for a prefix that is no C identifier, or another
    number.
    """
    Dialect(prefix, number)
    comment = ""
    constants = ""
    numbers = engineers_numbers(controller)
    if numbers is not None:
        comment = "".join(f"     {name}: {_ascii(values)}\n" for name, values in numbers.rows()).rstrip()
        lines = []
        for name, value in numbers.constants().items():
            lines.append(f"#define {prefix.upper()}_{name} {value!r}")
        constants = "\n".join(lines)
    return _filled(
        "controller.h.in",
        controller,
        comment=comment,
        constants=constants,
        about=_ascii(controller.name),
        delay=controller.computational_delay_samples,
        dt_s=repr(controller.dt_s),
        guard=f"{prefix.upper()}_H",
        name=prefix,
        number=number,
        signals=_ascii(controller.signals),
    )


def _ascii(text: str) -> str:
    """The text as it may stand in a comment of C: printable ASCII that does not end the comment; other
    characters become "?"."""
    return re.sub(r"[^ -~]|\*/", "?", text)


def c_source(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """A self-contained C99 translation unit of the controller (it repeats the declarations of `c_header`).

    Parameters
    ----------
    controller : Controller
        With its limits, anti-windup and feed-forward.
    prefix : str
        Start of every name, a C identifier.
    number : "double" or "float"
        Type of states, coefficients and arithmetic.

    Returns
    -------
    str
        `<prefix>_step(&state, error)` returns the command for the error at this sample. One call every
        `dt_s`; order n costs (n + 1)^2 multiplications. A controller with limits has them and the anti-windup
        in the code, and its state keeps in `limited` whether one was active. A controller of Y errors and U
        commands has `<prefix>_step(&state, error, command)` with arrays of these lengths. With a friction
        feed-forward it is `<prefix>_step(&state, error, reference)`.

    Raises
    ------
    ValueError
        If the prefix is no C identifier, the number is neither, or does not hold the law.

    Notes
    -----
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
    number_type: type[np.floating[Any]] = np.float64
    suffix = ""
    if number == "float":
        number_type = np.float32
        suffix = "f"

    def literal(value: float) -> str:
        """Shortest decimal that reads back as the same number of the C type; ValueError for one that is too
        large for it."""
        with np.errstate(over="ignore", under="ignore"):
            rounded = number_type(value)
        if not np.isfinite(rounded):
            raise ValueError(f"coefficient {value:.6g} does not fit in a C {number}; use number = 'double'")
        text = str(rounded)
        # A C literal without point and exponent would be an integer.
        if not any(mark in text for mark in ".e"):
            text += ".0"
        return text + suffix

    def constant(what: str, value: float) -> str:
        """Literal of a value that must neither overflow nor vanish in the C type: ValueError naming
        `what`."""
        with np.errstate(over="ignore", under="ignore"):
            rounded = abs(float(number_type(value)))
        if value and not 0 < rounded < np.inf:
            raise ValueError(f"{what} = {value:.6g} does not fit in a C {number}; use number = 'double'")
        return literal(value)

    def vector(values: Real) -> str:
        """Initialiser of an array (N,); C has no arrays of length zero, so none is one zero."""
        if not values.size:
            values = np.zeros(1)
        return "{" + ", ".join(literal(value) for value in values) + "}"

    def table(matrix: Real) -> str:
        """Initialisers of the rows of a matrix (N, M); of no rows one row of zeros."""
        if not len(matrix):
            return vector(np.zeros(matrix.shape[1]))
        return ",\n    ".join(vector(row) for row in matrix)

    is_single_loop = controller.D.size == 1
    constants = {"f": suffix}
    feedforward = controller.feedforward
    if feedforward is not None:
        friction_values = {
            "level": feedforward.level,
            "turn": feedforward.turn(controller.dt_s),
            "share": feedforward.share(controller.dt_s),
            "excess": feedforward.excess,
            "fall": feedforward.fall * controller.dt_s,
        }
        for name, value in friction_values.items():
            constants[name] = constant(f"feedforward {name}", value)
    for name, key, factor in (
        ("input_limit", "input_limit", 1.0),
        ("rate_limit", "largest_change", controller.dt_s),
    ):
        if getattr(controller, name) is not None:
            limits = np.minimum(factor * controller.limits(name), _NO_LIMIT)
            constants[key] = constant(name, float(limits[0])) if is_single_loop else vector(limits)
    # The code of one loop has vectors and a number where that of several has matrices.
    if is_single_loop:
        matrices = {
            "B": vector(controller.B[:, 0]),
            "C": vector(controller.C[0]),
            "D": literal(float(controller.D[0, 0])),
            "M": vector(controller.anti_windup_gain[:, 0]),
        }
    else:
        matrices = {
            "B": table(controller.B),
            "C": table(controller.C),
            "D": table(controller.D),
            "M": table(controller.anti_windup_gain),
        }
    return _filled(
        "controller.c.in",
        controller,
        header=c_header(controller, prefix, number),
        A=table(controller.A) if controller.order else vector(controller.C[0]),
        name=prefix,
        number=number,
        **matrices,
        **constants,
    )


def law_in(number: Number, controller: Controller) -> Controller:
    """The controller in states that its code may have: its own, or those of `in_sections` where `float` would
    change what it does by rounding its own.

    Parameters
    ----------
    number : "double" or "float"
        Type of the code's numbers.
    controller : Controller
        Any order.

    Returns
    -------
    Controller
        Of the same response, limits and name, in double precision; the one given for `double`, an order of 0,
        or where its own states survive rounding.

    Raises
    ------
    ValueError
        Where single precision changes the response by more than 1 %, or lets a pole leave the circle, in both
        forms. numpy's LinAlgError where a pole lies on one of the compared frequencies.
    """
    if number == "double" or controller.order == 0:
        return controller
    assert controller.anti_windup_gain is not None
    section_a, to_states, to_sections = in_sections(controller.A)
    sections = replace(
        controller,
        A=section_a,
        B=to_sections @ controller.B,
        C=controller.C @ to_states,
        anti_windup_gain=to_sections @ controller.anti_windup_gain,
    )
    nyquist_shares = np.geomspace(_LOWEST_NYQUIST_SHARE, 1.0, _COMPARED_FREQUENCIES)
    omega = nyquist_shares * np.pi / controller.dt_s
    exact = controller.response(omega).reshape(omega.size, -1)
    allowed_error = _LARGEST_ROUNDING_SHARE * np.linalg.norm(exact, axis=1)
    # Integrators may stay on the circle, but for the rounding of a number near one.
    allowed_radius = max(1.0, _radius(controller)) * (1 + np.finfo(np.float32).eps)
    for form in (controller, sections):
        rounded: dict[str, Any] = {}
        for name in ("A", "B", "C", "D", "anti_windup_gain"):
            within_float = np.clip(getattr(form, name), -_NO_LIMIT, _NO_LIMIT)
            rounded[name] = within_float.astype(np.float32)
        # Without limits, whose check would refuse a gain that rounding has spoilt.
        law = replace(controller, **rounded, input_limit=None, rate_limit=None)
        error = np.linalg.norm(law.response(omega).reshape(exact.shape) - exact, axis=1)
        if np.all(error <= allowed_error) and _radius(law) <= allowed_radius:
            return form
    raise ValueError(
        f"single precision changes the response of {controller.name!r} by more than "
        f"{_LARGEST_ROUNDING_SHARE:.0%}: use number = 'double', or give the controller in sections"
    )


def _radius(law: Controller) -> float:
    """Largest modulus of the law's poles: those of A, and those of A - M C while a limit is active.

    At least one state (else numpy's ValueError of an empty maximum); `law_in` asks for nothing less.
    """
    assert law.anti_windup_gain is not None
    limited_a = law.A - law.anti_windup_gain @ law.C
    return float(np.max(np.abs(np.linalg.eigvals([law.A, limited_a]))))


def _filled(template: str, controller: Controller, **values: object) -> str:
    """Text of a template file with its values.

    A line that begins with `@what:` is written for controllers that have it, with `@!what:` for those that
    have it not; several conditions, with commas, must all hold. A condition or a placeholder that is not
    known is a KeyError: the templates belong to this package, no user writes them.
    """
    feedforward = controller.feedforward
    has = {
        "input_limit": controller.input_limit is not None,
        "rate_limit": controller.rate_limit is not None,
        "limits": controller.input_limit is not None or controller.rate_limit is not None,
        "friction": feedforward is not None,
        "breakaway": feedforward is not None and feedforward.excess != 0,
        "matrix": controller.D.size > 1,
        "signals": bool(controller.signals),
        "delay": controller.computational_delay_samples > 0,
        "numbers": bool(values.get("constants")),
    }
    lines = []
    for line in _template(template):
        if not line.startswith("@"):
            lines.append(line)
            continue
        conditions, _, text = line[1:].partition(":")
        holds = []
        for condition in conditions.split(","):
            is_negated = condition.startswith("!")
            holds.append(has[condition.lstrip("!")] is not is_negated)
        if all(holds):
            lines.append(text)
    commands, errors = controller.D.shape
    shape = {
        "order": controller.order,
        # C has no arrays of length zero.
        "size": max(controller.order, 1),
        "commands": commands,
        "errors": errors,
    }
    return Template("".join(lines)).substitute(values, **shape)


@cache
def _template(name: str) -> tuple[str, ...]:
    """Lines of a template file of this package, with their line ends; FileNotFoundError for another name."""
    return tuple((files("control_design.controllers") / name).read_text("ascii").splitlines(keepends=True))
