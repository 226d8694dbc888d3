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

# The program of the FMU's own process.
_CHILD = Path(__file__).with_name("fmu_child.py")
# Longest time that the FMU may take for a record, seconds. It takes milliseconds to seconds, a search makes
# thousands of them. Chosen; a longer one only makes a hanging FMU hang longer.
_LONGEST_S = 60.0
# Time that its process gets to leave by itself, seconds, before it is killed. Chosen: it only removes files.
_LEAVES_S = 2.0
# Least size of an effect over its stated maximum: where it is next to nothing, as of every listed effect.
_NOTHING = 1e-4


@dataclass(frozen=True, eq=False)
class Fmu:
    """(parameters, effects, inputs (T, U)) -> outputs (T, Y): real inputs and outputs in the file's order.

    Inputs are held over every sample; outputs are read before it.

    Parameters
    ----------
    path : Path
        The file.
    dt_s : float
        Sampling period of the records, which is the communication step.

    Raises
    ------
    ValueError
        One line: a file that is no FMU, not FMI 2.0 for co-simulation, no real input or no real output.
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
        """What the file says about itself (`fmpy.model_description.ModelDescription`)."""
        if not zipfile.is_zipfile(self.path):
            raise ValueError("not a zip archive")
        return fmpy.read_model_description(str(self.path))

    def _variables(self, causality: str) -> dict[str, Any]:
        """Name -> real variable (`ScalarVariable`): "input", "output" or "parameter"."""
        variables = {}
        for variable in self.description.modelVariables:
            if variable.causality == causality and variable.type == "Real":
                variables[variable.name] = variable
        return variables

    @property
    def inputs(self) -> tuple[str, ...]:
        """(U,) names of the real inputs."""
        return tuple(self._variables("input"))

    @property
    def outputs(self) -> tuple[str, ...]:
        """(Y,) names of the real outputs."""
        return tuple(self._variables("output"))

    @property
    def step_s(self) -> float | None:
        """The step that the file proposes; None where it does not."""
        proposed = self.description.defaultExperiment
        if proposed is None or not proposed.stepSize:
            return None
        return float(proposed.stepSize)

    @property
    def units(self) -> dict[str, str]:
        """Output -> unit, where the file declares one, of its own or of its type."""
        units = {}
        for name, variable in self._variables("output").items():
            unit = variable.unit or getattr(variable.declaredType, "unit", None)
            if unit:
                units[name] = unit
        return units

    @property
    def parameters(self) -> dict[str, float]:
        """Parameter -> its start value, of those that do not start at zero."""
        starts = {name: _start_value(variable) for name, variable in self._variables("parameter").items()}
        return {name: value for name, value in starts.items() if value != 0.0}

    @property
    def tolerances(self) -> dict[str, float]:
        """None: an FMU states no tolerances."""
        return {}

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        """Parameters that start at zero and state a maximum above it, up to that."""
        effects = []
        for name, variable in self._variables("parameter").items():
            if _start_value(variable) != 0.0 or variable.max is None:
                continue
            largest = float(variable.max)
            if largest > 0:
                size = EffectParameter(name, _NOTHING * largest, largest)
                effects.append(PlantEffect(name, (size,)))
        return tuple(effects)

    @cached_property
    def _simulator(self) -> _Simulator:
        """The process that runs its code, as long as this object is there."""
        simulator = _Simulator(self.path, self.description)
        weakref.finalize(self, simulator.end)
        return simulator

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        """Outputs (T, Y) under inputs (T, U), from the FMU's own start, the same for the same arguments.

        parameters : name -> value. effects : name -> {name: value}. A name that the file has not is a
        KeyError. Raises ArithmeticError, one line, where the FMU fails (`_Simulator.answer`).
        """
        values = dict(parameters)
        for name, sizes in effects.items():
            values[name] = sizes[name]
        known = self._variables("parameter")
        call = {
            "set": [known[name].valueReference for name in values],
            "driven": [variable.valueReference for variable in self._variables("input").values()],
            "seen": [variable.valueReference for variable in self._variables("output").values()],
            "dt_s": self.dt_s,
            "samples": len(inputs),
        }
        return self._simulator.answer(call, np.array(list(values.values()), dtype=np.float64), inputs)


def _start_value(variable: Any) -> float:
    """Start value of a real parameter; zero where the file states none."""
    return float(variable.start or 0.0)


class _Simulator:
    """The process that runs the FMU's code (`fmu_child`); a new one where it has ended.

    path : of the FMU. description : of it, as fmpy reads it.
    """

    def __init__(self, path: Path, description: Any) -> None:
        self._path = path
        self._model_identifier = description.coSimulation.modelIdentifier
        self._guid = description.guid
        self._process: subprocess.Popen[bytes] | None = None
        # Process that has started it, and the folder with the unpacked files.
        self._owner = 0
        self._folder = ""

    def _started(self) -> subprocess.Popen[bytes]:
        """The running process; a new one for a process that was forked off the one that has it."""
        if self._process is None or self._owner != os.getpid():
            self._owner = os.getpid()
            self._folder = mkdtemp(prefix="flexlink-fmu-")
            names = [self._model_identifier, self._guid]
            self._process = subprocess.Popen(
                [sys.executable, "-I", str(_CHILD), str(self._path), self._folder, *names],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        return self._process

    def answer(self, call: Mapping[str, Any], values: Real, inputs: Real) -> Real:
        """Outputs (T, Y) of one simulation.

        Parameters
        ----------
        call : mapping
            As `fmu_child` describes it.
        values : (P,)
            Of the parameters in call["set"].
        inputs : (T, U)

        Raises
        ------
        ArithmeticError
            One line, where the FMU reports an error, ends its process or does not answer within `_LONGEST_S`:
            of a trial that is a trial that failed. The next call gets a new process.
        """
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        question = json.dumps(call).encode() + b"\n" + values.tobytes()
        question += np.ascontiguousarray(inputs, dtype=np.float64).tobytes()
        size = 8 * len(inputs) * len(call["seen"])
        head = None
        content = b""
        watch = threading.Timer(_LONGEST_S, process.kill)
        watch.start()
        try:
            process.stdin.write(question)
            process.stdin.flush()
            # An empty line is the end of the process.
            head = json.loads(process.stdout.readline() or b"null")
            if head == {}:
                content = process.stdout.read(size)
        except (BrokenPipeError, ValueError):
            head = None
        finally:
            too_late = not watch.is_alive()
            watch.cancel()

        if head is not None and head != {}:
            raise ArithmeticError(f"{self._path}: the FMU reports: {head['error']}")
        if head is None or len(content) < size:
            self.end()
            how = f"ended with {process.returncode}"
            if too_late:
                how = f"did not answer within {_LONGEST_S:g} s"
            raise ArithmeticError(f"{self._path}: the process of the FMU {how}")
        return np.frombuffer(content).reshape(len(inputs), -1)

    def end(self) -> None:
        """Let the process leave, and remove the files that the FMU had unpacked; only its owner may."""
        process = self._process
        self._process = None
        if process is None or self._owner != os.getpid():
            return
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if stream is not None:
                    stream.close()
        try:
            process.wait(_LEAVES_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)
