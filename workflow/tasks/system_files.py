"""Discrete systems from files: plants and controllers as matrices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
from scipy.signal import ss2tf

from control_design.controllers.controller import Controller
from ident.data.foreign_files import content_of
from ident.data.mat_files import mat_variables
from ident.data.record_files import READERS
from workflow.engine import documents, storage
from workflow.engine.errors import InputError, naming

DOCUMENTS = (".json", ".mat", ".npz")
_SAMPLING_TIME = ("dt_s", "dt", "Ts")
_SAME_CLOCK = 1e-3  # a share: clocks differ by some 1e-5, and files give three digits or more
# Of an entry of a state space in any units: products of some of them are still numbers.
_LARGEST = 1e50


def read_document(path: Path) -> dict[str, Any]:
    """Top-level names and values of a .npz, .json or .mat file. Raises InputError."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return storage.read_npz(path)
    if suffix == ".json":
        return documents.read_json(path)
    if suffix != ".mat":
        known = ", ".join((*DOCUMENTS, *(ending for ending in READERS if ending not in DOCUMENTS)))
        raise InputError(f"{path}: not a run directory, and the ending is not one of {known}")
    with naming(str(path)):
        return mat_variables(content_of(path), path)


def read_state_space(path: Path, document: Mapping[str, Any]) -> control.StateSpace:
    """A, B, C, D and dt_s (or dt, Ts) of a file; D may be left out. Raises InputError."""
    if str(document.get("format", "")).startswith("flexlink-controller"):
        raise InputError(f"{path}: holds a controller, expected a plant")
    given = [name for name in _SAMPLING_TIME if name in document]
    missing = [name for name in "ABC" if name not in document]
    if missing:
        raise InputError(
            f"{path}: no {missing[0]} in it: a plant needs the matrices A, B, C, D and dt_s, found "
            f"{', '.join(sorted(document)) or 'nothing'}"
        )
    if not given:
        raise InputError(
            f"{path}: no dt_s in it: the design is discrete, sample a continuous model first (c2d in MATLAB, "
            "sample in python-control)"
        )
    matrices = {name: _matrix(path, name, document[name]) for name in "ABCD" if name in document}
    dt_s = _matrix(path, given[0], document[given[0]])
    if dt_s.size != 1 or not dt_s.item() > 0:
        raise InputError(f"{path}: {given[0]} must be one positive number, the sampling time in seconds")
    n = round(np.sqrt(matrices["A"].size))
    wanted = {"A": (n, n), "B": (n, 1), "C": (1, n), "D": (1, 1)}
    for name, matrix in matrices.items():
        flat_vector = name != "A" and matrix.ndim < 2
        if not (matrix.shape == wanted[name] or (matrix.size == np.prod(wanted[name]) and flat_vector)):
            raise InputError(
                f"{path}: {name} is {'x'.join(map(str, matrix.shape)) or 'a number'}, expected "
                f"{wanted[name][0]}x{wanted[name][1]}: one input, one output, A square"
            )
        matrices[name] = matrix.reshape(wanted[name])
    matrices.setdefault("D", np.zeros((1, 1)))
    return control.ss(*(matrices[name] for name in "ABCD"), dt_s.item(), remove_useless_states=False)


def read_controller(path: Path, dt_s: float) -> tuple[list[float], list[float]]:
    """Numerator and denominator in z of the controller of a file: controller.json of a run, or its A, B, C, D
    and dt_s. Raises InputError, also for another sampling time."""
    document = read_document(path)
    with naming(str(path)):
        if document.get("format") == Controller.format_name():
            law = Controller.from_dict(document).to_control(include_delay=True)
        else:
            law = read_state_space(path, document)
        if not abs(law.dt - dt_s) <= _SAME_CLOCK * dt_s:
            raise ValueError(f"is sampled every {law.dt:g} s, the logs every {dt_s:g} s")
        if not law.nstates:
            return [float(law.D[0, 0])], [1.0]
        numerator, denominator = ss2tf(law.A, law.B, law.C, law.D)
    return numerator[0].tolist(), denominator.tolist()


def _matrix(path: Path, name: str, value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        matrix = np.asarray(value)
        if matrix.dtype.kind not in "fiu":
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: {name} must be a matrix of real numbers") from None
    if not np.all(np.abs(matrix) < _LARGEST):
        raise InputError(f"{path}: {name} has a value that is not finite or beyond {_LARGEST:g}")
    return np.asarray(matrix, dtype=np.float64)
