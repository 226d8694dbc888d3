"""A functional mock-up unit (FMI 2.0, co-simulation) as the simulation of an own plant.

Its parameters with their start values are the nominal ones; a parameter that starts at zero and states a
maximum is an effect that may be missing.
"""

from __future__ import annotations

import shutil
import weakref
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.plant_effect import EffectParameter, PlantEffect

# Of a maximum: where an effect is next to nothing.
_NOTHING = 1e-4


@dataclass(frozen=True, eq=False)
class Fmu:
    """parameters, effects, inputs (T, U) -> outputs (T, Y): real inputs and outputs in the file's order.

    Inputs are held over every sample of dt_s seconds; outputs are read before it.

    Raises ValueError, one line: a file that is no FMU, not FMI 2.0 for co-simulation, no input or output.
    """

    path: Path
    dt_s: float

    def __post_init__(self) -> None:
        try:
            description = self.description
        except Exception as error:  # fmpy raises whatever its parsers do
            reason = " ".join(str(error).split())
            raise ValueError(f"{self.path}: cannot be read as an FMU ({reason})") from None
        if not description.fmiVersion.startswith("2.") or description.coSimulation is None:
            raise ValueError(f"{self.path}: FMI {description.fmiVersion}, expected FMI 2.0 for co-simulation")
        if not (self.inputs and self.outputs):
            raise ValueError(f"{self.path}: has no real input or no real output")

    @cached_property
    def description(self) -> Any:
        if not zipfile.is_zipfile(self.path):
            raise ValueError("not a zip archive")
        return fmpy.read_model_description(str(self.path))

    def _of(self, *causality: str) -> dict[str, Any]:
        every = self.description.modelVariables
        return {v.name: v for v in every if v.causality in causality and v.type == "Real"}

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(self._of("input"))

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(self._of("output"))

    @property
    def parameters(self) -> dict[str, float]:
        """Start values that are not zero."""
        started = {name: float(v.start or 0.0) for name, v in self._of("parameter").items()}
        return {name: value for name, value in started.items() if value != 0.0}

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        return tuple(
            PlantEffect(name, (EffectParameter(name, _NOTHING * float(v.max), float(v.max)),))
            for name, v in self._of("parameter").items()
            if not float(v.start or 0.0) and v.max is not None and float(v.max) > 0
        )

    @cached_property
    def _slave(self) -> Any:
        folder = mkdtemp(prefix="flexlink-fmu-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        fmpy.extract(str(self.path), folder)
        slave = FMU2Slave(
            guid=self.description.guid,
            unzipDirectory=folder,
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="flexlink",
        )
        slave.instantiate()
        return slave

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        slave = self._slave
        values = {**parameters, **{name: size[name] for name, size in effects.items()}}
        known = self._of("parameter")
        driven = [v.valueReference for v in self._of("input").values()]
        seen = [v.valueReference for v in self._of("output").values()]
        slave.reset()
        slave.setupExperiment(startTime=0.0)
        slave.setReal([known[name].valueReference for name in values], list(values.values()))
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        found = np.empty((len(inputs), len(seen)))
        for k, row in enumerate(inputs):
            slave.setReal(driven, row)
            found[k] = slave.getReal(seen)
            slave.doStep(k * self.dt_s, self.dt_s)
        return found
