"""Which columns of a table are a frequency response, under the names that analysers and programs give them.

A column is a frequency, a gain, a phase, a real or an imaginary part by a word of its name, or by its unit
where no word says it (`response_columns`). `read_response` converts the columns to rad/s and complex numbers;
where a file has real and imaginary parts beside gain and phase, they have to agree. A unit that is not
stated, or not known, is asked for: dB and a factor, rad and degrees are never guessed. Of a `Table` matter
here `names`, `units` (by name, as the file has them beside the names), `place(row)` in words, and
`columns(names)`: finite numbers (K,) by name, or ValueError. Functions that take the name of a column take
any text, and raise nothing unless they say so. A number in `shown(text, 60)` is how many characters of it a
complaint quotes; it decides nothing.
"""

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
"""From the numbers (K,) of a column to those in rad/s, a factor, or rad."""


def _times(factor: float) -> Convert:
    """The conversion that takes numbers times a factor. numbers: (K,) of any size; not checked."""
    return lambda values: np.asarray(values * factor, dtype=np.float64)


def _from_db(values: RealArray) -> RealArray:
    """Factors (K,) of gains (K,) in dB: 20 dB are a factor of ten.

    Not checked: NaN stays NaN, more than 6160 dB are infinite.
    """
    return np.asarray(10 ** (values / 20), dtype=np.float64)


# Conversions by role and unit in lower case; real and imaginary parts are taken as they are. A turn is 2 pi
# rad, and a minute has 60 s.
_UNITS: Mapping[str, Mapping[str, Convert]] = {
    "frequency": {
        **dict.fromkeys(("hz", "1/s", "cycles/s"), _times(2 * np.pi)),
        **dict.fromkeys(("khz",), _times(2e3 * np.pi)),
        **dict.fromkeys(("rad/s", "rad/sec", "rads/sec", "rad/second", "rad/per/s", "rads"), _times(1.0)),
        **dict.fromkeys(("rpm", "1/min"), _times(2 * np.pi / 60)),
    },
    "gain": {
        "db": _from_db,
        **dict.fromkeys(("abs", "absolute", "1", "-", "lin", "linear", "ratio", "factor"), _times(1.0)),
    },
    "phase": {
        **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "º", "˚"), _times(np.pi / 180)),
        **dict.fromkeys(("rad", "radian", "radians"), _times(1.0)),
    },
    "real": {},
    "imag": {},
}
_KNOWN_UNITS = frozenset(unit for units in _UNITS.values() for unit in units)
# Words of a name, in lower case, by role.
_SPELLED = {
    "frequency": "frequency freq frequenz fréquence frecuencia f omega ω w hz",
    "gain": "gain mag magnitude amplitude ampl amp betrag modulus verstärkung abs db",
    "phase": "phase phas ph arg argument phi φ deg",
    "real": "re real realteil",
    "imag": "im imag imaginary imaginaer imaginär imaginärteil",
}
_WORDS = {role: frozenset(words.split()) for role, words in _SPELLED.items()}
# Roles in the order in which a name with words of several is tried: the word of a frequency may be that of
# what the column is at.
_ROLES_BY_RANK = ("real", "imag", "phase", "gain", "frequency")
# Beside such a word a column is about something else: its spread, its sign turned, its slope.
_SPELLED_OTHER = (
    "variance var std stddev sigma error err coherence coh covariance cov noise margin delay group lag "
    "attenuation difference reference"
)
_OTHER = frozenset(_SPELLED_OTHER.split())
# Units and letters, that count where no other word says what it is.
_SHORT = frozenset({"hz", "db", "deg", "f", "w", "amp", "re", "im"})
# Letters of a frequency that may be a force or a power.
_LETTERS_OF_FREQUENCY = frozenset({"f", "w"})
# Words of a gain that no signal of a log is called by.
_CLEARLY_GAIN = frozenset({"gain", "magnitude", "mag", "betrag", "db", "modulus"})
# Words of a time: such a table is a log.
_TIME_WORDS = frozenset({"time", "zeit", "timestamp", "t"})
# What is asked of a unit, and how to write it.
_ASKED = {
    "frequency": ("Hz or rad/s", "'Frequency (Hz)' or 'Frequency (rad/s)'"),
    "gain": ("a factor or in dB", "'Gain (abs)' or 'Gain (dB)'"),
    "phase": ("rad or degrees", "'Phase (rad)' or 'Phase (deg)'"),
}
# Where a word begins inside of another: gainDb, frequencyKHz.
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z][A-Za-z])")
# The magnitude in bars, '|G|', and a unit in the last brackets of a name.
_IN_BARS = re.compile(r"\s*\|.*\|")
_LAST_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$")
# What parts the words of a name.
_BETWEEN_WORDS = re.compile(r"[\s_./:,;\-\[\]()]+")
# Words at the end of a name that a unit has at most: 'rad per s'.
_MOST_UNIT_WORDS = 3
# Relative difference up to which two columns of one quantity agree: they may differ by the digits they are
# printed with. Three digits are off by .005 at most, two by .01 in the mean and .05 at worst: chosen between.
# Doubled or halved, no test of responses moves.
_AGREE = 0.02
# Share of the largest value below which a column is compared with this share instead: of a value near zero
# the last digit may be all. Doubled or halved, no test of responses moves.
_NEAR_ZERO = 1e-3


class DoubtError(ValueError):
    """The table is a frequency response, and something of it is not understood: asked for in one line.

    The line begins with the path.
    """


def response_columns(table: Table) -> dict[str, list[str]] | None:
    """The columns of a frequency response by their role; None where the table is none.

    Parameters
    ----------
    table : Table
        Named columns with their units.

    Returns
    -------
    dict of str to list of str, or None
        Names by role: 'frequency', and 'real' and 'imag', or 'gain' and 'phase', or all four, real and imag
        first. A role may have several columns of one quantity. None where there is no frequency, or a time.

    Raises
    ------
    DoubtError
        A part is missing, or there are two of the real or the imaginary part. One line that says what is not
        understood.
    """
    names: dict[str, list[str]] = {role: [] for role in _WORDS}
    for name in table.names:
        role = _role(name, _stated(table, name))
        if role is not None:
            names[role].append(name)

    # An amplitude beside a frequency may be anything: a word for a gain, a phase, or both parts tell.
    is_rectangular = bool(names["real"] and names["imag"])
    is_polar = bool(names["phase"]) or any(_words(name) & _CLEARLY_GAIN for name in names["gain"])
    has_time = any(_words(name) & _TIME_WORDS for name in table.names)
    if not names["frequency"] or has_time or not (is_polar or is_rectangular):
        return None
    wanted = ["real", "imag"] if is_rectangular else ["gain", "phase"]
    lacking = [role for role in wanted if not names[role]]
    if lacking:
        listed = shown(", ".join(shown(name, 30) for name in table.names), 120)
        raise DoubtError(
            f"{table.path}: a frequency response without {lacking[0]}: it needs real and imag, or gain and "
            f"phase; found {listed}"
        )
    if is_rectangular:
        for role in wanted:
            if len(names[role]) > 1:
                raise DoubtError(
                    f"{table.path}: {' and '.join(map(repr, names[role]))} are both {role} parts: keep the "
                    "columns of one response"
                )
        if names["gain"] and names["phase"]:
            wanted += ["gain", "phase"]
    return {role: names[role] for role in ("frequency", *wanted)}


def has_response(table: Table) -> bool:
    """Whether the table is a frequency response, understood or not. Cells are not looked at.

    False for a table without columns.
    """
    try:
        return response_columns(table) is not None
    except DoubtError:
        return True


def read_response(table: Table) -> tuple[RealArray, ComplexArray]:
    """The frequency response of a table that has to be one.

    Parameters
    ----------
    table : Table
        Named columns with their units.

    Returns
    -------
    omega_rad_s : ndarray, shape (K,)
        In the order of the file.
    response : ndarray, shape (K,)
        In the unit of its real part or its gain.

    Raises
    ------
    DoubtError
        A unit is not stated or not known, a part is missing, or columns of one quantity contradict each
        other by more than `_AGREE`: of the larger of the first one's value and `_NEAR_ZERO` of its largest.
    ValueError
        The table is no frequency response, or a column holds no finite numbers.
    """
    columns = response_columns(table)
    if columns is None:
        roles = {_role(name, _stated(table, name)) for name in table.names}
        need = "one of real, imag and gain, phase_rad"
        if "frequency" not in roles:
            need = "exactly one of the columns omega_rad_s, frequency_Hz"
        elif "real" in roles:
            need += "; no column 'imag'"
        elif "imag" in roles:
            need += "; no column 'real'"
        listed = ", ".join(shown(name, 30) for name in table.names)
        raise ValueError(f"{table.path}, line 1: need {need}; the file has {shown(listed, 120)}")

    # Every column in rad/s, as a factor, or in rad.
    conversions = dict[str, Convert]()
    for role, names in columns.items():
        for name in names:
            conversions[name] = _conversion(table, role, name, columns)
    raw_numbers = table.columns(list(conversions))
    values = {name: conversions[name](numbers) for name, numbers in raw_numbers.items()}

    # Several columns of one role are one quantity in several units.
    for first_name, *other_names in columns.values():
        first = values[first_name]
        for other_name in other_names:
            smallest_scale = _NEAR_ZERO * np.max(np.abs(first), initial=0.0)
            scale = np.maximum(np.abs(first), smallest_scale)
            is_apart = np.abs(values[other_name] - first) > _AGREE * scale
            _refuse_apart(table, is_apart, first_name, other_name)

    # Real and imaginary parts count where there are both forms, which have to agree.
    of_role = {role: values[names[0]] for role, names in columns.items()}
    omega_rad_s = of_role["frequency"]
    polar: ComplexArray | None = None
    if "gain" in of_role:
        polar = of_role["gain"] * np.exp(1j * of_role["phase"])
        if "real" not in of_role:
            return omega_rad_s, polar
    response: ComplexArray = of_role["real"] + 1j * of_role["imag"]
    if polar is not None and polar.size:
        is_apart = np.abs(polar - response) > _AGREE * np.abs(response)
        rectangular_names = f"{columns['real'][0]} and {columns['imag'][0]}"
        polar_names = f"{columns['gain'][0]} and {columns['phase'][0]}"
        _refuse_apart(table, is_apart, rectangular_names, polar_names)
    return omega_rad_s, response


def _conversion(table: Table, role: str, name: str, columns: Mapping[str, Sequence[str]]) -> Convert:
    """The conversion of a column of a role from its unit; columns: names by role.

    role: a key of `_UNITS`, KeyError for another. Raises DoubtError where the unit is not stated or not
    known.
    """
    units = _UNITS[role]
    if not units:
        return _times(1.0)
    unit = _unit(name, _stated(table, name))
    if unit in units:
        return units[unit]
    if role == "frequency" and not unit and _words(name) & {"omega", "ω"}:
        return units["rad/s"]
    # The table of our own documentation: gain beside phase_rad is a factor.
    if name == "gain" and not unit and "phase_rad" in columns.get("phase", ()):
        return units["abs"]
    # A gain of one unit per another, as rad/V, is a factor.
    if role == "gain" and re.fullmatch(r"\S+/\S+", unit) and "db" not in unit:
        return units["abs"]
    what, write = _ASKED[role]
    why = f"Unit '{shown(unit, 20)}' is not known. " if unit else "Its name does not say. "
    raise DoubtError(f"{table.path}: is {shown(name, 60)!r} {what}? {why}Call the column {write} in the file")


def _stated(table: Table, name: str) -> str:
    """The unit of a column as it is written, or empty.

    It is not put into another spelling: 'grad' may be a degree or a gradian, and is asked for. Of a name that
    is no column the text alone is read.
    """
    return written_unit(name) or table.units.get(name, "")


def _role(name: str, unit: str) -> str | None:
    """What a column is by the words of its name, a key of `_WORDS`; None where it is none of these.

    unit: as written, which decides between words of several roles. Units in the name count where no other
    word says what it is. An empty unit decides nothing. None, too, for a name without letters, unless it
    stands in bars.
    """
    words = _words(name)
    if words & _OTHER:
        return None
    # A force in N, a power in W.
    if words & _LETTERS_OF_FREQUENCY:
        unit_of_letter = _unit(name, unit)
        if unit_of_letter and unit_of_letter not in _UNITS["frequency"]:
            return None
    if _IN_BARS.match(unicodedata.normalize("NFKC", name)):
        return "gain"
    roles = [role for role in _ROLES_BY_RANK if words & _WORDS[role]]
    by_long_words = [role for role in roles if words & (_WORDS[role] - _SHORT)]
    roles = by_long_words or roles
    if not roles:
        return None
    # 'Trace 1: Gain: Phase (°)': what the unit is of.
    if len(roles) > 1:
        known_unit = _unit(name, unit)
        for role in roles:
            if known_unit in _UNITS[role]:
                return role
    return roles[0]


def _words(name: str) -> frozenset[str]:
    """Words of a name in lower case, parted at blanks, signs and capitals.

    Empty for a name without letters.
    """
    words = _CAMEL.sub(" ", unicodedata.normalize("NFKC", name)).lower()
    return frozenset(re.findall(r"[^\W\d_]+", words))


def _unit(name: str, stated: str) -> str:
    """The unit of a column in lower case, or empty.

    What the file states, else what stands in the last brackets of the name, else its last words.

    stated: as written, or empty. A unit that is not known comes back as it is stated; empty where none is,
    or where it is a single letter in brackets: of 'Re(G)' and '|G| (dB)' only the latter is a unit.
    """
    text = unicodedata.normalize("NFKC", stated).strip().lower().strip("[]() ")
    text = text.replace(" ", "").replace("·", "")
    if text in _KNOWN_UNITS:
        return text
    with_slashes = text.replace("_", "/")
    if with_slashes in _KNOWN_UNITS:
        return with_slashes

    # In the last brackets of the name.
    plain_name = unicodedata.normalize("NFKC", name).strip()
    bracketed = _LAST_BRACKETS.search(plain_name.lower())
    if bracketed:
        in_brackets = bracketed[1].replace(" ", "")
        if in_brackets in _KNOWN_UNITS:
            return in_brackets

    # Its last words, the longest unit first. 'abs' alone may be any magnitude.
    name_in_words = _CAMEL.sub(" ", unicodedata.normalize("NFKC", name)).lower()
    words = _BETWEEN_WORDS.split(name_in_words.strip("[]() "))
    for count in range(_MOST_UNIT_WORDS, 0, -1):
        if len(words) < count:
            continue
        last_words = "/".join(word for word in words[-count:] if word)
        is_abs_alone = last_words == "abs" and len(words) == 1
        if last_words in _KNOWN_UNITS and not is_abs_alone:
            return last_words
    is_argument = bracketed is not None and text == bracketed[1] and re.fullmatch(r"\w", text) is not None
    return "" if is_argument else text


def _refuse_apart(table: Table, is_apart: BoolArray, name: str, other_name: str) -> None:
    """Raise DoubtError where two columns, or pairs of them, contradict each other; is_apart (K,): by row.

    name, other_name: as they are quoted. Nothing for no row.
    """
    if np.any(is_apart):
        place = table.place(int(np.argmax(is_apart)))
        raise DoubtError(
            f"{table.path}, {place}: {shown(name, 60)} and {shown(other_name, 60)} contradict each other: "
            "keep the columns of one response"
        )
