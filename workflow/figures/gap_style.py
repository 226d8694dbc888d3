"""Colours and words of the gap pages: one per model, the same in every picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from plant.rig import Output
from workflow.figures import style
from workflow.text.names import name_words, unit_of

# The three models a gap is measured against, in the order of the waterfall, each with a line style.
MODELS: Mapping[str, Mapping[str, Any]] = {
    "stated": {"color": "#CC79A7", "ls": (0, (3, 1.5)), "lw": 1.2},
    "refit": {"color": "#8C6D31", "ls": (0, (5, 1.5, 1, 1.5)), "lw": 1.3},
    "repaired": {"color": style.MODEL, "ls": "-", "lw": 1.3},
}
# Level of the sensors' noise.
FLOOR: dict[str, Any] = {"color": style.REFERENCE, "ls": (0, (1, 1.5)), "lw": 1.1, "label": "sensor noise"}
# Models by what the legend calls them.
WORDS: Mapping[str, str] = {
    "stated": "nominal parameters",
    "refit": "nominal parameters, re-estimated",
    "repaired": "effects added",
}
# Label of an axis of residuals.
RESIDUAL_AXIS = "residual over noise, RMS [1]"
# Label where residuals are a share of the motion.
SHARE_AXIS = "residual, RMS [% of the motion]"
# Share of the noise, or of what a good model may miss, below which nothing is drawn on a log axis.
LEAST = 0.05
# The level below which a model error does not matter.
UNINTERESTING = "significance threshold"
# Band of the noise in time.
NOISE_BAND = {"color": "#e6e6e6", "lw": 0, "label": "2 standard deviations of the sensor noise"}
# What is measured: words, unit, colour.
OUTPUTS: Mapping[Output, tuple[str, str, str]] = {
    "hub_angle_rad": ("hub angle", "rad", style.UNCERTAIN),
    "tip_m": ("tip position", "m", style.HIGHLIGHT),
    "tip_acceleration_m_s2": ("tip acceleration", "m/s²", style.PREDICTED),
    "hub_speed_rad_s": ("hub speed", "rad/s", style.PREDICTED),
    "tip_deflection_m": ("tip deflection", "m", style.HIGHLIGHT),
}
# Colours of further sensors.
_OTHERS = (style.UNCERTAIN, style.HIGHLIGHT, style.PREDICTED)


def look_of(output: str, place: int = 0) -> tuple[str, str, str]:
    """Words, unit and colour of an output; of one's own plant by its name and its place among the others."""
    known = {str(name): look for name, look in OUTPUTS.items()}
    return known.get(output, (name_words(output), unit_of(output), _OTHERS[place % len(_OTHERS)]))


def floor_of(model_error: float) -> dict[str, Any]:
    """Look of the line below which no gap is: sensor noise, or what a good model may miss."""
    return {**FLOOR, "label": UNINTERESTING} if model_error > 0 else FLOOR


# Of a share or probability bar that is not the first answer.
PALE = "#b9c2cc"
