"""One codec for every result: frozen dataclasses to JSON and named arrays, and back by their annotations.

A dataclass becomes an object of its fields, an enum its name, an array a reference into the archive beside
the document; non-finite and complex numbers are tagged. Fields that are functions, or not to be stored
(`ident.data.shown.NOT_STORED`), are left out and come back as their defaults. A field that is missing or
unknown, or of another kind, is refused in one line.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import json
import math
import types
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from ident.data.foreign_files import shown
from workflow.engine.errors import shortened

T = TypeVar("T")
AnyArray = npt.NDArray[Any]

# Name under which the document travels among the arrays of an archive.
DOCUMENT = "_document"
# Key of an object that stands for an array: its value is the array's name in the archive.
_ARRAY = "$array"
# Key of an object that stands for a number that is not finite.
_FLOAT = "$float"
# Key of an object that stands for a complex number.
_COMPLEX = "$complex"
# Key under which the fields of a dataclass name their class.
_TYPE = "$type"
# Keys that no stored mapping may use.
_TAGS = (_ARRAY, _FLOAT, _COMPLEX, _TYPE)
# Both ways to write "one of these types".
_UNIONS = (Union, types.UnionType)


class CodecError(ValueError):
    """The document is not that of the type asked for; one line."""


def pack(value: Any) -> tuple[Any, dict[str, AnyArray]]:
    """JSON-able document, and the arrays it refers to by name. Raises TypeError for what cannot be stored."""
    arrays: dict[str, AnyArray] = {}
    return _pack(value, "", arrays), arrays


def unpack(kind: type[T], document: Any, arrays: Mapping[str, AnyArray]) -> T:
    """Inverse of `pack`. Raises CodecError naming the place in the document."""
    value: T = _unpack(kind, document, arrays, getattr(kind, "__name__", "result"))
    return value


def to_arrays(value: Any) -> dict[str, AnyArray]:
    """A value as named arrays alone, for one npz file: the document travels as UTF-8 text under `DOCUMENT`.

    Raises TypeError for what cannot be stored.
    """
    document, arrays = pack(value)
    # As bytes: a unicode array would drop trailing NULs and take four bytes each.
    text = json.dumps(document, ensure_ascii=False).encode("utf-8")
    return {DOCUMENT: np.frombuffer(text, dtype=np.uint8), **arrays}


def from_arrays(kind: type[T], arrays: Mapping[str, AnyArray]) -> T:
    """Inverse of `to_arrays`. Raises CodecError."""
    if DOCUMENT not in arrays:
        raise CodecError(f"holds no {getattr(kind, '__name__', kind)}: {DOCUMENT!r} is missing")
    try:
        document = json.loads(arrays[DOCUMENT].tobytes().decode("utf-8"))
    except (ValueError, RecursionError):
        raise CodecError(f"{DOCUMENT!r} is damaged: not JSON") from None
    return unpack(kind, document, arrays)


def plain(value: Any, *, arrays: bool = True) -> Any:
    """A value as nested lists and objects, for other programs that read JSON; it is not read back.

    Arrays and tuples become lists, complex numbers [re, im], numbers that are not finite null. arrays: False
    leaves out the fields of dataclasses that are arrays.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = {name: getattr(value, name) for name in stored_fields(type(value))}
        return {
            name: plain(item, arrays=arrays)
            for name, item in items.items()
            if arrays or not isinstance(item, np.ndarray)
        }
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Mapping):
        return {str(key): plain(item, arrays=arrays) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item, arrays=arrays) for item in value]
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def plain_text(value: Any, *, ascii_only: bool = False) -> str:
    """`plain` as strict JSON; equal values give equal text. ascii_only: other characters as escapes."""
    return json.dumps(plain(value), indent=1, ensure_ascii=ascii_only, allow_nan=False) + "\n"


def bare(kind: Any) -> Any:
    """An annotation without its names and notes: what `type X = ...`, NewType, Annotated and Final stand for.

    NDArray[float64] is such a name since numpy 2.5, and ndarray[...] itself before.
    """
    while True:
        origin = get_origin(kind)
        alias = origin if hasattr(origin, "__value__") else kind
        if hasattr(alias, "__value__"):
            kind = _written_out(
                alias.__value__, dict(zip(alias.__type_params__, get_args(kind), strict=False))
            )
        elif origin in (Annotated, Final):
            kind = get_args(kind)[0]
        elif hasattr(kind, "__supertype__"):
            kind = kind.__supertype__
        else:
            return kind


def _written_out(kind: Any, meant: Mapping[Any, Any]) -> Any:
    """The right side of an alias with its parameters replaced; one that is not given stays open."""
    if isinstance(kind, TypeVar):
        return meant.get(kind, Any)
    left = getattr(kind, "__parameters__", ())
    return kind[tuple(meant.get(name, Any) for name in left)] if left else kind


@cache
def stored_fields(kind: type) -> dict[str, Any]:
    """Name and annotation of the fields of a dataclass that are data."""
    hints = get_type_hints(kind, include_extras=True)
    stored = [f for f in dataclasses.fields(kind) if f.init and f.metadata.get("stored", True)]
    known = {f.name: bare(hints[f.name]) for f in stored}
    return {name: k for name, k in known.items() if get_origin(k) is not collections.abc.Callable}


def _pack(value: Any, at: str, arrays: dict[str, AnyArray]) -> Any:
    """A value as JSON-able document; arrays: those it refers to, by their place in it. at: that place."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value.name if isinstance(value, Enum) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else {_FLOAT: repr(value)}
    if isinstance(value, complex):
        return {_COMPLEX: [_pack(value.real, at, arrays), _pack(value.imag, at, arrays)]}
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{at}: an array of objects would need pickle")
        # Row by row: what is read back has the memory layout of what any other run reads back.
        arrays[at] = np.ascontiguousarray(value).reshape(value.shape)
        return {_ARRAY: at}
    if dataclasses.is_dataclass(value):
        kind: Any = type(value)
        return {
            _TYPE: kind.__name__,
            **{n: _pack(getattr(value, n), _join(at, n), arrays) for n in stored_fields(kind)},
        }
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        if any(not isinstance(key, str) or key in _TAGS for key in value):
            raise TypeError(
                f"{at}: keys must be strings, and none of {', '.join(_TAGS)}; got {sorted(map(str, value))}"
            )
        return {key: _pack(item, _join(at, key), arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_pack(item, _join(at, str(i)), arrays) for i, item in enumerate(value)]
    raise TypeError(f"{at}: a {type(value).__name__} cannot be stored")


def _join(at: str, name: str) -> str:
    return f"{at}/{name}" if at else name


def _unpack(kind: Any, document: Any, arrays: Mapping[str, AnyArray], at: str) -> Any:
    """A value of a kind from its document. at: its place, for a complaint. Raises CodecError."""
    kind = bare(kind)
    origin = get_origin(kind)
    if origin in _UNIONS:
        return _unpack(_member(kind, document, at), document, arrays, at)
    if kind is Any or kind is object:
        return _unpack_plain(document, arrays, at)
    if kind is None or kind is type(None):
        _expect(document is None, document, at, "null")
        return None
    if origin is Literal:
        _expect(document in get_args(kind), document, at, f"one of {', '.join(map(repr, get_args(kind)))}")
        return document
    if origin is np.ndarray or kind is np.ndarray:
        return _unpack_array(kind, document, arrays, at)
    if isinstance(origin, type) and issubclass(origin, tuple):
        parts = get_args(kind)
        _expect(isinstance(document, list), document, at, "a list")
        if len(parts) == 2 and parts[1] is Ellipsis:
            parts = (parts[0],) * len(document)
        _expect(len(parts) == len(document), document, at, f"{len(parts)} entries")
        each = enumerate(zip(parts, document, strict=True))
        return tuple(_unpack(part, item, arrays, f"{at}[{i}]") for i, (part, item) in each)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        _expect(isinstance(document, dict), document, at, "an object")
        return {
            key: _unpack(get_args(kind)[1], item, arrays, f"{at}.{key}") for key, item in document.items()
        }
    if isinstance(origin, type) and issubclass(origin, collections.abc.Sequence):
        _expect(isinstance(document, list), document, at, "a list")
        return [_unpack(get_args(kind)[0], item, arrays, f"{at}[{i}]") for i, item in enumerate(document)]
    if dataclasses.is_dataclass(kind):
        return _unpack_dataclass(kind, document, arrays, at)
    if isinstance(kind, type):
        return _unpack_scalar(kind, document, at)
    raise CodecError(f"{at}: {kind} cannot be read back")


def _unpack_dataclass(kind: Any, document: Any, arrays: Mapping[str, AnyArray], at: str) -> Any:
    """A dataclass from its fields. Raises CodecError for a field too many, or one that is missing."""
    _expect(isinstance(document, dict), document, at, f"an object with the fields of {kind.__name__}")
    fields = stored_fields(kind)
    strange = sorted(set(document) - set(fields) - {_TYPE})
    # A field that earlier versions did not have comes back as its default.
    later = {f.name for f in dataclasses.fields(kind) if "since" in f.metadata}
    missing = sorted(set(fields) - set(document) - later)
    if strange or missing or document.get(_TYPE, kind.__name__) != kind.__name__:
        wrong = [f"unknown field '{shown(name)}'" for name in strange]
        wrong += [f"missing field {name!r}" for name in missing] or ["is"]
        raise CodecError(f"{at}: {wrong[0]} ({shown(document.get(_TYPE))}, expected {kind.__name__})")
    values = {
        name: _unpack(hint, document[name], arrays, f"{at}.{name}")
        for name, hint in fields.items()
        if name in document
    }
    try:
        return kind(**values)
    except ValueError as error:
        raise CodecError(f"{at}: {error}") from error


def _unpack_array(kind: Any, document: Any, arrays: Mapping[str, AnyArray], at: str) -> AnyArray:
    """The array that a document refers to. Raises CodecError where it is not there or of another kind."""
    name = document.get(_ARRAY) if isinstance(document, dict) else None
    _expect(isinstance(name, str) and name in arrays, document, at, "an array that is in the archive")
    array = arrays[str(name)]
    # The annotation is ndarray[shape, dtype[number]]; one that says less holds whatever there is.
    wanted = next(iter(get_args(bare(get_args(kind)[1]))), None) if get_args(kind) else None
    if isinstance(wanted, type) and not np.can_cast(array.dtype, wanted, "same_kind"):
        raise CodecError(f"{at}: holds {shown(str(array.dtype))}, expected {wanted.__name__}")
    return array


def _unpack_scalar(kind: type, document: Any, at: str) -> Any:
    """A single value. Raises CodecError for one of another kind."""
    if issubclass(kind, Enum):
        _expect(document in kind.__members__, document, at, f"one of {', '.join(kind.__members__)}")
        return kind[document]
    if issubclass(kind, BaseModel):
        return kind.model_validate(document)
    if issubclass(kind, Path):
        return kind(document)
    if isinstance(document, dict):
        document = _unpack_plain(document, {}, at)
    if kind is float and isinstance(document, int) and not isinstance(document, bool):
        return float(document)
    _expect(
        isinstance(document, kind) and (kind is bool) == isinstance(document, bool),
        document,
        at,
        kind.__name__,
    )
    return document


def _unpack_plain(document: Any, arrays: Mapping[str, AnyArray], at: str) -> Any:
    """A value without an annotation of its own."""
    if isinstance(document, list):
        return [_unpack_plain(item, arrays, f"{at}[{i}]") for i, item in enumerate(document)]
    if not isinstance(document, dict):
        return document
    try:
        if document.keys() == {_FLOAT}:
            return float(document[_FLOAT])
        if document.keys() == {_COMPLEX}:
            return complex(*(_unpack_plain(part, arrays, at) for part in document[_COMPLEX]))
    except (TypeError, ValueError):
        raise CodecError(f"{at}: expected a number, got {shortened(document)}") from None
    if document.keys() == {_ARRAY}:
        return _unpack_array(np.ndarray, document, arrays, at)
    return {key: _unpack_plain(item, arrays, f"{at}.{key}") for key, item in document.items()}


def _member(union: Any, document: Any, at: str) -> Any:
    """The member of a union that a document is of: null, by its tag, a tuple for a list, else the first
    whose type fits. Raises CodecError where a tag is of none of them."""
    members = tuple(_members(union))
    if document is None and type(None) in members:
        return type(None)
    candidates = [member for member in members if member is not type(None)]
    if isinstance(document, dict) and _TYPE in document:
        candidates = [member for member in candidates if getattr(member, "__name__", None) == document[_TYPE]]
    elif isinstance(document, list):
        candidates = [member for member in candidates if get_origin(member) is tuple] or candidates
    elif len(candidates) > 1:
        candidates = [m for m in candidates if isinstance(m, type) and isinstance(document, m)] or candidates
    if not candidates:
        raise CodecError(f"{at}: {shown(document.get(_TYPE))} is not one of {union}")
    return candidates[0]


def _members(union: Any) -> Iterator[Any]:
    """The members of a union; one that is a name for another union is opened."""
    for member in map(bare, get_args(union)):
        if get_origin(member) in _UNIONS:
            yield from _members(member)
        else:
            yield member


def _expect(fits: bool, document: Any, at: str, wanted: str) -> None:
    if not fits:
        raise CodecError(f"{at}: expected {wanted}, got {shortened(document)}")
