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

# Largest difference of a stated and a computed entry of a state matrix, over 1 plus the largest entry. They
# are computed anew on reading, and another machine may round differently, by about 1e-14; a pole that was
# changed by hand in one place shows from its ninth digit on. Ten times more or less would do.
_STATE_TOLERANCE = 1e-9
# Characters of a wrong `format` that a message shows: enough to tell what the file is.
_SHOWN_CHARACTERS = 60


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model and, optionally, the ellipses of its response, as they are written to and read from a file.

    Raises ValueError where the sampling times of the two differ.
    """

    model: GobfModel
    ellipses: FrequencyUncertainty | None = None

    def __post_init__(self) -> None:
        """Check that the ellipses are of the model's sampling time. Raises ValueError as the class says."""
        if self.ellipses is not None and self.ellipses.dt_s != self.model.dt_s:
            raise ValueError(
                f"the ellipses' dt_s = {self.ellipses.dt_s} is not the model's, {self.model.dt_s}"
            )

    def _document(self) -> dict[str, Any]:
        """Fields of the file, in its order: text, numbers, arrays, and fields of the ellipses.

        Nothing can be bad here: the model and the ellipses were checked when they were made.
        """
        model = self.model
        document: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION}
        names = ("input_name", "output_name", "dt_s", "integrators", "input_delay_samples", "feedthrough")
        for name in names:
            document[name] = getattr(model, name)
        document["poles_real"] = model.poles.real
        document["poles_pairs"] = model.poles.pairs
        # Only where there are any: files of stable models are read by earlier versions, too.
        if model.unstable.order:
            document["unstable_real"] = model.unstable.real
            document["unstable_pairs"] = model.unstable.pairs
        document["coefficients"] = model.coefficients
        document |= zip("ABCD", model.state_space(), strict=True)
        if self.ellipses is not None:
            of_ellipses = ("level", "method", "omega_rad_s", "centre", "covariance")
            document["ellipses"] = {name: getattr(self.ellipses, name) for name in of_ellipses}
        return document

    def to_json(self) -> str:
        """JSON text; floats with as many digits as they have, so that reading gives the same bits."""

        def as_lists(array: Any) -> Any:
            """Lists of an array, of a complex one (n,) as rows [real part, imaginary part]; nothing is
            refused."""
            if np.iscomplexobj(array):
                array = np.column_stack([array.real, array.imag])
            return array.tolist()

        text = json.dumps(self._document(), default=as_lists, indent=1, allow_nan=False, ensure_ascii=False)
        return text + "\n"

    @classmethod
    def from_json(cls, text: str, source: str = "model file") -> ModelFile:
        """Model file of the text that `to_json` made.

        source: what messages call the file. Raises ValueError, one line that begins with `source`, where it
        is no such text (`_read`). Fields that are not known are ignored.
        """
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
        """Model file of the bytes that `to_mat` made.

        source: what messages call the file. Raises ValueError, one line that begins with `source`, where they
        are no such file (`mat_variables`, `_read`). Variables that are not known are ignored.
        """
        document: dict[str, Any] = _plain(mat_variables(content, source))
        return _read(document, source)


def _plain(value: Any) -> Any:
    """A MATLAB variable as it would stand in JSON: text, a number, an array, or fields.

    An array of one number becomes that number; whatever else is found stays, for the readers of fields to
    refuse.
    """
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value


def _read(document: Mapping[str, Any], source: str) -> ModelFile:
    """Model file of the fields that were read from `source`.

    Raises ValueError, one line that begins with `source`: another format or version, a field that is missing
    or of another kind, poles or numbers that `Poles` or `GobfModel` refuses, or state matrices that are not
    those of the poles and coefficients. A whole number that is infinite: OverflowError.
    """
    if document.get("format") != FORMAT:
        shown = repr(document["format"])[:_SHOWN_CHARACTERS] if "format" in document else "missing"
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
            # By size and not by shape: of an empty matrix neither format keeps the shape.
            difference: Any = np.inf
            if stated.size == computed.size:
                # What is not finite is not the same either; it needs no warning.
                with np.errstate(over="ignore", invalid="ignore"):
                    difference = np.abs(stated.reshape(computed.shape) - computed)
            if not np.all(difference <= _STATE_TOLERANCE * scale):
                raise ValueError(
                    f"'{name}' is not the state matrix of these poles and coefficients; change the poles and "
                    "coefficients, and write the file again"
                )
        ellipse_fields = document.get("ellipses")
        if ellipse_fields is None:
            return ModelFile(model)
        return ModelFile(model, _read_ellipses(ellipse_fields, model.dt_s))
    except ValueError as error:
        raise ValueError(f"{source}: {' '.join(str(error).split())}") from None


def _read_ellipses(document: Any, dt_s: float) -> FrequencyUncertainty:
    """Ellipses of their fields in a file; dt_s, s, is the model's.

    Raises ValueError for fields that are missing or of another kind, a covariance whose size is no multiple
    of 4, and what `FrequencyUncertainty` refuses: shapes, order, numbers not finite, level.
    """
    if not isinstance(document, Mapping):
        raise ValueError("'ellipses' must hold fields; expected the ones that were written")
    fields = {name: read(document, name) for name, read in _ELLIPSES.items()}
    # (F, 2, 2), whichever shape the format has kept of it.
    covariance = np.asarray(fields["covariance"], dtype=np.float64)
    fields["covariance"] = covariance.reshape(-1, 2, 2)
    return FrequencyUncertainty(**fields, dt_s=dt_s)


def _field(document: Mapping[str, Any], name: str) -> Any:
    """Value of a field. Raises ValueError where it is missing."""
    if name not in document:
        raise ValueError(f"the field '{name}' is missing")
    return document[name]


def _array(document: Mapping[str, Any], name: str) -> Any:
    """Array of numbers of a field, of any shape. Raises ValueError where it is missing or none.

    An empty one of any type passes; NaN and infinities are for the classes behind to refuse.
    """
    value = _field(document, name)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "fiuc" or array.size == 0:
            return array
    except ValueError:
        # Rows of unequal length: said below.
        pass
    raise ValueError(f"the field '{name}' must be an array of numbers")


def _vector(document: Mapping[str, Any], name: str) -> Any:
    """Real numbers of a field, (n,), from an array of any shape, row by row.

    Raises ValueError where they are missing, complex or no numbers.
    """
    array = _array(document, name)
    if array.dtype.kind == "c":
        raise ValueError(f"the field '{name}' must be real")
    return array.astype(np.float64).ravel()


def _complex_vector(document: Mapping[str, Any], name: str) -> Any:
    """Complex numbers of a field, (n,): from MATLAB as they are, from JSON rows [real part, imaginary part].

    Raises ValueError for other rows, and where the field is missing or holds no numbers.
    """
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
    """Number of a field, as a float; NaN and infinities pass.

    Raises ValueError for anything else, true and false included, and where the field is missing.
    """
    value = _field(document, name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"the field '{name}' must be a number")
    return float(value)


def _count(document: Mapping[str, Any], name: str) -> int:
    """Whole number of a field, at least 0. Raises ValueError for anything else, infinity included."""
    value = _number(document, name)
    if not (value >= 0 and value.is_integer()):
        raise ValueError(f"the field '{name}' must be a whole number, at least 0; got {value}")
    return int(value)


def _text(document: Mapping[str, Any], name: str) -> str:
    """Text of a field. Raises ValueError for anything else, and where the field is missing."""
    value = _field(document, name)
    if not isinstance(value, str):
        raise ValueError(f"the field '{name}' must be text")
    return value


# Fields of a model, and what reads each.
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
# Fields of ellipses, and what reads each.
_ELLIPSES = {
    "omega_rad_s": _vector,
    "centre": _complex_vector,
    "covariance": _array,
    "level": _number,
    "method": _text,
}
