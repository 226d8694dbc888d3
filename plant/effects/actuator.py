"""Effects between commanded voltage and motor, in the order delay, gain, dead zone, saturation, lag."""

from __future__ import annotations

from types import MappingProxyType

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, RatioEffect, register, with_voltage
from plant.effects.search_space import Candidate, Scales, geometric, log_axis
from plant.machine import Machine


@register
class InputDelay(Effect):
    """Pure delay of the held voltage by any fraction of the sampling period."""

    id = "input_delay"
    words = "a delay of the command"
    group = "actuator"
    adds_to = "sampling.transport_delay_s"

    delay_s: NotNegative = Field(le=60.0, description="delay of the voltage; every sample of it is stored")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, delay_s=machine.voltage.delay_s + self.delay_s)

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        dt = scales.dt_s
        return (cls._size(log_axis("delay_s", 2e-4 * dt, 100 * dt), geometric(0.04 * dt, 30 * dt, 14)),)


@register
class ActuatorGain(RatioEffect):
    """Voltage multiplied by a ratio; the back-EMF is not."""

    id = "actuator_gain"
    words = "a wrong gain of the actuator"
    group = "actuator"
    multiplies = "motor.torque_constant_Nm_A"

    ratio: Positive = Field(description="acting voltage over commanded voltage")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, gain=machine.voltage.gain * self.ratio)


@register
class ActuatorDeadZone(Effect):
    """Voltage becomes sign(V) max(|V| - w, 0)."""

    id = "actuator_dead_zone"
    words = "a dead zone of the actuator"
    group = "actuator"
    dependence = "continuous"

    width_V: NotNegative = Field(description="half width of the zone without torque")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, dead_zone_V=machine.voltage.dead_zone_V + self.width_V)

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        V = scales.voltage_V
        return (cls._size(log_axis("width_V", 1e-5 * V, V, 1e-4), geometric(1e-3 * V, 0.5 * V, 12)),)


@register
class ActuatorSaturation(Effect):
    """Voltage clipped to +-limit."""

    id = "actuator_saturation"
    words = "saturation of the actuator"
    group = "actuator"
    neutral = MappingProxyType({"limit_V": 1e6})
    dependence = "continuous"

    limit_V: Positive = Field(description="largest voltage the driver delivers")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, limit_V=min(machine.voltage.limit_V, self.limit_V))

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        V = scales.voltage_V
        axis = log_axis("limit_V", 0.05 * V, V, 1e-4)
        return (cls._size(axis, geometric(0.1 * V, 0.99 * V, 24), grows=False),)


@register
class ActuatorLag(Effect):
    """First-order lag 1 / (T s + 1) on the acting voltage, after every other voltage effect."""

    id = "actuator_lag"
    words = "a lag of the actuator"
    group = "actuator"

    time_constant_s: NotNegative = Field(description="time constant T; 0 is none")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, lag_s=self.time_constant_s)

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        dt = scales.dt_s
        axis = log_axis("time_constant_s", 2e-4 * dt, 200 * dt)
        return (cls._size(axis, geometric(0.02 * dt, 40 * dt, 10)),)
