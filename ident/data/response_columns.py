"""Which columns of a table are a frequency response, under the names that analysers and programs give them:
by a word of the name, and the unit stated. A unit that is not stated is asked for."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ident.data.arrays import BoolArray, ComplexArray, RealArray
from ident.data.foreign_files import shown
from ident.data.table import Table
from ident.data.units import written_unit

Convert = Callable[[RealArray], RealArray]


def _times(factor: float) -> Convert:
    return lambda values: np.asarray(values * factor, dtype=np.float64)


_UNITS: Mapping[str, Mapping[str, Convert]] = {
    "frequency": {
        **dict.fromkeys(("hz", "1/s", "cycles/s"), _times(2 * np.pi)),
        **dict.fromkeys(("khz",), _times(2e3 * np.pi)),
        **dict.fromkeys(("rad/s", "rad/sec", "rads/sec", "rad/second", "rad/per/s", "rads"), _times(1.0)),
        **dict.fromkeys(("rpm", "1/min"), _times(2 * np.pi / 60)),
    },
    "gain": {
        "db": lambda values: np.asarray(10 ** (values / 20), dtype=np.float64),
        **dict.fromkeys(("abs", "absolute", "1", "-", "lin", "linear", "ratio", "factor"), _times(1.0)),
    },
    "phase": {
        **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "º", "˚"), _times(np.pi / 180)),
        **dict.fromkeys(("rad", "radian", "radians"), _times(1.0)),
    },
    "real": {},
    "imag": {},
}
_SPELLED = {
    "frequency": "frequency freq frequenz fréquence frecuencia f omega ω w hz",
    "gain": "gain mag magnitude amplitude ampl amp betrag modulus verstärkung abs db",
    "phase": "phase phas ph arg argument phi φ deg",
    "real": "re real realteil",
    "imag": "im imag imaginary imaginaer imaginär imaginärteil",
}
_WORDS = {role: frozenset(words.split()) for role, words in _SPELLED.items()}
# Beside such a word a column is about something else: its spread, its sign turned, its slope.
_SPELLED_OTHER = (
    "variance var std stddev sigma error err coherence coh covariance cov noise margin delay group lag "
    "attenuation difference reference"
)
_OTHER = frozenset(_SPELLED_OTHER.split())
# Units and letters, that count where no other word says what it is.
_SHORT = frozenset({"hz", "db", "deg", "f", "w", "amp", "re", "im"})
# Words of a gain that no signal of a log is called by.
_CLEARLY = frozenset({"gain", "magnitude", "mag", "betrag", "db", "modulus"})
_ASKED = {
    "frequency": ("Hz or rad/s", "'Frequency (Hz)' or 'Frequency (rad/s)'"),
    "gain": ("a factor or in dB", "'Gain (abs)' or 'Gain (dB)'"),
    "phase": ("rad or degrees", "'Phase (rad)' or 'Phase (deg)'"),
}
# Two columns of one quantity may differ by the digits they are printed with.
_AGREE = 0.02


class DoubtError(ValueError):
    """The table is a frequency response, and something of it is not understood: asked for in one line."""


def response_columns(table: Table) -> dict[str, list[str]] | None:
    """The columns of a frequency response by their role, those of real and imag or of gain and phase first;
    None where the table is none: it has no frequency, or a time.

    Raises DoubtError: one line that says what is not understood and what to write.
    """
    found: dict[str, list[str]] = {role: [] for role in _WORDS}
    for name in table.names:
        role = _role(name, _stated(table, name))
        if role is not None:
            found[role].append(name)
    rectangular = bool(found["real"] and found["imag"])
    polar = bool(found["phase"]) or any(_words(name) & _CLEARLY for name in found["gain"])
    timed = any(_words(name) & {"time", "zeit", "timestamp", "t"} for name in table.names)
    if not found["frequency"] or not (polar or rectangular) or timed:
        return None
    wanted = ("real", "imag") if rectangular else ("gain", "phase")
    lacking = [role for role in wanted if not found[role]]
    if lacking:
        listed = shown(", ".join(shown(name, 30) for name in table.names), 120)
        raise DoubtError(
            f"{table.path}: a frequency response without {lacking[0]}: it needs real and imag, or gain and "
            f"phase; found {listed}"
        )
    if rectangular:
        for role in wanted:
            if len(found[role]) > 1:
                raise DoubtError(
                    f"{table.path}: {' and '.join(map(repr, found[role]))} are both {role} parts: keep the "
                    "columns of one response"
                )
    both = rectangular and bool(found["gain"] and found["phase"])
    used = ("frequency", *wanted, *(("gain", "phase") if both else ()))
    return {role: found[role] for role in used}


def has_response(table: Table) -> bool:
    """Whether the table is a frequency response, understood or not."""
    try:
        return response_columns(table) is not None
    except DoubtError:
        return True


def read_response(table: Table) -> tuple[RealArray, ComplexArray]:
    """omega (K,) in rad/s and response (K,) of a table that has to be one. Raises ValueError."""
    columns = response_columns(table)
    if columns is None:
        found = {_role(name, _stated(table, name)) for name in table.names}
        need = "one of real, imag and gain, phase_rad"
        if "frequency" not in found:
            need = "exactly one of the columns omega_rad_s, frequency_Hz"
        elif {"real", "imag"} & found:
            need += f"; no column {'imag' if 'real' in found else 'real'!r}"
        listed = ", ".join(shown(name, 30) for name in table.names)
        raise ValueError(f"{table.path}, line 1: need {need}; the file has {shown(listed, 120)}")
    convert = {
        name: _conversion(table, role, name, columns) for role, names in columns.items() for name in names
    }
    given = table.columns(list(convert))
    values = {name: convert[name](numbers) for name, numbers in given.items()}
    for one, *others in columns.values():
        for two in others:
            scale = np.maximum(np.abs(values[one]), 1e-3 * np.max(np.abs(values[one]), initial=0.0))
            _refuse_apart(table, np.abs(values[two] - values[one]) > _AGREE * scale, one, two)
    of = {role: values[names[0]] for role, names in columns.items()}
    polar: ComplexArray = of["gain"] * np.exp(1j * of["phase"]) if "gain" in of else np.zeros(0, complex)
    response: ComplexArray = of["real"] + 1j * of["imag"] if "real" in of else polar
    if "real" in of and polar.size:
        pairs = [
            " and ".join(columns[role][0] for role in two) for two in (("real", "imag"), ("gain", "phase"))
        ]
        _refuse_apart(table, np.abs(polar - response) > _AGREE * np.abs(response), *pairs)
    return of["frequency"], response


def _conversion(table: Table, role: str, name: str, found: Mapping[str, Sequence[str]]) -> Convert:
    units = _UNITS[role]
    if not units:
        return _times(1.0)
    unit = _unit(name, _stated(table, name))
    if unit in units:
        return units[unit]
    if role == "frequency" and not unit and _words(name) & {"omega", "ω"}:
        return units["rad/s"]
    # The table of our own documentation: gain beside phase_rad is a factor.
    if name == "gain" and not unit and "phase_rad" in found.get("phase", ()):
        return units["abs"]
    if role == "gain" and re.fullmatch(r"\S+/\S+", unit) and "db" not in unit:
        return units["abs"]  # of one unit per another, as rad/V
    what, write = _ASKED[role]
    raise DoubtError(
        f"{table.path}: is {shown(name, 60)!r} {what}? "
        + (f"Unit '{shown(unit, 20)}' is not known. " if unit else "Its name does not say. ")
        + f"Call the column {write} in the file"
    )


def _stated(table: Table, name: str) -> str:
    """The unit as it is written: 'grad' may be a degree or a gradian, and is asked for."""
    return written_unit(name) or table.units.get(name, "")


def _role(name: str, unit: str) -> str | None:
    """What a column is by the words of its name; by its unit where these are none that is known."""
    words, plain = _words(name), unicodedata.normalize("NFKC", name)
    if words & _OTHER:
        return None
    if words & {"f", "w"} and (stated := _unit(name, unit)) and stated not in _UNITS["frequency"]:
        return None  # a force in N, a power in W
    if re.match(r"\s*\|.*\|", plain):
        return "gain"
    hits = [role for role in ("real", "imag", "phase", "gain", "frequency") if words & _WORDS[role]]
    hits = [role for role in hits if words & _WORDS[role] - _SHORT] or hits
    if len(hits) > 1:
        # 'Trace 1: Gain: Phase (°)': what the unit is of.
        hits = [role for role in hits if _unit(name, unit) in _UNITS[role]] or hits[:1]
    return hits[0] if hits else None


def _words(name: str) -> frozenset[str]:
    """Words of a name in lower case, parted at blanks, signs and capitals."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z][A-Za-z])", " ", unicodedata.normalize("NFKC", name)).lower()
    return frozenset(re.findall(r"[^\W\d_]+", parted))


def _unit(name: str, stated: str) -> str:
    """The unit in lower case: what the file states, else in the last brackets, else the last words."""
    # Of 'Re(G)' and '|G| (dB)' only the latter is a unit.
    plain = unicodedata.normalize("NFKC", name).strip().lower()
    text = unicodedata.normalize("NFKC", stated).strip().lower().strip("[]() ")
    text = text.replace(" ", "").replace("·", "")
    known = {unit for units in _UNITS.values() for unit in units}
    if text in known or text.replace("_", "/") in known:
        return text if text in known else text.replace("_", "/")
    bracket = re.search(r"[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$", plain)
    if bracket and bracket[1].replace(" ", "") in known:
        return bracket[1].replace(" ", "")
    parted = re.sub(r"(?<=[a-z])(?=[A-Z][A-Za-z])", " ", unicodedata.normalize("NFKC", name)).lower()
    words = re.split(r"[\s_./:,;\-\[\]()]+", parted.strip("[]() "))
    for count in (3, 2, 1):
        last = "/".join(word for word in words[-count:] if word)
        if len(words) >= count and last in known and not (last == "abs" and len(words) == 1):
            return last
    return "" if bracket and text == bracket[1] and re.fullmatch(r"\w", text) else text


def _refuse_apart(table: Table, apart: BoolArray, one: str, two: str) -> None:
    if np.any(apart):
        raise DoubtError(
            f"{table.path}, {table.place(int(np.argmax(apart)))}: {shown(one, 60)} and {shown(two, 60)} "
            "contradict each other: keep the columns of one response"
        )
