"""numpy archives of plain arrays, from whoever wrote them."""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np

from ident.data.foreign_files import LARGEST_BYTES, Unread, shown

_ENCRYPTED = 0x1


def npz_arrays(content: bytes) -> dict[str, Any]:
    """The arrays of an npz file by name; `Unread` in place of Python objects.

    Raises ValueError with the reason, without the name of the file: no archive, encrypted, damaged, a name
    twice, more than `LARGEST_BYTES`. Nothing is ever unpickled.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError):
        raise ValueError("not a numpy .npz archive") from None
    if len(entries) < len(archive.infolist()):
        raise ValueError("damaged: a name is there twice")
    if sum(entry.file_size for entry in entries.values()) > LARGEST_BYTES:
        raise ValueError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
    return {name: _array(archive, name, entry) for name, entry in entries.items()}


def _array(archive: zipfile.ZipFile, name: str, entry: zipfile.ZipInfo) -> Any:
    if entry.flag_bits & _ENCRYPTED:
        raise ValueError(f"'{shown(name)}' is encrypted; expected a plain archive (numpy.savez)")
    try:
        content = archive.read(entry)
    except NotImplementedError:
        method = f"method {entry.compress_type}"
        raise ValueError(f"'{shown(name)}' is packed by {method}; expected numpy.savez_compressed") from None
    except Exception:  # zipfile raises many kinds on damaged content
        raise ValueError(f"'{shown(name)}' cannot be read, the archive is damaged") from None
    try:
        stream = io.BytesIO(content)
        first = np.lib.format.read_magic(stream) == (1, 0)
        header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        if header(stream)[2].hasobject:
            return Unread("Python objects; expected arrays of numbers")
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, OverflowError, MemoryError, TypeError, SyntaxError, RecursionError):
        raise ValueError(f"'{shown(name)}' is no array of numbers, or damaged") from None
