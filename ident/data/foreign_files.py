"""Files that somebody else wrote: their size, how they are quoted; numpy archives of plain arrays; and files
that only a compiled library reads, in a process of its own, whose end is a refusal."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import sys
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ident.data.child_reader import CPU_SECONDS, LARGEST_BYTES as LARGEST_BYTES

MOST_COLUMNS = 4096
"""Of a table: each is looked at, and a line of it printed. More is a table that lies on its side."""

_SCRIPT = Path(__file__).with_name("child_reader.py")
_SECONDS = CPU_SECONDS + 30  # of waiting
_REFUSED, _NO_LIBRARY = 2, 3  # exit codes of the reader
_ENCRYPTED = 0x1  # bit 0 of the flags of a zip entry (APPNOTE 4.4.4)


@dataclass(frozen=True)
class Unread:
    """A named thing in a file that is no array of numbers: what it is, and what to do."""

    why: str


def shown(value: object, longest: int = 80) -> str:
    """How a value from a file is quoted: on one line, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    text = " ".join(text[: 4 * longest].split())
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= longest else text[: longest - 3] + "..."


def as_typed(value: object) -> str:
    """A name or a path as a shell takes it, whole and on one line: quoted where it has to be.

    What a message cannot show as it is (control characters, runs of blanks, blanks that do not break) is
    written in the quotes of bash and zsh that take escapes: $'a\\tb'.
    """
    text = str(value)
    if text.isprintable() and text == " ".join(text.split()):
        return shlex.quote(text)
    escaped = "".join(
        character if character.isprintable() and character not in " \\'" else _escape(character)
        for character in text
    )
    return f"$'{escaped}'"


def _escape(character: str) -> str:
    """A character by its number, as in $'\\x20' and $'\\u00a0'."""
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a path that is no UTF-8, as Python keeps it
        code -= 0xDC00
        return f"\\x{code:02x}"
    return f"\\x{code:02x}" if code < 0x80 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def path_as_typed(path: object) -> str:
    """A path as a shell takes it, and a program that takes what begins with a dash for an option."""
    text = str(path)
    return as_typed(f"./{text}" if text.startswith("-") else text)


def content_of(file: Path) -> bytes:
    """The bytes of a file. Raises ValueError where it is none (a pipe would be waited for), or holds more
    than `LARGEST_BYTES`; OSError as `open`."""
    if not file.is_file():
        raise ValueError("not a file" if file.exists() else "no such file")
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise ValueError(f"{size / 2**20:.0f} MiB; expected at most {LARGEST_BYTES >> 20}: split the file")
    return file.read_bytes()


def distinct(names: Sequence[str]) -> list[str]:
    """Names of columns, those that are there several times numbered: '#1 angle', '#2 angle'."""
    times, came, found = Counter(names), Counter[str](), list[str]()
    for name in names:
        came[name] += 1
        found.append(f"#{came[name]} {name}" if times[name] > 1 else name)
    return found


def as_numbers(values: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """An array as it is, if it holds real numbers or instants. Raises ValueError saying what it holds."""
    if isinstance(values, Unread):
        raise ValueError(f"holds {values.why}")
    array = np.asarray(values)
    if array.dtype.kind not in "fiubMm":
        what = "text" if array.dtype.kind in "USO" else f"{array.dtype}"
        raise ValueError(f"holds {shown(what)}; expected real numbers")
    if array.dtype.kind in "Mm" and np.datetime_data(array.dtype)[0] in ("Y", "M", "generic"):
        raise ValueError(
            f"holds {array.dtype}, steps of no fixed length; expected instants, as datetime64[ns]"
        )
    return array


def read_in_child(kind: str, library: str, content: bytes) -> bytes:
    """What `child_reader` makes of the bytes of a file: HDF5, parquet, xlsx, MATLAB .mat, MCAP, bag, db3.

    Raises ValueError, beginning with ':': damaged, too large, too slow, or the library is not installed.
    """
    # No plug-ins that the surroundings name: a filter of HDF5 is a library that gets loaded.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("HDF5", "PYTHON"))}
    command = [sys.executable, "-I", str(_SCRIPT), kind.lower().rpartition(".")[2]]
    try:
        done = subprocess.run(
            command,
            input=content,
            capture_output=True,
            timeout=_SECONDS,
            env=kept | {"HDF5_PLUGIN_PRELOAD": "::"},
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f": not read in {_SECONDS} s; a smaller file, or CSV, is") from None
    if done.returncode == 0:
        return done.stdout
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise ValueError(
            f": not read within {CPU_SECONDS} s of processor time, or the time and memory that this session "
            "allows (ulimit -t, ulimit -v); a smaller file, or CSV, is"
        )
    said = shown(done.stderr.decode("utf-8", "replace"))
    if done.returncode == _NO_LIBRARY:
        raise ValueError(f": {kind} files need {library}: {sys.executable} -m pip install {library}")
    raise ValueError(
        f": {said if done.returncode == _REFUSED and said else f'not a {kind} file, or a damaged one'}"
    )


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
