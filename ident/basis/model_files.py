"""A model as a file that other programs read: JSON, and MATLAB's .mat (version 5, also Octave and SciPy).

Both hold `format`, `format_version`; `A`, `B`, `C`, `D`, `dt_s` (in MATLAB: `m = load('model.mat'); G =
ss(m.A, m.B, m.C, m.D, m.dt_s)`); poles, coefficients, integrators, delay and names, bit by bit; and, if
wanted, ellipses. State matrices and poles that contradict each other are refused on reading.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.model_format import FORMAT, FORMAT_VERSION
from ident.basis.poles import NO_POLES, Poles
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.json_text import json_value
from ident.data.mat_files import mat_bytes, mat_variables

# The state matrices are computed anew on reading; another machine may round differently.
_STATE_TOLERANCE = 1e-9


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

    def _document(self) -> dict[str, Any]:
        """The fields of the file, in its order."""
        model = self.model
        document: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION}
        names = ("input_name", "output_name", "dt_s", "integrators", "input_delay_samples", "feedthrough")
        document |= {name: getattr(model, name) for name in names}
        document |= {"poles_real": model.poles.real, "poles_pairs": model.poles.pairs}
        if model.unstable.order:
            document |= {"unstable_real": model.unstable.real, "unstable_pairs": model.unstable.pairs}
        document |= {"coefficients": model.coefficients}
        document |= zip("ABCD", model.state_space(), strict=True)
        if self.ellipses is not None:
            own = ("level", "method", "omega_rad_s", "centre", "covariance")
            document["ellipses"] = {name: getattr(self.ellipses, name) for name in own}
        return document

    def to_json(self) -> str:
        """JSON text; floats with as many digits as they have, so that reading gives the same bits."""
        text = json.dumps(
            self._document(),
            # A complex array as rows [real part, imaginary part].
            default=lambda a: (np.column_stack([a.real, a.imag]) if np.iscomplexobj(a) else a).tolist(),
            indent=1,
            allow_nan=False,
            ensure_ascii=False,
        )
        return text + "\n"

    @classmethod
    def from_json(cls, text: str, source: str = "model file") -> ModelFile:
        """Inverse of `to_json`. ValueError: one line that begins with `source`."""
        try:
            document = json_value(text)
        except ValueError as error:
            raise ValueError(f"{source}: not JSON ({error})") from None
        if not isinstance(document, dict):
            raise ValueError(f"{source}: expected a JSON object, found {type(document).__name__}")
        return _read(document, source)

    def to_mat(self) -> bytes:
        """Content of a .mat file; every number is a double, vectors are columns, pairs and centre complex."""
        variables = self._document()
        variables |= {name: float(value) for name, value in variables.items() if isinstance(value, int)}
        return mat_bytes(variables, FORMAT, oned_as="column")

    @classmethod
    def from_mat(cls, content: bytes, source: str = "model file") -> ModelFile:
        """Inverse of `to_mat`. ValueError: one line that begins with `source`."""
        document: dict[str, Any] = _plain(mat_variables(content, source))
        return _read(document, source)


def _plain(value: Any) -> Any:
    """A MATLAB variable as it would stand in JSON: text, a number, an array, or fields."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value


def _read(document: Mapping[str, Any], source: str) -> ModelFile:
    if document.get("format") != FORMAT:
        shown = repr(document["format"])[:60] if "format" in document else "missing"
        raise ValueError(f"{source}: not a model file: 'format' is {shown}, expected '{FORMAT}'")
    version = document.get("format_version")
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{source}: format_version is {version}; this version of flexlink reads {FORMAT_VERSION}"
        )
    try:
        fields = {name: read(document, name) for name, read in _MODEL.items()}
        poles = Poles(fields.pop("poles_real"), fields.pop("poles_pairs"))
        unstable = NO_POLES
        if "unstable_real" in document:
            unstable = Poles(_vector(document, "unstable_real"), _complex_vector(document, "unstable_pairs"))
        model = GobfModel(poles=poles, unstable=unstable, **fields)
        for name, computed in zip("ABCD", model.state_space(), strict=True):
            stated = np.asarray(_array(document, name), dtype=np.float64)
            scale = 1.0 + np.abs(computed).max(initial=0.0)
            same_size = stated.size == computed.size  # of an empty matrix neither format keeps the shape
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is not the same either
                off = np.abs(stated.reshape(computed.shape) - computed) if same_size else np.inf
            if not np.all(off <= _STATE_TOLERANCE * scale):
                raise ValueError(
                    f"'{name}' is not the state matrix of these poles and coefficients; change the poles and "
                    "coefficients, and write the file again"
                )
        ellipses = document.get("ellipses")
        return ModelFile(model, None if ellipses is None else _read_ellipses(ellipses, model.dt_s))
    except ValueError as error:
        raise ValueError(f"{source}: {' '.join(str(error).split())}") from None


def _read_ellipses(document: Any, dt_s: float) -> FrequencyUncertainty:
    if not isinstance(document, Mapping):
        raise ValueError("'ellipses' must hold fields; expected the ones that were written")
    fields = {name: read(document, name) for name, read in _ELLIPSES.items()}
    fields["covariance"] = np.asarray(fields["covariance"], dtype=np.float64).reshape(-1, 2, 2)
    return FrequencyUncertainty(**fields, dt_s=dt_s)


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
    if not isinstance(value, str):
        raise ValueError(f"the field '{name}' must be text")
    return value


_MODEL = {
    "poles_real": _vector,
    "poles_pairs": _complex_vector,
    "coefficients": _vector,
    "dt_s": _number,
    "feedthrough": _number,
    "integrators": _count,
    "input_delay_samples": _count,
    "input_name": _text,
    "output_name": _text,
}
_ELLIPSES = {
    "omega_rad_s": _vector,
    "centre": _complex_vector,
    "covariance": _array,
    "level": _number,
    "method": _text,
}
