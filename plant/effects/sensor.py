"""Effects on the tip sensor. They act in the order lag, gain, drift, noise, quantisation."""

from __future__ import annotations

from types import MappingProxyType

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, with_sensor
from plant.machine import Machine


class SensorGain(Effect):
    """tip_m multiplied by a ratio, before its noise."""

    id = "sensor_gain"
    group = "sensor"
    neutral = MappingProxyType({"ratio": 1.0})

    ratio: Positive = Field(description="measured over true tip position")

    def modify(self, machine: Machine) -> Machine:
        return with_sensor(machine, gain=machine.sensor.gain * self.ratio)


class SensorDrift(Effect):
    """rate * time added to tip_m, time from the start of the record."""

    id = "sensor_drift"
    group = "sensor"
    neutral = MappingProxyType({"rate_m_s": 0.0})

    rate_m_s: float = Field(description="drift of the tip sensor")

    def modify(self, machine: Machine) -> Machine:
        return with_sensor(machine, drift_m_s=machine.sensor.drift_m_s + self.rate_m_s)


class Quantisation(Effect):
    """tip_m rounded to the nearest multiple of a step, after the noise."""

    id = "quantisation"
    group = "sensor"
    neutral = MappingProxyType({"step_m": 0.0})
    dependence = "jagged"

    step_m: NotNegative = Field(description="resolution of the tip sensor; 0 is none")

    def modify(self, machine: Machine) -> Machine:
        return with_sensor(machine, step_m=max(machine.sensor.step_m, self.step_m))


class SensorLag(Effect):
    """First-order lag on the tip sensor, before its gain, drift and noise."""

    id = "sensor_lag"
    group = "sensor"
    neutral = MappingProxyType({"time_constant_s": 0.0})

    time_constant_s: NotNegative = Field(description="time constant; 0 is none")

    def modify(self, machine: Machine) -> Machine:
        return with_sensor(machine, lag_s=self.time_constant_s)
