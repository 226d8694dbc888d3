"""What controller and reference filter have in common: a checked state space, kept as JSON."""

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

_ARRAYS = ("A", "B", "C", "D", "anti_windup_gain")


@dataclass(frozen=True, eq=False)
class Law:
    """x+ = A x + B e, C x + D e: A (n, n), B (n, Y), C (U, n), D (U, Y), read-only; dt_s > 0."""

    kind: ClassVar[str]
    equations: ClassVar[str]

    A: Real
    B: Real
    C: Real
    D: Real
    dt_s: float

    def __post_init__(self) -> None:
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
        object.__setattr__(self, "dt_s", float(self.dt_s))  # of numpy: not as C or JSON would have it

    @property
    def order(self) -> int:
        return int(self.A.shape[0])

    @property
    def poles(self) -> Complex:
        """Poles in z, (n,)."""
        if self.order == 0:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def to_control(self) -> control.StateSpace:
        """As `control.StateSpace`."""
        import control  # here, because it brings a plotting library with it

        return control.ss(np.array(self.A), np.array(self.B), np.array(self.C), np.array(self.D), self.dt_s)

    def response(self, omega_rad_s: Real) -> Complex:
        """Response at z = e^{j omega dt}, (F,) of one loop, else (F, U, Y)."""
        found = matrix_response(self.to_control(), np.asarray(omega_rad_s, dtype=np.float64))
        return found[:, 0, 0] if self.D.size == 1 else found

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; `from_dict` restores it exactly (floats are written with all their digits)."""
        plain = {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in asdict(self).items()
        }
        for name, system in self.named_systems().items():
            plain[name] = {key: value.tolist() if key in _ARRAYS else value for key, value in system.items()}
        return {"format": self.format_name(), "law": self.equations, **plain}

    def named_systems(self) -> dict[str, dict[str, Any]]:
        """State spaces (A, B, C, D, dt_s) that files hold by name beside the fields; reading ignores them."""
        return {}

    @classmethod
    def format_name(cls) -> str:
        """What a file of this kind says it is."""
        return f"flexlink-{cls.kind.replace(' ', '_')}-1"

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Inverse of `to_dict`; ValueError if it is not of this format, naming a key it lacks."""
        if data.get("format") != cls.format_name():
            found = f"format is {data.get('format')!r:.80}, expected {cls.format_name()!r}"
            raise ValueError(f"not a {cls.kind} file: {found}")
        missing = [field.name for field in fields(cls) if field.name not in data]
        if missing:
            raise ValueError(f"{cls.kind} file lacks the key {missing[0]!r}")
        hints = get_type_hints(cls)
        values = {field.name: cls._read(field.name, hints[field.name], data) for field in fields(cls)}
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
        """A field of a file: an array of numbers, or what its annotation says."""
        value = data[name]
        if value is None and name == "anti_windup_gain":  # to be found from the rest
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
        """Readable JSON text."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def to_mat(self) -> bytes:
        """MATLAB 5 file of all fields and `named_systems` (structs); a limit that is None is infinite (one
        per actuator: a row), a feed-forward that is None and signals that nobody named are left out."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        given = values.pop("feedforward", None)
        if given is not None:
            values["feedforward"] = vars(given)
        if not values.get("signals"):
            values.pop("signals", None)
        for name, value in values.items():
            if isinstance(value, tuple):
                values[name] = np.array([np.inf if one is None else one for one in value])
        values = {name: np.inf if value is None else value for name, value in values.items()}
        return mat_bytes(values | self.named_systems(), f"flexlink {self.kind}")

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Inverse of `to_json`; ValueError with one line on bad input."""
        try:
            data = json_value(text)
        except ValueError as error:
            raise ValueError(f"{cls.kind} JSON: {error}") from error
        if not isinstance(data, dict):
            raise ValueError(f"{cls.kind} JSON must be an object; got {type(data).__name__}")
        return cls.from_dict(data)


def in_sections(A: Real) -> tuple[Real, Real, Real]:
    """(S, T, T^-1), A = T S T^-1 for states in real Schur form: sections in a row, whose poles rounding moves
    by as much as it rounds, however close together they are."""
    from scipy.linalg import matrix_balance, schur  # here: every command would wait for it

    balanced, (size, _) = matrix_balance(A, permute=False, separate=True)
    own, turn = schur(balanced)
    return own, size[:, None] * turn, turn.T / size


def _holds_truth(value: Any) -> bool:
    """Whether there is a `true` or `false`, which is no number, in a value of JSON."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return isinstance(value, bool) or any(map(_holds_truth, parts))
