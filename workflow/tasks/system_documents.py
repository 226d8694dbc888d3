"""Plants and controllers as files state them, read and refused before anything slow is loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from control_design.controllers.controller import Controller
from ident.basis.model_format import FORMAT
from ident.data.arrays import ComplexArray, RealArray
from ident.data.foreign_files import content_of
from ident.data.frf_records import is_response
from ident.data.mat_files import mat_variables
from ident.data.record import SAME_CLOCK
from ident.data.record_files import READERS
from workflow.engine import codec, documents, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import RunDirectory

# Endings of files with named values.
DOCUMENTS = (".json", ".mat", ".npz")
# Names of the sampling time, the first one ours.
_SAMPLING_TIME = ("dt_s", "dt", "Ts")
# Names of both polynomials in z, ours and those of python-control and MATLAB.
_POLYNOMIALS = (("numerator", "denominator"), ("num", "den"))
# Names of zeros, poles and gain.
_ROOTS = ("zeros", "poles", "gain")
# Of an entry of a state space in any units: products of some of them are still numbers.
_LARGEST = 1e50


@dataclass(frozen=True, eq=False)
class StatedSystem:
    """A discrete system with one input and one output, in the form in which a file states it; the other forms
    are None.

    matrices: A (n, n), B (n, 1), C (1, n), D (1, 1) by name; polynomials: numerator and denominator in z,
    (.,) each; roots: zeros and poles, conjugates included, and the gain. dt_s: sampling time [s].
    """

    dt_s: float
    matrices: Mapping[str, RealArray] | None = None
    polynomials: tuple[RealArray, RealArray] | None = None
    roots: tuple[ComplexArray, ComplexArray, float] | None = None


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


def stated_system(path: Path, document: Mapping[str, Any]) -> StatedSystem:
    """The discrete system that a file states.

    Parameters
    ----------
    path : Path
        For complaints.
    document : mapping of str to value
        Its names and values: A, B, C and D (may be left out), or numerator and denominator in z, or zeros,
        poles and gain; with dt_s (or dt, Ts).

    Raises
    ------
    InputError
        One line: a controller of flexlink, something missing, of another shape, or not finite.
    """
    if str(document.get("format", "")).startswith("flexlink-controller"):
        raise InputError(f"{path}: holds a controller, expected a plant")
    period_names = [name for name in _SAMPLING_TIME if name in document]
    polynomials = next((names for names in _POLYNOMIALS if document.keys() >= set(names)), None)
    roots = document.keys() >= set(_ROOTS)
    missing = [name for name in "ABC" if name not in document]
    if missing and polynomials is None and not roots:
        raise InputError(
            f"{path}: no {missing[0]} in it: expected the matrices A, B, C, D, or numerator and denominator, "
            f"or zeros, poles and gain, and dt_s; found {', '.join(sorted(document)) or 'nothing'}"
        )
    if not period_names:
        raise InputError(
            f"{path}: no dt_s in it: the design is discrete, sample a continuous model first (c2d in MATLAB, "
            "sample in python-control)"
        )
    period = _matrix(path, period_names[0], document[period_names[0]])
    if period.size != 1 or not period.item() > 0:
        raise InputError(
            f"{path}: {period_names[0]} must be one positive number, the sampling time in seconds"
        )
    dt_s = float(period.item())
    if polynomials is not None:
        above, below = (_numbers(path, name, document[name]).real for name in polynomials)
        return StatedSystem(dt_s, polynomials=(above, below))
    if roots:
        zeros, poles, gain = (_numbers(path, name, document[name]) for name in _ROOTS)
        if zeros.size > poles.size or gain.size != 1:
            raise InputError(f"{path}: expected no more zeros than poles, and one gain")
        return StatedSystem(dt_s, roots=(zeros, poles, float(gain.item().real)))
    return StatedSystem(dt_s, matrices=_state_space(path, document))


def _state_space(path: Path, document: Mapping[str, Any]) -> dict[str, RealArray]:
    """A, B, C, D of one input and one output, each of its shape; vectors may be flat. Raises InputError."""
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
    return matrices


def _numbers(path: Path, name: str, value: Any) -> ComplexArray:
    """Numbers (n,) with all conjugates; in JSON a complex one is [real part, imaginary part].

    Of complex pairs the file may state one or both. Raises InputError.
    """
    try:
        entries = value if isinstance(value, list) else np.ravel(value)
        numbers = np.array([complex(*np.atleast_1d(entry)) for entry in entries], dtype=np.complex128)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name} must hold numbers") from None
    # Where no imaginary part is negative each complex number stands for a pair, as in fixed_poles.
    if np.all(numbers.imag >= 0):
        numbers = np.append(numbers, numbers[numbers.imag > 0].conj())
    paired = np.allclose(np.sort_complex(numbers), np.sort_complex(numbers.conj()))
    if not paired or not np.all(np.abs(numbers) < _LARGEST):
        raise InputError(f"{path}: {name} must be finite, complex numbers in conjugate pairs")
    return numbers


def _matrix(path: Path, name: str, value: Any) -> RealArray:
    """A value of a file as finite real numbers of any shape. Raises InputError that names it."""
    try:
        matrix = np.asarray(value)
        if matrix.dtype.kind not in "fiu":
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: {name} must be a matrix of real numbers") from None
    if not np.all(np.abs(matrix) < _LARGEST):
        raise InputError(f"{path}: {name} has a value that is not finite or beyond {_LARGEST:g}")
    return np.asarray(matrix, dtype=np.float64)


def stated_law(path: Path, document: Mapping[str, Any]) -> Controller | StatedSystem:
    """The controller of a file, from error to command: one of flexlink, or what `stated_system` reads.

    Raises InputError, one line, for a model in its place or a controller of several loops.
    """
    if document.get("format") == FORMAT:
        raise InputError(f"{path}: holds a model, expected a controller")
    if document.get("format") != Controller.format_name():
        return stated_system(path, document)
    with naming(str(path)):
        law = Controller.from_dict(document)
        if law.D.size > 1:
            raise ValueError(
                f"is of {law.D.shape[1]} errors and {law.D.shape[0]} commands, expected one loop"
            )
    return law


def refuse_other_period(path: Path, found_s: float, dt_s: float) -> None:
    """Raises InputError for a controller whose sampling time [s] is not that of logs and plant."""
    if not abs(found_s - dt_s) <= SAME_CLOCK * dt_s:
        raise InputError(f"{path}: is sampled every {found_s:g} s, expected {dt_s:g} s as of logs and plant")


def refuse_broken_files(plants: Sequence[Path], controller: Path | None = None) -> None:
    """Nothing, for files that can be read as plants and a controller as far as that takes no slow import.

    Raises
    ------
    InputError
        One line: a file that is damaged, no number, not finite, of a wrong shape, of another sampling time.

    Notes
    -----
    Models of flexlink and tables of a response are left to those who read them, beyond their sampling time;
    so is a run, beyond its manifest and its controller.
    """
    law = None
    if controller is not None:
        law = stated_law(controller, read_document(controller))
    for path in plants:
        dt_s = _stated_period_s(path)
        if law is not None and controller is not None and dt_s is not None:
            refuse_other_period(controller, law.dt_s, dt_s)


def _stated_period_s(path: Path) -> float | None:
    """The sampling time [s] that the file of a plant states, None where only those who read it know. Raises
    InputError for a file that is no plant."""
    if path.is_dir():
        RunDirectory.open(path)
        designed = path / "controller.json"
        if not designed.is_file():
            return None
        return stated_law(designed, read_document(designed)).dt_s
    if path.suffix.lower() not in DOCUMENTS:
        return None
    document = read_document(path)
    if document.get("format") == FORMAT:
        stated = np.asarray(document.get("dt_s", np.nan))
        known = stated.size == 1 and stated.dtype.kind in "fiu" and stated.item() > 0
        return float(stated.item()) if known else None
    if codec.DOCUMENT in document:
        return None
    if "A" not in document and path.suffix.lower() in READERS and is_response(path):
        return None
    return stated_system(path, document).dt_s
