"""A model as a file that other programs read: JSON, and MATLAB's .mat (version 5, also Octave and SciPy).

Both hold the same fields: `format` and `format_version`; `A`, `B`, `C`, `D` and `dt_s` for whoever simulates
or designs (in MATLAB: `m = load('model.mat'); G = ss(m.A, m.B, m.C, m.D, m.dt_s)`); poles, coefficients,
integrators, delay and names, from which the model comes back bit by bit; and, if wanted, the ellipses of its
response. State matrices and poles that contradict each other are refused on reading: somebody changed one of
them and would be surprised by the other.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.io

from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.mat_files import mat_variables

FORMAT = "flexlink GOBF model"
FORMAT_VERSION = 1

# The state matrices are computed anew on reading; another machine may round differently.
_STATE_TOLERANCE = 1e-9
# The text that opens a .mat file carries the date; without it equal models give equal files.
_MAT_HEADER = b"MATLAB 5.0 MAT-file, flexlink GOBF model".ljust(116)


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model and, optionally, the ellipses of its response, as they are written to and read from a file."""

    model: GobfModel
    ellipses: FrequencyUncertainty | None = None

    def __post_init__(self) -> None:
        if self.ellipses is not None and self.ellipses.dt_s != self.model.dt_s:
            raise ValueError(
                f"the ellipses' dt_s = {self.ellipses.dt_s} is not the model's, {self.model.dt_s}"
            )

    def to_json(self) -> str:
        """JSON text; floats with as many digits as they have, so that reading gives the same bits."""
        model, (A, B, C, D) = self.model, self.model.state_space()
        document: dict[str, Any] = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "input_name": model.input_name,
            "output_name": model.output_name,
            "dt_s": float(model.dt_s),
            "integrators": int(model.integrators),
            "input_delay_samples": int(model.input_delay_samples),
            "feedthrough": float(model.feedthrough),
            "poles_real": model.poles.real.tolist(),
            "poles_pairs": [[pole.real, pole.imag] for pole in model.poles.pairs.tolist()],
            "coefficients": model.coefficients.tolist(),
            "A": A.tolist(),
            "B": B.tolist(),
            "C": C.tolist(),
            "D": D.tolist(),
        }
        if self.ellipses is not None:
            centre = self.ellipses.centre
            document["ellipses"] = {
                "level": float(self.ellipses.level),
                "method": self.ellipses.method,
                "omega_rad_s": self.ellipses.omega_rad_s.tolist(),
                "centre": np.column_stack([centre.real, centre.imag]).tolist(),
                "covariance": self.ellipses.covariance.tolist(),
            }
        return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"

    @classmethod
    def from_json(cls, text: str, source: str = "model file") -> ModelFile:
        """Inverse of `to_json`. ValueError: one line that begins with `source`."""
        try:
            document = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(
                f"{source}, line {error.lineno}, column {error.colno}: not JSON ({error.msg})"
            ) from None
        if not isinstance(document, dict):
            raise ValueError(f"{source}: expected a JSON object, found {type(document).__name__}")
        return _read(document, source)

    def to_mat(self) -> bytes:
        """Content of a .mat file; every number is a double, vectors are columns, pairs and centre complex."""
        model, (A, B, C, D) = self.model, self.model.state_space()
        variables: dict[str, Any] = {
            "format": FORMAT,
            "format_version": float(FORMAT_VERSION),
            "input_name": model.input_name,
            "output_name": model.output_name,
            "dt_s": float(model.dt_s),
            "integrators": float(model.integrators),
            "input_delay_samples": float(model.input_delay_samples),
            "feedthrough": float(model.feedthrough),
            "poles_real": model.poles.real,
            "poles_pairs": model.poles.pairs,
            "coefficients": model.coefficients,
            "A": A,
            "B": B,
            "C": C,
            "D": D,
        }
        if self.ellipses is not None:
            variables["ellipses"] = {
                "level": float(self.ellipses.level),
                "method": self.ellipses.method,
                "omega_rad_s": self.ellipses.omega_rad_s[:, None],
                "centre": self.ellipses.centre[:, None],
                "covariance": self.ellipses.covariance,
            }
        buffer: Any = io.BytesIO()  # scipy takes streams, its stubs know paths only
        scipy.io.savemat(buffer, variables, oned_as="column")
        return bytes(_MAT_HEADER + buffer.getvalue()[len(_MAT_HEADER) :])

    @classmethod
    def from_mat(cls, content: bytes, source: str = "model file") -> ModelFile:
        """Inverse of `to_mat`. ValueError: one line that begins with `source`."""
        raw = mat_variables(content, source)
        document: dict[str, Any] = {name: _plain(value) for name, value in raw.items()}
        if "ellipses" in raw:
            struct = raw["ellipses"]
            if struct.dtype.names is None or struct.size != 1:
                raise ValueError(f"{source}: 'ellipses' is not a struct; expected the one that was written")
            document["ellipses"] = {name: _plain(struct[name].item()) for name in struct.dtype.names}
        return _read(document, source)


def _plain(value: Any) -> Any:
    """A MATLAB variable as it would stand in JSON: text, a number, or an array."""
    array = np.asarray(value)
    if array.dtype.kind == "U":
        return "".join(array.ravel().tolist())
    return array.item() if array.shape == (1, 1) and array.dtype.kind in "fiub" else array


def _read(document: Mapping[str, Any], source: str) -> ModelFile:
    if document.get("format") != FORMAT:
        raise ValueError(f"{source}: not a model file: 'format' is {_shown(document)}, expected '{FORMAT}'")
    version = document.get("format_version")
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{source}: format_version is {version}; this version of flexlink reads {FORMAT_VERSION}"
        )
    try:
        model = GobfModel(
            poles=Poles(_vector(document, "poles_real"), _complex_vector(document, "poles_pairs")),
            coefficients=_vector(document, "coefficients"),
            dt_s=_number(document, "dt_s"),
            feedthrough=_number(document, "feedthrough"),
            integrators=_count(document, "integrators"),
            input_delay_samples=_count(document, "input_delay_samples"),
            input_name=_text(document, "input_name"),
            output_name=_text(document, "output_name"),
        )
        for name, computed in zip("ABCD", model.state_space(), strict=True):
            stated = np.asarray(_array(document, name), dtype=np.float64)
            scale = 1.0 + np.abs(computed).max(initial=0.0)
            same_size = stated.size == computed.size  # of an empty matrix neither format keeps the shape
            if not (
                same_size
                and np.all(np.abs(stated.reshape(computed.shape) - computed) <= _STATE_TOLERANCE * scale)
            ):
                raise ValueError(
                    f"'{name}' is not the state matrix of these poles and coefficients; change the poles and "
                    "coefficients, and write the file anew"
                )
        ellipses = document.get("ellipses")
        return ModelFile(model, None if ellipses is None else _read_ellipses(ellipses, model.dt_s))
    except ValueError as error:
        raise ValueError(f"{source}: {' '.join(str(error).split())}") from None


def _read_ellipses(document: Any, dt_s: float) -> FrequencyUncertainty:
    if not isinstance(document, Mapping):
        raise ValueError("'ellipses' must hold fields; expected the ones that were written")
    omega = _vector(document, "omega_rad_s")
    return FrequencyUncertainty(
        omega_rad_s=omega,
        centre=_complex_vector(document, "centre"),
        covariance=np.asarray(_array(document, "covariance"), dtype=np.float64).reshape(omega.size, 2, 2),
        dt_s=dt_s,
        level=_number(document, "level"),
        method=_text(document, "method"),
    )


def _field(document: Mapping[str, Any], name: str) -> Any:
    if name not in document:
        raise ValueError(f"the field '{name}' is missing")
    return document[name]


def _array(document: Mapping[str, Any], name: str) -> Any:
    value = _field(document, name)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "fiuc" or array.size == 0:
            return array
    except ValueError:
        pass  # rows of unequal length
    raise ValueError(f"the field '{name}' must be an array of numbers")


def _vector(document: Mapping[str, Any], name: str) -> Any:
    array = _array(document, name)
    if array.dtype.kind == "c":
        raise ValueError(f"the field '{name}' must be real")
    return array.astype(np.float64).ravel()


def _complex_vector(document: Mapping[str, Any], name: str) -> Any:
    """Complex numbers from MATLAB, or rows [real part, imaginary part] from JSON."""
    array = _array(document, name)
    if array.size == 0:
        return np.zeros(0, dtype=np.complex128)
    if isinstance(_field(document, name), list):
        if array.ndim != 2 or array.shape[1] != 2:
            raise ValueError(f"the field '{name}' must hold rows [real part, imaginary part]")
        # Not re + 1j im: that turns an imaginary part of -0.0 into 0.0, and infinities into NaN.
        return np.ascontiguousarray(array, dtype=np.float64).view(np.complex128).ravel()
    return array.astype(np.complex128).ravel()


def _number(document: Mapping[str, Any], name: str) -> float:
    value = _field(document, name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"the field '{name}' must be a number")
    return float(value)


def _count(document: Mapping[str, Any], name: str) -> int:
    value = _number(document, name)
    if not (value >= 0 and value == int(value)):
        raise ValueError(f"the field '{name}' must be a whole number, at least 0; got {value}")
    return int(value)


def _text(document: Mapping[str, Any], name: str) -> str:
    value = _field(document, name)
    # MATLAB has no empty string but an empty array.
    if isinstance(value, np.ndarray) and value.size == 0:
        return ""
    if not isinstance(value, str):
        raise ValueError(f"the field '{name}' must be text")
    return value


def _shown(document: Mapping[str, Any]) -> str:
    return "missing" if "format" not in document else repr(document["format"])[:60]
