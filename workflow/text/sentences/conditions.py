"""What is other in a run of the loop under other conditions."""

from __future__ import annotations

from collections.abc import Sequence


def smooth_move(seconds: float) -> str:
    return f"smooth move in {seconds:.3g} s"


def half_sine(force_N: float, length_ms: float) -> str:
    return f"{force_N:.3g} N, half sine of {length_ms:.3g} ms"


def payload(grams: float) -> str:
    return f"{grams:.3g} g at the tip"


def more_delay(delay_ms: float) -> str:
    return f"{delay_ms:.3g} ms more delay"


def other_friction(effects: Sequence[str], times: int) -> str:
    """times: 2 or 0."""
    names = " and ".join(effects).replace("_friction and", " and").replace("_", " ")
    return f"{'twice the' if times else 'without'} {names}"


def coarse_steps(command_V: float, measurement: float, unit: str) -> str:
    return f"command in steps of {command_V:.3g} V, measurement of {measurement:.3g} {unit}"


def overdriven(times: float, *, known: bool) -> str:
    """known: the controller knows its limit."""
    if not known:
        return "the same step; the controller does not know the limit"
    return f"a step that needs {times:g} times the command limit; the controller has anti-windup"
