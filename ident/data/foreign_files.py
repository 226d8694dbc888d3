"""Files that somebody else wrote: their size, how they are quoted, and reading them without being harmed.

`content_of` takes the bytes of a file of limited size. `npz_arrays` reads numpy archives of plain arrays and
unpickles nothing. `read_in_child` gives formats that only a compiled library reads to a process of its own
(`child_reader`), whose end is a refusal. `shown`, `as_typed` and `path_as_typed` write what stands in a file
into messages on one line. Functions here raise ValueError with the reason alone; whoever knows the file's
name puts it before.
"""

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

from ident.data.child_reader import CPU_SECONDS, LARGEST_BYTES as LARGEST_BYTES, NO_LIBRARY, REFUSED

# Columns of a table, at most: each is looked at, and a line of it printed. More is a table that lies on its
# side. Chosen: machines log some hundred signals.
MOST_COLUMNS = 4096

CHILD_SCRIPT = Path(__file__).with_name("child_reader.py")
"""The script that reads compiled formats."""
# Time that is waited for the child, s: its limit of processor time, and half a minute for starting on a busy
# machine, chosen.
LONGEST_WAIT_S = CPU_SECONDS + 30
# Bit 0 of the flags of a zip entry: it is encrypted (PKWARE's APPNOTE, 4.4.4).
ENCRYPTED_FLAG = 0x1
# Kinds of numpy arrays that are taken: real numbers and booleans, instants and durations.
NUMBER_KINDS = "fiub"
INSTANT_KINDS = "Mm"
# Python keeps a byte of a path that is no UTF-8 as a lone surrogate: this code plus the byte (PEP 383).
FIRST_SURROGATE = 0xDC00


@dataclass(frozen=True)
class Unread:
    """A named thing in a file that is no array of numbers.

    Attributes
    ----------
    why : str
        What it is, and what to do: 'Python objects; expected arrays of numbers'.
    """

    why: str


def shown(value: object, longest: int = 80) -> str:
    """Return how a value from a file is quoted in a message: on one line, cut where it is long.

    Parameters
    ----------
    value : object
        Text is taken as it is, anything else by its `repr`.
    longest : int
        Characters, at least 3 (not checked); a longer text ends in '...'. 80, the default, are a line.

    Returns
    -------
    str
        Runs of blanks and line ends are one blank, characters that cannot be printed are escaped.
    """
    text = value if isinstance(value, str) else repr(value)
    # Enough is kept that blanks may shrink, four times the length; a text of a gigabyte is not gone through.
    one_line = " ".join(text[: 4 * longest].split())
    # Control characters in a file's names would act on the terminal that shows the message.
    printable = ""
    for character in one_line:
        printable += character if character.isprintable() else character.encode("unicode_escape").decode()
    return printable if len(printable) <= longest else printable[: longest - 3] + "..."


def as_typed(value: object) -> str:
    """Return a name or a path as a shell takes it, whole and on one line: quoted where it has to be.

    Parameters
    ----------
    value : object
        Taken by its `str`.

    Returns
    -------
    str
        What a message cannot show as it is (control characters, runs of blanks, blanks that do not break) is
        written in the quotes of bash and zsh that take escapes: $'a\\tb'.
    """
    # Messages join runs of blanks; such text could not be copied from them.
    text = str(value)
    if text.isprintable() and text == " ".join(text.split()):
        return shlex.quote(text)
    escaped = ""
    for character in text:
        is_plain = character.isprintable() and character not in " \\'"
        escaped += character if is_plain else _escape(character)
    return f"$'{escaped}'"


def _escape(character: str) -> str:
    """Return a character by its number, in as many hexadecimal digits as it needs: '\\x20', '\\u00a0'.

    Two digits below 0x80 (ASCII), and for a byte that is no UTF-8; four below 0x10000, else eight. TypeError
    for more than one character.
    """
    # Bytes that are no UTF-8 are 0x80 to 0xFF.
    code = ord(character)
    if FIRST_SURROGATE + 0x80 <= code <= FIRST_SURROGATE + 0xFF:
        return f"\\x{code - FIRST_SURROGATE:02x}"
    if code < 0x80:
        return f"\\x{code:02x}"
    if code < 0x10000:
        return f"\\u{code:04x}"
    return f"\\U{code:08x}"


def path_as_typed(path: object) -> str:
    """Return a path as a shell takes it, with './' before one that begins with a dash, which programs would
    take for an option.

    Any object is taken by its `str`; whether the path is there is not asked.
    """
    text = str(path)
    return as_typed(f"./{text}" if text.startswith("-") else text)


def content_of(file: Path, largest_bytes: int = LARGEST_BYTES) -> bytes:
    """Return the bytes of a file.

    Parameters
    ----------
    file : Path
    largest_bytes : int
        Size above which it is refused; default 1 GiB (`child_reader.LARGEST_BYTES`).

    Raises
    ------
    ValueError
        It is not there, it is no file (a pipe would be waited for), or it is too large.
    OSError
        It cannot be opened.
    """
    if not file.is_file():
        raise ValueError("not a file" if file.exists() else "no such file")
    size = file.stat().st_size
    if size > largest_bytes:
        raise ValueError(f"{size / 2**20:.0f} MiB; expected at most {largest_bytes >> 20}: split the file")
    return file.read_bytes()


def distinct(names: Sequence[str]) -> list[str]:
    """Return names of columns, in their order, those that are there several times numbered: '#1 angle'.

    Empty for none. A name that looks like a numbered one, '#1 angle', is not told apart from it.
    """
    times = Counter(names)
    times_so_far = Counter[str]()
    numbered = []
    for name in names:
        times_so_far[name] += 1
        numbered.append(f"#{times_so_far[name]} {name}" if times[name] > 1 else name)
    return numbered


def as_numbers(values: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """Return an array as it is, if it holds real numbers or instants.

    Parameters
    ----------
    values : array-like or Unread

    Raises
    ------
    ValueError
        It holds something else; the message says what, beginning with 'holds'.
    """
    if isinstance(values, Unread):
        raise ValueError(f"holds {values.why}")
    array = np.asarray(values)
    if array.dtype.kind not in NUMBER_KINDS + INSTANT_KINDS:
        is_text = array.dtype.kind in "USO"
        content = "text" if is_text else f"{array.dtype}"
        raise ValueError(f"holds {shown(content)}; expected real numbers")
    # Years and months have no fixed length, and durations without a unit have none that is known.
    if array.dtype.kind in INSTANT_KINDS and np.datetime_data(array.dtype)[0] in ("Y", "M", "generic"):
        raise ValueError(
            f"holds {array.dtype}, steps of no fixed length; expected instants, as datetime64[ns]"
        )
    return array


def read_in_child(
    kind: str,
    library: str,
    content: bytes,
    *,
    script: Path = CHILD_SCRIPT,
    longest_wait_s: float = LONGEST_WAIT_S,
) -> bytes:
    """Return what a process of its own makes of the bytes of a file.

    Parameters
    ----------
    kind : str
        'HDF5', 'parquet', 'xlsx', 'MATLAB .mat', 'mcap', 'bag' or 'db3': as messages call it; its last part
        in lower case is the argument of the script.
    library : str
        What is to be installed for it, as pip takes it.
    content : bytes
        The file.
    script : Path
        The program that reads it from standard input; see `child_reader` for its answers and exit codes.
    longest_wait_s : float
        Time after which the process is ended, s.

    Returns
    -------
    bytes
        Its standard output.

    Raises
    ------
    ValueError
        Beginning with ':': damaged, too large, too slow, or the library is not installed.

    Notes
    -----
    Python runs isolated (-I), without the surroundings that name plug-ins: a filter of HDF5 is a library that
    gets loaded.
    """
    surroundings = {}
    for name, value in os.environ.items():
        if not name.startswith(("HDF5", "PYTHON")):
            surroundings[name] = value
    # '::' turns off every plug-in of HDF5.
    surroundings["HDF5_PLUGIN_PRELOAD"] = "::"
    argument = kind.lower().rpartition(".")[2]
    try:
        process = subprocess.run(
            [sys.executable, "-I", str(script), argument],
            input=content,
            capture_output=True,
            timeout=longest_wait_s,
            env=surroundings,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f": not read in {longest_wait_s} s; a smaller file, or CSV, is") from None

    if process.returncode == 0:
        return process.stdout
    # A negative code is the signal that ended the process: the limit of processor time, or the system where
    # memory ran out.
    if process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise ValueError(
            f": not read within {CPU_SECONDS} s of processor time, or the time and memory that this session "
            "allows (ulimit -t, ulimit -v); a smaller file, or CSV, is"
        )
    if process.returncode == NO_LIBRARY:
        raise ValueError(f": {kind} files need {library}: {sys.executable} -m pip install {library}")
    complaint = shown(process.stderr.decode("utf-8", "replace"))
    if process.returncode == REFUSED and complaint:
        raise ValueError(f": {complaint}")
    raise ValueError(f": not a {kind} file, or a damaged one")


def npz_arrays(content: bytes) -> dict[str, Any]:
    """Return the arrays of a numpy archive by name; `Unread` in place of Python objects.

    Parameters
    ----------
    content : bytes
        An npz file: a zip archive of .npy files.

    Raises
    ------
    ValueError
        The reason, without the name of the file: no archive, encrypted, damaged, a name twice, or more than
        `LARGEST_BYTES` once unpacked.

    Notes
    -----
    Nothing is ever unpickled: pickles can hold programs.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError):
        raise ValueError("not a numpy .npz archive") from None
    # The archive states the sizes of its entries: they are added up before anything is unpacked.
    if len(entries) < len(archive.infolist()):
        raise ValueError("damaged: a name is there twice")
    if sum(entry.file_size for entry in entries.values()) > LARGEST_BYTES:
        raise ValueError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
    return {name: _array(archive, name, entry) for name, entry in entries.items()}


def _array(archive: zipfile.ZipFile, name: str, entry: zipfile.ZipInfo) -> Any:
    """Return the array of an entry of a numpy archive, or `Unread` where it holds Python objects.

    name: of the array, for complaints. Raises ValueError where the entry is encrypted, packed by a method
    that Python does not know, or damaged.
    """
    if entry.flag_bits & ENCRYPTED_FLAG:
        raise ValueError(f"'{shown(name)}' is encrypted; expected a plain archive (numpy.savez)")
    try:
        content = archive.read(entry)
    except NotImplementedError:
        method = f"method {entry.compress_type}"
        raise ValueError(f"'{shown(name)}' is packed by {method}; expected numpy.savez_compressed") from None
    except Exception:  # zipfile raises many kinds on damaged content
        raise ValueError(f"'{shown(name)}' cannot be read, the archive is damaged") from None

    # The header says whether there are objects; versions of the format differ in its length alone.
    try:
        stream = io.BytesIO(content)
        if np.lib.format.read_magic(stream) == (1, 0):
            _, _, dtype = np.lib.format.read_array_header_1_0(stream)
        else:
            _, _, dtype = np.lib.format.read_array_header_2_0(stream)
        if dtype.hasobject:
            return Unread("Python objects; expected arrays of numbers")
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, OverflowError, MemoryError, TypeError, SyntaxError, RecursionError):
        raise ValueError(f"'{shown(name)}' is no array of numbers, or damaged") from None
