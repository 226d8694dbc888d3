"""Effects between commanded voltage and motor, in the order delay, gain, dead zone, saturation, lag."""

from __future__ import annotations

from types import MappingProxyType

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, with_voltage
from plant.machine import Machine


class InputDelay(Effect):
    """Pure delay of the held voltage by any fraction of the sampling period."""

    id = "input_delay"
    group = "actuator"
    neutral = MappingProxyType({"delay_s": 0.0})

    delay_s: NotNegative = Field(le=60.0, description="delay of the voltage; every sample of it is stored")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, delay_s=machine.voltage.delay_s + self.delay_s)


class ActuatorGain(Effect):
    """Voltage multiplied by a ratio; the back-EMF is not."""

    id = "actuator_gain"
    group = "actuator"
    neutral = MappingProxyType({"ratio": 1.0})

    ratio: Positive = Field(description="acting voltage over commanded voltage")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, gain=machine.voltage.gain * self.ratio)


class ActuatorDeadZone(Effect):
    """Voltage becomes sign(V) max(|V| - w, 0)."""

    id = "actuator_dead_zone"
    group = "actuator"
    neutral = MappingProxyType({"width_V": 0.0})
    dependence = "continuous"

    width_V: NotNegative = Field(description="half width of the zone without torque")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, dead_zone_V=machine.voltage.dead_zone_V + self.width_V)


class ActuatorSaturation(Effect):
    """Voltage clipped to +-limit."""

    id = "actuator_saturation"
    group = "actuator"
    neutral = MappingProxyType({"limit_V": 1e6})
    dependence = "continuous"

    limit_V: Positive = Field(description="largest voltage the driver delivers")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, limit_V=min(machine.voltage.limit_V, self.limit_V))


class ActuatorLag(Effect):
    """First-order lag 1 / (T s + 1) on the acting voltage, after every other voltage effect."""

    id = "actuator_lag"
    group = "actuator"
    neutral = MappingProxyType({"time_constant_s": 0.0})

    time_constant_s: NotNegative = Field(description="time constant T; 0 is none")

    def modify(self, machine: Machine) -> Machine:
        return with_voltage(machine, lag_s=self.time_constant_s)
