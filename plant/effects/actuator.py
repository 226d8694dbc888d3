"""Effects between commanded voltage and motor, in the order delay, gain, dead zone, saturation, lag.

A class per effect: its docstring states the equation, its fields the parameters, and its class variables what
`plant.effects.base.Effect` explains. Ranges and starts (`sought`) are in multiples of the sampling period or
of the largest voltage of the records: from what no record shows to what leaves nothing of the command. A
`spread` (first, last, count) has the starts in equal ratios, near enough to each other for a descent to reach
any value between.
"""

from __future__ import annotations

from operator import add, mul
from types import MappingProxyType

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, RatioEffect, alone, register
from plant.effects.search_space import EffectParameter


@register
class InputDelay(Effect):
    """Pure delay of the held voltage by any fraction of the sampling period."""

    id = "input_delay"
    law = ("voltage", "delay_s", add)
    words = "a delay of the command"
    check = "log the voltage at the motor beside the command; the time between their steps is the delay"
    adds_to = "sampling.transport_delay_s"
    # From far below a sample to a hundred of them; starts 1.7 times apart.
    sought = (EffectParameter("delay_s", 2e-4, 100, unit="dt_s", spread=(0.04, 30, 14)),)

    delay_s: float = Field(ge=0, le=60.0, description="delay of the voltage; every sample of it is stored")


@register
class ActuatorGain(RatioEffect):
    """Voltage multiplied by a ratio; the back-EMF is not."""

    id = "actuator_gain"
    law = ("voltage", "gain", mul)
    words = "a wrong gain of the actuator"
    check = "hold two steady commands and compare the voltage at the motor with them"
    multiplies = "motor.torque_constant_Nm_A"

    ratio: Positive = Field(description="acting voltage over commanded voltage")


@register
class ActuatorDeadZone(Effect):
    """Voltage becomes sign(V) max(|V| - w, 0)."""

    id = "actuator_dead_zone"
    law = ("voltage", "dead_zone_V", add)
    words = "a dead zone of the actuator"
    check = "raise the command slowly from zero and note where the voltage at the motor begins to follow"
    dependence = "continuous"
    # Up to the largest command, of which nothing is left; starts 1.8 times apart. The step is small, as
    # outputs have a kink where a sample enters the zone.
    sought = (EffectParameter("width_V", 1e-5, 1, unit="voltage_V", spread=(1e-3, 0.5, 12), step=1e-4),)

    width_V: NotNegative = Field(description="half width of the zone without torque")


@register
class ActuatorSaturation(Effect):
    """Voltage clipped to +-limit."""

    id = "actuator_saturation"
    law = ("voltage", "limit_V", min)
    words = "saturation of the actuator"
    check = "command the largest voltage and measure what arrives at the motor"
    neutral = MappingProxyType({"limit_V": 1e6})
    dependence = "continuous"
    # Below a twentieth of the largest command a record is nearly a switch; at 1 nothing is clipped. Starts
    # 1.1 times apart: the clipped share of a record changes fast.
    sought = (EffectParameter("limit_V", 0.05, 1, unit="voltage_V", spread=(0.1, 0.99, 24), step=1e-4),)
    grows = False

    limit_V: Positive = Field(description="largest voltage the driver delivers")


@register
class ActuatorLag(Effect):
    """First-order lag 1 / (T s + 1) on the acting voltage, after every other voltage effect."""

    id = "actuator_lag"
    law = ("voltage", "lag_s", alone)
    words = "a lag of the actuator"
    check = "step the command and look at the voltage at the motor: it should step as well"
    # From far below a sample to 200 of them; starts 2.3 times apart, as outputs change slowly with a lag.
    sought = (EffectParameter("time_constant_s", 2e-4, 200, unit="dt_s", spread=(0.02, 40, 10)),)

    time_constant_s: NotNegative = Field(description="time constant T; 0 is none")
