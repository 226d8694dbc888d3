"""What controller and reference filter have in common: a checked state space, kept as JSON.

A `Law` is a discrete state space with named fields that its class adds. It is checked once, when it is built;
its arrays are read-only. `to_dict` and `to_json` write it with all digits, `from_dict` and `from_json` read
it back to the same law and refuse in one line what is not one, and `to_mat` writes a MATLAB file.
`in_sections` is another form of its states, in which single precision does little harm.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_type_hints

import numpy as np
from pydantic import TypeAdapter

from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import matrix_response
from ident.data.arrays import lock
from ident.data.json_text import json_value
from ident.data.mat_files import mat_bytes

if TYPE_CHECKING:
    import control

# Fields that files hold as nested lists and the law as arrays.
_ARRAYS = ("A", "B", "C", "D", "anti_windup_gain")


@dataclass(frozen=True, eq=False)
class Law:
    """Discrete law x+ = A x + B e, output C x + D e, of n states, Y inputs and U outputs.

    Parameters
    ----------
    A, B, C, D : (n, n), (n, Y), (U, n), (U, Y) array
        Finite; read-only in the law.
    dt_s : float
        Sampling period in seconds, positive.

    Raises
    ------
    ValueError
        For shapes that do not fit, values that are not finite, or a period that is not positive.

    Notes
    -----
    A class of laws says what it is (`kind`) and what its fields mean (`equations`); both go into its files.
    Arrays of other numbers are taken as float64; what is no number is numpy's ValueError or TypeError.
    """

    kind: ClassVar[str]
    equations: ClassVar[str]

    A: Real
    B: Real
    C: Real
    D: Real
    dt_s: float

    def __post_init__(self) -> None:
        """Lock the matrices and check them (ValueError, see the class)."""
        lock(self, *"ABCD")
        n = self.A.shape[0]
        shapes = {name: getattr(self, name).shape for name in ("A", "B", "C", "D")}
        u, y = self.D.shape if self.D.ndim == 2 and self.D.size else (1, 1)
        if shapes != {"A": (n, n), "B": (n, y), "C": (u, n), "D": (u, y)}:
            raise ValueError(f"{self.kind} needs A (n, n), B (n, Y), C (U, n), D (U, Y); got {shapes}")
        for name in ("A", "B", "C", "D"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ValueError(f"{self.kind} matrix {name} has a value that is not finite")
        if not (self.dt_s > 0 and np.isfinite(self.dt_s)):
            raise ValueError(f"dt_s must be positive; got {self.dt_s}")
        # A numpy scalar is written otherwise in C and JSON.
        object.__setattr__(self, "dt_s", float(self.dt_s))

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def poles(self) -> Complex:
        """Poles in z, (n,) complex, the eigenvalues of A; in no order."""
        if self.order == 0:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def to_control(self) -> control.StateSpace:
        """The law as a discrete `control.StateSpace` of period dt_s, with matrices of its own (copies)."""
        # Imported here, because it brings a plotting library with it.
        import control

        return control.ss(np.array(self.A), np.array(self.B), np.array(self.C), np.array(self.D), self.dt_s)

    def response(self, omega_rad_s: Real) -> Complex:
        """Response at z = e^{j omega dt} for omega (F,) in rad/s: (F,) complex for one input and one output,
        else (F, U, Y). Raises numpy's LinAlgError exactly at a pole on the circle, such as 0 of an
        integrator."""
        response = matrix_response(self.to_control(), np.asarray(omega_rad_s, dtype=np.float64))
        if self.D.size == 1:
            return response[:, 0, 0]
        return response

    def to_dict(self) -> dict[str, Any]:
        """All fields and `named_systems` as numbers, words and lists for JSON; `from_dict` restores the law
        exactly, as floats are written with all their digits."""
        plain: dict[str, Any] = {"format": self.format_name(), "law": self.equations}
        for key, value in asdict(self).items():
            plain[key] = value.tolist() if isinstance(value, np.ndarray) else value
        for name, system in self.named_systems().items():
            plain[name] = {key: value.tolist() if key in _ARRAYS else value for key, value in system.items()}
        return plain

    def named_systems(self) -> dict[str, dict[str, Any]]:
        """State spaces (A, B, C, D, dt_s) that files hold by name beside the fields; reading ignores them.

        None here: a class that has some overrides it.
        """
        return {}

    @classmethod
    def format_name(cls) -> str:
        """Name of the format that a file of this kind says it has; the 1 is its version."""
        return f"flexlink-{cls.kind.replace(' ', '_')}-1"

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Law that `to_dict` wrote.

        Raises
        ------
        ValueError
            For another format, a key that is missing, or a value of the wrong type or size; the line names
            it. For shapes and values that do not fit, by the class. `data` has to be a mapping (not checked;
            `from_json` does); keys that are no fields are passed over. Messages quote 80 characters of a
            value at most, so that they stay one line.
        """
        if data.get("format") != cls.format_name():
            difference = f"format is {data.get('format')!r:.80}, expected {cls.format_name()!r}"
            raise ValueError(f"not a {cls.kind} file: {difference}")
        missing = [field.name for field in fields(cls) if field.name not in data]
        if missing:
            raise ValueError(f"{cls.kind} file lacks the key {missing[0]!r}")
        hints = get_type_hints(cls)
        values = {field.name: cls._read(field.name, hints[field.name], data) for field in fields(cls)}
        # Lists lose the shape of an empty matrix: it follows from the sizes of D and C.
        u, y = values["D"].shape if values["D"].ndim == 2 and values["D"].size else (1, 1)
        n = values["C"].size // u
        shapes = {"A": (n, n), "B": (n, y), "C": (u, n), "D": (u, y), "anti_windup_gain": (n, u)}
        for name in shapes.keys() & values.keys():
            if values[name] is None:
                continue
            if values[name].size != np.prod(shapes[name]):
                raise ValueError(f"{cls.kind} file: {name} has {values[name].size} numbers, C has {n}")
            values[name] = values[name].reshape(shapes[name])
        return cls(**values)

    @classmethod
    def _read(cls, name: str, hint: Any, data: Mapping[str, Any]) -> Any:
        """Value of the field `name` of a file: an array of numbers, or of the type that its annotation `hint`
        says. Raises ValueError naming the field, what was expected and what came."""
        value = data[name]
        # A gain that is not stated is found from the other fields.
        if value is None and name == "anti_windup_gain":
            return None
        try:
            if _holds_truth(value):
                raise TypeError
            if name in _ARRAYS:
                return np.array(value, dtype=np.float64)
            return TypeAdapter(hint).validate_python(value.item() if isinstance(value, np.generic) else value)
        except (TypeError, ValueError, OverflowError):
            expected = "an array of numbers" if name in _ARRAYS else str(getattr(hint, "__name__", hint))
            raise ValueError(f"{cls.kind} file: {name}: expected {expected}, got {value!r:.80}") from None

    def to_json(self) -> str:
        """The law as readable JSON text, ending in a new line, one space an indent.

        ValueError for a field that is nan or infinite, which JSON has not; matrices never are.
        """
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def to_mat(self) -> bytes:
        """The law as a MATLAB 5 file of all fields and `named_systems`, these as structs.

        A limit that is None is infinite (for several actuators a row); a feed-forward that is None and
        signals that nobody named are left out.
        """
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        feedforward = values.pop("feedforward", None)
        if feedforward is not None:
            values["feedforward"] = vars(feedforward)
        for name in ("signals", "gain_unit"):
            if not values.get(name):
                values.pop(name, None)
        for name, value in values.items():
            if isinstance(value, tuple):
                values[name] = np.array([np.inf if limit is None else limit for limit in value])
            elif value is None:
                values[name] = np.inf
        return mat_bytes(values | self.named_systems(), f"flexlink {self.kind}")

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Law that `to_json` wrote. Raises ValueError with one line for text that is no JSON or no such
        law."""
        try:
            data = json_value(text)
        except ValueError as error:
            raise ValueError(f"{cls.kind} JSON: {error}") from error
        if not isinstance(data, dict):
            raise ValueError(f"{cls.kind} JSON must be an object; got {type(data).__name__}")
        return cls.from_dict(data)


def in_sections(A: Real) -> tuple[Real, Real, Real]:
    """Real Schur form of the states of A (n, n): matrices S, T and T^-1, each (n, n), with A = T S T^-1.

    A has to be finite (scipy's ValueError); n may be 0.

    S is block triangular: sections of first and second order in a row, whose poles rounding moves by as much
    as it rounds, however close together they are.
    """
    # Imported here: every command would wait for it.
    from scipy.linalg import matrix_balance, schur

    balanced, (size, _) = matrix_balance(A, permute=False, separate=True)
    sections, rotation = schur(balanced)
    return sections, size[:, None] * rotation, rotation.T / size


def _holds_truth(value: Any) -> bool:
    """Whether a value of JSON is or holds, at any depth, a `true` or `false`, which Python would take for a
    number."""
    if isinstance(value, bool):
        return True
    if isinstance(value, dict):
        return any(_holds_truth(part) for part in value.values())
    if isinstance(value, list):
        return any(_holds_truth(part) for part in value)
    return False
