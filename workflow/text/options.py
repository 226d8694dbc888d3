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


def setting_name(key: str, value: object = None) -> str:
    """Return a setting, with the value to give it, as the command that speaks takes them."""
    shown_value = "" if value is None else str(value)
    command_options = OPTIONS.get(_speaker.get())
    if command_options is None:
        return f"{key} = {shown_value}" if shown_value else key
    if key not in command_options:
        return f"{key}{' = ' + shown_value if shown_value else ''} (in a configuration of flexlink run)"
    name = command_options[key]
    shown_value = shown_value.strip("'")
    takes_value = name not in _SWITCHES and " " not in name
    return f"{name} {shown_value}" if shown_value and takes_value else name


def prior_name(prior: str) -> str:
    """Return what was stated, "integrators = 1" or "fixed_poles", as the command that speaks takes it."""
    key, _, value = prior.partition(" = ")
    return setting_name(key, value or None)


def setting_in_uncertainty(key: str, value: object = None) -> str:
    """Return a setting of the uncertainty; where it is said by its key, with its table of a configuration."""
    setting = setting_name(key, value)
    return f"{setting} in [channels.uncertainty]" if setting.startswith(key) else setting


# Without it Jinja would compile what one speaker says into the template.
@pass_context
def option(_: Any, key: str, value: object = None) -> str:
    """`setting_name` for templates."""
    return setting_name(key, value)


@pass_context
def stated(_: Any, prior: str) -> str:
    """`prior_name` for templates."""
    return prior_name(prior)
