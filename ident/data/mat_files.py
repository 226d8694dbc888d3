"""MATLAB files of version 7.2 and before, from plain values and as plain values.

`mat_bytes` makes the content of a file, the same for the same variables. `mat_variables` reads one in a
process of its own (`foreign_files.read_in_child`), as scipy's reader is compiled and files are not to be
trusted, and turns the tree that comes back into arrays, text, lists and dicts. Files of version 7.3 are HDF5
and read by `record_files`.
"""

from __future__ import annotations

import io
import json
from typing import Any, Literal

from ident.data.foreign_files import Unread, npz_arrays, read_in_child

# Length of the text that opens a file of version 5 to 7.2, bytes (MAT-File Format, "Header"); 12 bytes that
# say how to read the file follow.
HEADER_TEXT_BYTES = 116


def mat_bytes(variables: dict[str, Any], what: str, *, oned_as: Literal["row", "column"] = "row") -> bytes:
    """Return the content of a MATLAB file (version 5 to 7.2, not compressed).

    Parameters
    ----------
    variables : dict of str to value
        What `scipy.io.savemat` takes: arrays, text, dicts as structs. Equal variables give equal files.
    what : str
        Said in the first line of the file, in ASCII, after 'MATLAB 5.0 MAT-file, '.
    oned_as : {'row', 'column'}
        What a vector (T,) becomes.

    Raises
    ------
    ValueError, TypeError
        Of scipy, for what MATLAB cannot hold or a field of a struct with more than 31 letters; of Python
        (UnicodeEncodeError) where `what` is not ASCII. A text of more than 95 characters would shift the
        header: not checked.
    """
    import scipy.io  # here: few write such files, and every command would wait for it

    stream: Any = io.BytesIO()  # scipy takes streams, its stubs know paths only
    scipy.io.savemat(stream, variables, oned_as=oned_as)
    # scipy writes the date into the text that opens the file.
    header_text = b"MATLAB 5.0 MAT-file, " + what.encode("ascii")
    after_text = bytes(stream.getvalue()[HEADER_TEXT_BYTES:])
    return header_text.ljust(HEADER_TEXT_BYTES) + after_text


def mat_variables(content: bytes, source: object) -> dict[str, Any]:
    """Return the variables of a MATLAB file by name.

    Parameters
    ----------
    content : bytes
        The file.
    source : object
        Its path; error messages begin with it.

    Returns
    -------
    dict of str to value
        Numbers are arrays of two dimensions and more; text is str (several rows: a list of str), a struct a
        dict of its fields, an array of structs or a cell array a list; anything else is `Unread`.

    Raises
    ------
    ValueError
        One line: another kind of file (also one of version 7.3), or a damaged one.
    """
    # The signature of HDF5, before which up to 512 bytes of text stand.
    if b"\x89HDF\r\n" in content[:1024]:
        raise ValueError(
            f"{source}: a version 7.3 .mat file where one of version 7 is expected: save it with '-v7'"
        )
    try:
        arrays = npz_arrays(read_in_child("MATLAB .mat", "scipy", content))
    except ValueError as error:
        raise ValueError(f"{source}{error}") from None

    def value(tree: dict[str, Any]) -> Any:
        """Return the value of a tree of one key, which says its kind (`child_reader.mat_variables`).

        Trees come from our own script and are not checked; a kind that is not listed is text.
        """
        ((kind, inner),) = tree.items()
        if kind == "struct":
            return {name: value(item) for name, item in inner.items()}
        if kind == "list":
            return [value(item) for item in inner]
        if kind == "array":
            return arrays[str(inner)]
        if kind == "unread":
            return Unread(inner)
        return inner

    variables: dict[str, Any] = value(json.loads(arrays["about"].tobytes()))
    return variables
