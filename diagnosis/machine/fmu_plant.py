"""A functional mock-up unit (FMI 2.0, co-simulation) as the simulation of an own plant.

Its code is native and not ours: it runs in a process of its own (`fmu_child`). Its parameters with their
start values are the nominal ones; a parameter that starts at zero and states a maximum is an effect that may
be missing.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
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

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.plant_effect import PlantEffect
from plant.effects.search_space import EffectParameter

_CHILD = Path(__file__).with_name("fmu_child.py")
# A simulation of a log takes milliseconds to seconds; a search makes thousands of them.
_LONGEST_S = 60.0
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
        return {
            v.name: v
            for v in self.description.modelVariables
            if v.causality in causality and v.type == "Real"
        }

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(self._of("input"))

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(self._of("output"))

    @property
    def step_s(self) -> float | None:
        """The step that the file proposes; None where it does not."""
        usual = self.description.defaultExperiment
        return float(usual.stepSize) if usual is not None and usual.stepSize else None

    @property
    def units(self) -> dict[str, str]:
        """Output -> unit, where the file declares one, of its own or of its type."""
        declared = {
            name: v.unit or getattr(v.declaredType, "unit", None) for name, v in self._of("output").items()
        }
        return {name: unit for name, unit in declared.items() if unit}

    @property
    def parameters(self) -> dict[str, float]:
        """Start values that are not zero."""
        started = {name: float(v.start or 0.0) for name, v in self._of("parameter").items()}
        return {name: value for name, value in started.items() if value != 0.0}

    @property
    def tolerances(self) -> dict[str, float]:
        """None: an FMU states no tolerances."""
        return {}

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        return tuple(
            PlantEffect(name, (EffectParameter(name, _NOTHING * float(v.max), float(v.max)),))
            for name, v in self._of("parameter").items()
            if not float(v.start or 0.0) and v.max is not None and float(v.max) > 0
        )

    @cached_property
    def _simulator(self) -> _Simulator:
        simulator = _Simulator(self.path, self.description)
        weakref.finalize(self, simulator.end)
        return simulator

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        values = {**parameters, **{name: size[name] for name, size in effects.items()}}
        known = self._of("parameter")
        call = {
            "set": [known[name].valueReference for name in values],
            "driven": [v.valueReference for v in self._of("input").values()],
            "seen": [v.valueReference for v in self._of("output").values()],
            "dt_s": self.dt_s,
            "samples": len(inputs),
        }
        return self._simulator.answer(call, np.array(list(values.values()), dtype=np.float64), inputs)


class _Simulator:
    """The process that runs the FMU's code (`fmu_child`); a new one where it has ended."""

    def __init__(self, path: Path, description: Any) -> None:
        self._path = path
        self._named = (description.coSimulation.modelIdentifier, description.guid)
        self._process: subprocess.Popen[bytes] | None = None
        self._owner, self._folder = 0, ""

    def answer(self, call: Mapping[str, Any], values: Real, inputs: Real) -> Real:
        """Outputs (T, Y). Raises ArithmeticError, one line, where the FMU reports an error, ends its process
        or does not answer within `_LONGEST_S`: of a trial that is a trial that failed."""
        # A process that was forked off this one has to have its own.
        if self._process is None or self._owner != os.getpid():
            self._owner, self._folder = os.getpid(), mkdtemp(prefix="flexlink-fmu-")
            command = [sys.executable, "-I", str(_CHILD), str(self._path), self._folder, *self._named]
            pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=nowhere)
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        watch = threading.Timer(_LONGEST_S, process.kill)
        watch.start()
        try:
            asked = json.dumps(call).encode() + b"\n" + values.tobytes()
            process.stdin.write(asked + np.ascontiguousarray(inputs, dtype=np.float64).tobytes())
            process.stdin.flush()
            head = json.loads(process.stdout.readline() or b"null")
            count = 8 * len(inputs) * len(call["seen"])
            content = process.stdout.read(count) if head == {} else b""
        except (BrokenPipeError, ValueError):
            head = None
        finally:
            late = not watch.is_alive()
            watch.cancel()
        if head is None or (head == {} and len(content) < count):
            self.end()
            how = f"did not answer within {_LONGEST_S:g} s" if late else f"ended with {process.returncode}"
            raise ArithmeticError(f"{self._path}: the process of the FMU {how}")
        if head:
            raise ArithmeticError(f"{self._path}: the FMU reports: {head['error']}")
        return np.frombuffer(content).reshape(len(inputs), -1)

    def end(self) -> None:
        """Let the process leave, and remove the files that the FMU had unpacked."""
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if stream is not None:
                    stream.close()
        try:
            process.wait(2.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)
