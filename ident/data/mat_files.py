"""MATLAB files of level 5 (versions 5 to 7.2) from and as plain values.

Written by scipy; read here and not by scipy, whose compiled reader trusts what the file says of itself: a
name with a NUL in it or a variable that is there twice has ended the process. Every length is checked against
the bytes that are there. Source: MathWorks, MAT-File Format, chapter 1. Version 7.3 is HDF5 (`record_files`);
level 4, sparse matrices and MATLAB's own objects (timeseries, table, string, datetime) are not read.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from typing import Any, Literal

import numpy as np

from ident.data.foreign_files import LARGEST_BYTES, Unread, shown

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMERIC_CLASSES = range(6, 16)
_COMPLEX_FLAG = 0x08  # MAT-File Format, figure 1-3: bit 3 of the flags
_HEADER_BYTES = 128  # MAT-File Format, figure 1-1
_DEEPEST = 16  # of structs in structs: far from Python's own limit
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def mat_bytes(variables: dict[str, Any], what: str, *, oned_as: Literal["row", "column"] = "row") -> bytes:
    """Content of a file of the variables; equal variables give equal files. what: said in its first line."""
    import scipy.io  # here: few write such files, and every command would wait for it

    stream: Any = io.BytesIO()  # scipy takes streams, its stubs know paths only
    scipy.io.savemat(stream, variables, oned_as=oned_as)
    head = b"MATLAB 5.0 MAT-file, " + what.encode("ascii")
    # The text that opens the file has 116 bytes; scipy writes the date there.
    return head.ljust(116) + bytes(stream.getvalue()[116:])


def mat_variables(content: bytes, source: object) -> dict[str, Any]:
    """Variables of a MATLAB file by name.

    Numbers are arrays of two dimensions and more, as in MATLAB; text is str (several rows: a list of str), a
    struct a dict of its fields, an array of structs or a cell array a list; what else there is is `Unread`.
    Raises ValueError, one line beginning with `source`: another kind of file, or a damaged one.
    """
    try:
        return _File(content).variables()
    except (struct.error, zlib.error, UnicodeDecodeError, OverflowError):
        raise ValueError(f"{source}: not a MATLAB .mat file, or a damaged one") from None
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


class _File:
    """One file: the order of its bytes, and how much it may still unpack to."""

    def __init__(self, content: bytes) -> None:
        mark, version = content[126:128], content[124:126]
        if b"\x89HDF\r\n" in content[:1024]:
            raise ValueError("a version 7.3 .mat file where one of version 7 is expected: save it with '-v7'")
        if mark not in (b"IM", b"MI") or version not in (b"\x00\x01", b"\x01\x00"):
            raise ValueError("not a MATLAB .mat file of version 5 to 7.2; save it with '-v7'")
        self._order = "<" if mark == b"IM" else ">"
        self._body = memoryview(content)[_HEADER_BYTES:]
        self._budget = LARGEST_BYTES

    def variables(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for kind, data in self._elements(self._body):
            if kind == _COMPRESSED:
                unpack = zlib.decompressobj()
                inner = memoryview(unpack.decompress(data, self._budget))
                self._spend(len(inner))
                if not unpack.eof:
                    raise ValueError("damaged: a compressed variable is incomplete, or too large")
                (kind, data), *more = self._elements(inner) or [(0, inner)]
                if more:
                    raise ValueError("damaged: more than a variable in a compressed part")
            if kind != _MATRIX:
                raise ValueError("damaged: no variable where one is expected")
            name, value = self._matrix(data, 0)
            if not name:
                continue  # where MATLAB keeps the insides of its objects
            if name in found:
                raise ValueError(f"damaged: the variable '{name}' is there twice")
            found[name] = value
        return found

    def _spend(self, n_bytes: int) -> None:
        self._budget -= n_bytes
        if self._budget < 0:
            raise ValueError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")

    def _elements(self, data: memoryview) -> list[tuple[int, memoryview]]:
        """Type and content of the elements that fill these bytes."""
        found, at = [], 0
        while at < len(data):
            kind, size = struct.unpack_from(f"{self._order}II", data, at)
            if kind >> 16:  # four bytes at most, beside their own tag
                kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            else:
                start, end = at + 8, at + 8 + size + (0 if kind == _COMPRESSED else -size % 8)
                end = min(end, max(len(data), start + size))
            if end > len(data) or start + size > end:
                raise ValueError("damaged: it ends in the middle of a variable")
            found.append((kind, data[start : start + size]))
            at = end
        return found

    def _integers(self, element: tuple[int, memoryview], wanted: int) -> list[int]:
        kind, data = element
        if kind != wanted or len(data) % 4:
            raise ValueError("damaged: a variable has no readable description")
        return [int(n) for n in np.frombuffer(data, f"{self._order}{_NUMBERS[kind]}")]

    def _matrix(self, data: memoryview, depth: int) -> tuple[str, Any]:
        """Name and value of one variable, field or cell."""
        parts = self._elements(data)
        if not parts:
            return "", np.zeros((0, 0))
        if len(parts) < 3 or depth > _DEEPEST:
            raise ValueError("damaged: a variable has no readable description, or is nested too deeply")
        flags = self._integers(parts[0], _UINT32)
        if len(flags) != 2:
            raise ValueError("damaged: the flags of a variable are none")
        kind = flags[0] & 0xFF
        if kind == _OPAQUE:
            return self._name(parts[1]), Unread(_advice(f"a MATLAB object ({_ascii(parts[3:4])})"))
        shape, name, rest = self._integers(parts[1], _INT32), self._name(parts[2]), parts[3:]
        # In Python's integers, which do not overflow.
        count = 1
        for length in shape:
            count *= length
        if len(shape) < 2 or len(shape) > 32 or min(shape) < 0 or count > LARGEST_BYTES:
            raise ValueError(f"damaged: '{name}' has no possible size")
        if kind in _NUMERIC_CLASSES:
            return name, self._numbers(rest, shape, count, complex_=bool(flags[0] >> 8 & _COMPLEX_FLAG))
        if kind == _CHAR:
            return name, _text(rest, shape, self._order)
        if kind == _CELL:
            return name, [self._inner(part, depth) for part in _exactly(rest, count)]
        if kind == _STRUCT:
            return name, self._struct(rest, count, depth)
        what = {_SPARSE: "a sparse matrix", _OBJECT: "a MATLAB object", _FUNCTION: "a function"}
        if kind not in what:
            raise ValueError(f"damaged: '{name}' is of no known class")
        return name, Unread(_advice(what[kind]))

    def _name(self, element: tuple[int, memoryview]) -> str:
        name = _ascii([element])
        if element[0] != _INT8 or (name and not _NAME.fullmatch(name)):
            raise ValueError(f"damaged: '{shown(name)}' is no name of a variable")
        return name

    def _inner(self, part: tuple[int, memoryview], depth: int) -> Any:
        if part[0] != _MATRIX:
            raise ValueError("damaged: a field or cell is no variable")
        return self._matrix(part[1], depth + 1)[1]

    def _numbers(
        self, rest: list[tuple[int, memoryview]], shape: list[int], count: int, *, complex_: bool
    ) -> Any:
        parts = []
        for kind, data in _exactly(rest, 2 if complex_ else 1):
            if kind not in _NUMBERS or len(data) != count * np.dtype(_NUMBERS[kind]).itemsize:
                raise ValueError("damaged: a variable has more or fewer numbers than it says")
            self._spend(8 * count)
            array = np.frombuffer(data, f"{self._order}{_NUMBERS[kind]}").reshape(shape, order="F")
            # Whole numbers are stored in fewer bytes than their class has.
            parts.append(array.astype(np.float64))
        if not complex_:
            return parts[0]
        both = np.empty(shape, dtype=np.complex128)
        both.real, both.imag = parts  # not re + 1j im, which loses the sign of a zero
        return both

    def _struct(self, rest: list[tuple[int, memoryview]], count: int, depth: int) -> Any:
        if len(rest) < 2:
            raise ValueError("damaged: a struct without fields")
        (length, *_), (kind, raw) = self._integers(rest[0], _INT32) or [0], rest[1]
        if kind != _INT8 or not 0 < length <= 64 or len(raw) % length:
            raise ValueError("damaged: the fields of a struct have no names")
        cut = [bytes(raw[k : k + length]).split(b"\0")[0] for k in range(0, len(raw), length)]
        names = [self._name((_INT8, memoryview(name))) for name in cut]
        if len(set(names)) < len(names) or not all(names):
            raise ValueError("damaged: the fields of a struct have no names, or one twice")
        if not names:
            return {}
        values = iter(_exactly(rest[2:], count * len(names)))
        structs = [{name: self._inner(next(values), depth) for name in names} for _ in range(count)]
        return structs[0] if count == 1 else structs


def _exactly(parts: list[tuple[int, memoryview]], count: int) -> list[tuple[int, memoryview]]:
    if len(parts) != count:
        raise ValueError("damaged: a variable has more or fewer parts than it says")
    return parts


def _ascii(elements: list[tuple[int, memoryview]]) -> str:
    return "".join(bytes(data).decode("latin-1") for _, data in elements)


def _advice(what: str) -> str:
    return f"{shown(what)}; expected numbers: save plain vectors, e.g. t = x.Time; y = full(x.Data)"


def _text(rest: list[tuple[int, memoryview]], shape: list[int], order: str) -> str | list[str]:
    if not rest and 0 in shape:
        return ""
    ((kind, data),) = _exactly(rest, 1)
    if kind not in _TEXT:
        raise ValueError("damaged: a text of no known encoding")
    codec = _TEXT[kind]
    ordered = {"utf-16": "utf-16-le", "utf-32": "utf-32-le"} if order == "<" else {"utf-16": "utf-16-be"}
    text = bytes(data).decode(ordered.get(codec, codec))
    if shape[0] <= 1:
        return text
    rows = shape[0]
    return [text[row::rows].rstrip() for row in range(rows)]
