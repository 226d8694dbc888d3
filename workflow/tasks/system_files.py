"""Discrete systems from files: plants and controllers as matrices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
import numpy.typing as npt
from scipy.signal import ss2tf

from control_design.controllers.controller import Controller
from control_design.plants.transfer import of_polynomials, of_roots
from ident.basis.model_files import FORMAT
from ident.data.foreign_files import content_of
from ident.data.mat_files import mat_variables
from ident.data.record import SAME_CLOCK
from ident.data.record_files import READERS
from workflow.engine import documents, storage
from workflow.engine.errors import InputError, naming

DOCUMENTS = (".json", ".mat", ".npz")
_SAMPLING_TIME = ("dt_s", "dt", "Ts")
_FORMS = (("numerator", "denominator"), ("num", "den"), ("zeros", "poles", "gain"))
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
    """A, B, C, D, or numerator and denominator in z, or zeros, poles and gain, and dt_s (or dt, Ts), of a
    file; D may be left out. Raises InputError."""
    if str(document.get("format", "")).startswith("flexlink-controller"):
        raise InputError(f"{path}: holds a controller, expected a plant")
    given = [name for name in _SAMPLING_TIME if name in document]
    form = next((names for names in _FORMS if document.keys() >= set(names)), None)
    missing = [name for name in "ABC" if name not in document]
    if missing and form is None:
        raise InputError(
            f"{path}: no {missing[0]} in it: expected the matrices A, B, C, D, or numerator and denominator, "
            f"or zeros, poles and gain, and dt_s; found {', '.join(sorted(document)) or 'nothing'}"
        )
    if not given:
        raise InputError(
            f"{path}: no dt_s in it: the design is discrete, sample a continuous model first (c2d in MATLAB, "
            "sample in python-control)"
        )
    dt_s = _matrix(path, given[0], document[given[0]])
    if dt_s.size != 1 or not dt_s.item() > 0:
        raise InputError(f"{path}: {given[0]} must be one positive number, the sampling time in seconds")
    if form is not None:
        above, below, *gain = (_roots(path, name, document[name]) for name in form)
        if not gain:
            return of_polynomials(above.real, below.real, dt_s.item())
        if above.size > below.size or gain[0].size != 1:
            raise InputError(f"{path}: expected no more zeros than poles, and one gain")
        return of_roots(above, below, gain[0].item().real, dt_s.item())
    matrices = {name: _matrix(path, name, document[name]) for name in "ABCD" if name in document}
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


def _roots(path: Path, name: str, value: Any) -> npt.NDArray[np.complex128]:
    """Numbers (n,); of complex pairs, in JSON [real part, imaginary part], one or both. Raises InputError."""
    try:
        each = value if isinstance(value, list) else np.ravel(value)
        found = np.array([complex(*np.atleast_1d(one)) for one in each], dtype=np.complex128)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name} must hold numbers") from None
    if np.all(found.imag >= 0):  # one for both, as in fixed_poles
        found = np.append(found, found[found.imag > 0].conj())
    alike = np.allclose(np.sort_complex(found), np.sort_complex(found.conj()))
    if not alike or not np.all(np.abs(found) < _LARGEST):
        raise InputError(f"{path}: {name} must be finite, complex numbers in conjugate pairs")
    return found


def read_law(path: Path, dt_s: float, delay_samples: int = 0) -> Controller:
    """The controller of a file: controller.json of a run, or what `read_state_space` reads, from error to
    command. delay_samples: of the computation, where the file does not say it. Raises InputError, also for
    another sampling time."""
    document = read_document(path)
    if document.get("format") == FORMAT:
        raise InputError(f"{path}: holds a model, expected a controller")
    with naming(str(path)):
        if document.get("format") == Controller.format_name():
            law = Controller.from_dict(document)
        else:
            given = read_state_space(path, document)
            late = np.ravel(document.get("computational_delay_samples", delay_samples))[0]
            law = Controller(
                given.A, given.B, given.C, given.D, given.dt, computational_delay_samples=late, name=path.stem
            )
        if law.D.size > 1:
            raise ValueError(
                f"is of {law.D.shape[1]} errors and {law.D.shape[0]} commands, expected one loop"
            )
        if not abs(law.dt_s - dt_s) <= SAME_CLOCK * dt_s:
            raise ValueError(f"is sampled every {law.dt_s:g} s, expected {dt_s:g} s as of logs and plant")
    return law


def read_controller(path: Path, dt_s: float) -> tuple[list[float], list[float]]:
    """Numerator and denominator in z, with the delay, of a controller of `read_law`."""
    law = read_law(path, dt_s).to_control(include_delay=True)
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
