"""MATLAB files (version 7.2 and before) from and as plain values; version 7.3 is HDF5 (`record_files`)."""

from __future__ import annotations

import io
import json
from typing import Any, Literal

from ident.data.foreign_files import Unread, npz_arrays, read_in_child


def mat_bytes(variables: dict[str, Any], what: str, *, oned_as: Literal["row", "column"] = "row") -> bytes:
    """Content of a file of the variables; equal variables give equal files. what: said in its first line."""
    import scipy.io  # here: few write such files, and every command would wait for it

    stream: Any = io.BytesIO()  # scipy takes streams, its stubs know paths only
    scipy.io.savemat(stream, variables, oned_as=oned_as)
    # The text that opens the file has 116 bytes; scipy writes the date there.
    return (b"MATLAB 5.0 MAT-file, " + what.encode("ascii")).ljust(116) + bytes(stream.getvalue()[116:])


def mat_variables(content: bytes, source: object) -> dict[str, Any]:
    """Variables of a MATLAB file by name.

    Numbers are arrays of two dimensions and more; text is str (several rows: a list of str), a struct a dict
    of its fields, an array of structs or a cell array a list; what else there is is `Unread`. Raises
    ValueError, one line beginning with `source`: another kind of file, or a damaged one.
    """
    if b"\x89HDF\r\n" in content[:1024]:
        raise ValueError(
            f"{source}: a version 7.3 .mat file where one of version 7 is expected: save it with '-v7'"
        )
    try:
        arrays = npz_arrays(read_in_child("MATLAB .mat", "scipy", content))
    except ValueError as error:
        raise ValueError(f"{source}{error}") from None

    def value(tree: Any) -> Any:
        (kind, inner), *_ = tree.items()
        if kind == "struct":
            return {name: value(item) for name, item in inner.items()}
        if kind == "list":
            return [value(item) for item in inner]
        return arrays[str(inner)] if kind == "array" else Unread(inner) if kind == "unread" else inner

    found: dict[str, Any] = value(json.loads(arrays["about"].tobytes()))
    return found
