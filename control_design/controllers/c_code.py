"""The controller as C99 source: the same state-space loop with limits and anti-windup, no heap."""

from __future__ import annotations

import re
from typing import Literal

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real

Number = Literal["double", "float"]


def c_header(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """Declarations to include: the state, `<prefix>_reset` and `<prefix>_step`.

    Raises
    ------
    ValueError
        If names that start with the prefix are no C identifiers.
    """
    return _header(controller, _checked(prefix), number)


def c_source(controller: Controller, prefix: str = "controller", number: Number = "double") -> str:
    """A self-contained C99 translation unit (it repeats the declarations of `c_header`).

    Parameters
    ----------
    controller : Controller
    prefix : str
        Start of every name, a C identifier.
    number : "double" or "float"
        Type of states, coefficients and arithmetic.

    Returns
    -------
    str
        `<prefix>_step(&state, error)` returns the limited command for the error at this sample; the
        state keeps whether a limit was active. One call every `dt_s`; order n costs (n + 1)^2
        multiplications.

    Raises
    ------
    ValueError
        If the prefix is no C identifier.

    Notes
    -----
    Same law and same order of operations as `ControllerStepper`: x+ = A x + B e + M (u_limited - u). In
    `double` the two differ by the rounding of sums only. The computational delay is not in the code: a
    real-time loop that writes its command one sample later has it by itself. Not covered: fixed point, and an
    error that is not finite (the command then is not finite either: check the sensor before the call).
    """
    name = _checked(prefix)
    n = controller.order
    assert controller.anti_windup_gain is not None
    suffix = "f" if number == "float" else ""
    size = max(n, 1)  # C has no arrays of length zero

    def literal(value: float) -> str:
        # The shortest decimal that reads back as the same double.
        text = repr(float(value))
        return text + suffix if any(mark in text for mark in ".e") else f"{text}.0{suffix}"

    def vector(values: Real) -> str:
        return "{" + ", ".join(literal(value) for value in values) + "}" if n else "{" + literal(0.0) + "}"

    rows = ",\n    ".join(vector(row) for row in controller.A) if n else vector(controller.C[0])
    lines = [
        _header(controller, name, number),
        f"static const {number} A[{size}][{size}] = {{\n    {rows}}};",
        f"static const {number} B[{size}] = {vector(controller.B[:, 0])};",
        f"static const {number} C[{size}] = {vector(controller.C[0])};",
        f"static const {number} D = {literal(float(controller.D[0, 0]))};",
        f"static const {number} M[{size}] = {vector(controller.anti_windup_gain[:, 0])};",
    ]
    if controller.input_limit is not None:
        lines.append(f"static const {number} INPUT_LIMIT = {literal(controller.input_limit)};")
    if controller.rate_limit is not None:
        change = controller.rate_limit * controller.dt_s
        lines.append(f"static const {number} LARGEST_CHANGE = {literal(change)};  /* rate_limit * dt_s */")
    limits = []
    if controller.rate_limit is not None:
        limits += [
            "    if (command > state->last + LARGEST_CHANGE) command = state->last + LARGEST_CHANGE;",
            "    if (command < state->last - LARGEST_CHANGE) command = state->last - LARGEST_CHANGE;",
        ]
    if controller.input_limit is not None:
        limits += [
            "    if (command > INPUT_LIMIT) command = INPUT_LIMIT;",
            "    if (command < -INPUT_LIMIT) command = -INPUT_LIMIT;",
        ]
    lines += [
        f"\nvoid {name}_reset({name}_state *state)\n{{",
        f"    for (int i = 0; i < {size}; i++) state->x[i] = 0;",
        "    state->last = 0;\n    state->limited = 0;\n}",
        f"\n{number} {name}_step({name}_state *state, {number} error)\n{{",
        f"    {number} next[{size}];",
        f"    {number} wanted = 0;",
        f"    for (int i = 0; i < {n}; i++) wanted += C[i] * state->x[i];",
        "    wanted += D * error;",
        f"    {number} command = wanted;",
        *limits,
        "    state->limited = command != wanted;",
        f"    for (int i = 0; i < {n}; i++) {{",
        f"        {number} sum = 0;",
        f"        for (int j = 0; j < {n}; j++) sum += A[i][j] * state->x[j];",
        "        next[i] = sum + B[i] * error + M[i] * (command - wanted);",
        "    }",
        f"    for (int i = 0; i < {n}; i++) state->x[i] = next[i];",
        "    state->last = command;\n    return command;\n}",
    ]
    return "\n".join(lines) + "\n"


def _header(controller: Controller, name: str, number: Number) -> str:
    guard = f"{name.upper()}_H"
    delay = controller.computational_delay_samples
    about = re.sub(r"[^ -~]|\*/", "?", controller.name)
    return "\n".join(
        [
            f"/* {about}: order {controller.order}, one call every {controller.dt_s!r} s.",
            "   u = C x + D e limited; x+ = A x + B e + M (u_limited - u); e = reference - measurement.",
            f"   Designed for a command that takes effect {delay} sample(s) after its measurement. */",
            f"#ifndef {guard}\n#define {guard}",
            "typedef struct {",
            f"    {number} x[{max(controller.order, 1)}];",
            f"    {number} last;  /* previous command */",
            "    int limited;  /* 1 while a limit was active in the last call */",
            f"}} {name}_state;",
            f"void {name}_reset({name}_state *state);",
            f"{number} {name}_step({name}_state *state, {number} error);",
            "#endif\n",
        ]
    )


def _checked(prefix: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix):
        raise ValueError(f"prefix must be a C identifier; got {prefix!r}")
    return prefix
