"""What a setting is called by the command that speaks: a hint has to work where it is read.

Configurations and Python call a setting by its key; `flexlink identify` has options of its own for some.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from jinja2 import pass_context

OPTIONS: Mapping[str, Mapping[str, str]] = {
    "identify": {
        "integrators": "--integrators",
        "feedthrough": "--feedthrough",
        "input_delay_samples": "--delay",
        "relative_degree": "--relative-degree",
        "n_real": "--real",
        "n_pairs": "--pairs",
        "omega_min_rad_s": "--omega-min",
        "omega_max_rad_s": "--omega-max",
        "zeta_min": "--zeta-min",
        "zeta_max": "--zeta-max",
        "noise": "--noise",
        "max_ar_order": "--noise-order",
        "coloured_noise": "--noise-order 8",
        "level": "--level",
        "response": "--response",
        "band_rad_s": "--band",
        "resample_s": "--resample-s",
        "controller_period_s": "--controller-period",
        "validation": "--validation",
        "closed_loop_data.method": "--loop-method",
    },
}
"""Options of a command by the key of the setting, with the value that switches it on where the key has none
like it; a command that is not here has the keys themselves."""

# Options that switch on and take no value.
_SWITCHES = {"--feedthrough"}

_speaker: ContextVar[str] = ContextVar("speaker", default="")


@contextmanager
def speaking(command: str) -> Iterator[None]:
    """Whatever is said inside is said by this command (a name in `OPTIONS`)."""
    token = _speaker.set(command)
    try:
        yield
    finally:
        _speaker.reset(token)


@pass_context  # or Jinja would compile what one speaker says into the template
def option(_: Any, key: str, value: object = None) -> str:
    """A setting, and the value to give it, as the command that speaks takes them."""
    told = "" if value is None else str(value)
    own = OPTIONS.get(_speaker.get())
    if own is None:
        return f"{key} = {told}" if told else key
    if key not in own:
        return f"{key}{' = ' + told if told else ''} (in a configuration of flexlink run)"
    name = own[key]
    told = told.strip("'")
    return f"{name} {told}" if told and name not in _SWITCHES and " " not in name else name


@pass_context
def stated(context: Any, prior: str) -> str:
    """What was stated, "integrators = 1" or "fixed_poles", in the same words."""
    key, _, value = prior.partition(" = ")
    return option(context, key, value or None)
