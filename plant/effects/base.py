"""What an effect is: a small frozen object with physical parameters that changes a machine's description."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from plant.machine import JointPath, Machine, SensorPath, VoltagePath

Group = Literal["actuator", "joint", "link", "sensor"]

P = TypeVar("P", VoltagePath, JointPath, SensorPath)
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Effect(BaseModel, ABC):
    """One deviation of a machine from its nominal rig.

    A subclass has its parameters as fields, SI units in their names, with bounds; its docstring states the
    equation. An instance is frozen; effects commute, because every one changes fields of its own or
    multiplies.

    Attributes
    ----------
    id : str
        Name in the registry and in configuration files.
    group : str
        Where it acts: actuator, joint, link or sensor.
    neutral : mapping or None
        Parameter values at which the effect vanishes exactly; None if there are none within the bounds.
    dependence : str
        How the outputs depend on the parameters: smooth (differentiable), continuous, or jagged.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    id: ClassVar[str]
    group: ClassVar[Group]
    neutral: ClassVar[Mapping[str, float] | None]
    dependence: ClassVar[Literal["smooth", "continuous", "jagged"]] = "smooth"

    @abstractmethod
    def modify(self, machine: Machine) -> Machine:
        """The machine with this effect."""

    def parameters(self) -> dict[str, float]:
        """Parameter values by name."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields}

    def to_dict(self) -> dict[str, Any]:
        """{"name": id, parameter: value, ...}, the form `parse_effect` reads."""
        return {"name": type(self).id, **self.parameters()}


def with_voltage(machine: Machine, **changes: Any) -> Machine:
    return replace(machine, voltage=_replaced(machine.voltage, changes))


def with_joint(machine: Machine, **changes: Any) -> Machine:
    return replace(machine, joint=_replaced(machine.joint, changes))


def with_sensor(machine: Machine, **changes: Any) -> Machine:
    return replace(machine, sensor=_replaced(machine.sensor, changes))


def with_parameters(machine: Machine, values: Mapping[str, float]) -> Machine:
    return replace(machine, rig=machine.rig.perturbed(values))


def _replaced(path: P, changes: Mapping[str, Any]) -> P:
    return replace(path, **changes)
