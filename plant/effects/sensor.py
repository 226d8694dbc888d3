"""Effects on the sensor of the link. They act in the order lag, gain, drift, noise, quantisation.

A class per effect: its docstring states the equation, its fields the parameters, and its class variables what
`plant.effects.base.Effect` explains. Ranges and starts (`sought`) are in multiples of the sampling period, or
of the sensor noise over a record.
"""

from __future__ import annotations

from operator import add, mul

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, RatioEffect, alone, register
from plant.effects.search_space import EffectParameter


@register
class SensorGain(RatioEffect):
    """tip_m (or tip acceleration, or deflection) multiplied by a ratio, before its noise."""

    id = "sensor_gain"
    law = ("sensor", "gain", mul)
    words = "a wrong gain of the tip sensor"
    check = "move the tip by a known length and compare the reading"

    ratio: Positive = Field(description="measured over true tip position")


@register
class SensorDrift(Effect):
    """rate * time added to tip_m, time from the start of the record."""

    id = "sensor_drift"
    law = ("sensor", "drift_m_s", add)
    words = "a drift of the tip sensor"
    check = "log the tip sensor for some minutes with the arm clamped"
    signed = True
    # In sensor noises over the longest record, of either sign; starts four times apart: outputs are linear in
    # it.
    sought = (
        EffectParameter(
            "rate_m_s", 1e-3, 1e4, unit="rig.sensors.tip_noise_m/duration_s", spread=(0.1, 100, 6)
        ),
    )

    rate_m_s: float = Field(description="drift of the tip sensor")


@register
class Quantisation(Effect):
    """tip_m rounded to the nearest multiple of a step, after the noise."""

    id = "quantisation"
    law = ("sensor", "step_m", max)
    words = "coarse quantisation of the tip sensor"
    check = "move the tip slowly and look for steps in the reading"
    dependence = "non-smooth"

    # Values on a grid are plain to see: the step is read off them (`diagnosis.machine.quantisation_grid`).
    step_m: NotNegative = Field(description="resolution of the tip sensor; 0 is none")


@register
class SensorLag(Effect):
    """First-order lag on the tip sensor, before its gain, drift and noise."""

    id = "sensor_lag"
    law = ("sensor", "lag_s", alone)
    words = "a lag of the tip sensor"
    check = "tap against the tip and compare when its sensor and the encoder answer"
    # From far below a sample to 200 of them; starts 2.3 times apart, as outputs change slowly with a lag.
    sought = (EffectParameter("time_constant_s", 2e-4, 200, unit="dt_s", spread=(0.02, 40, 10)),)

    time_constant_s: NotNegative = Field(description="time constant; 0 is none")
