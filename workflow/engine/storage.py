"""Files that are either whole or absent: atomic writes of npz, JSON and text, and their readers.

A file is written under a temporary name in its own directory, flushed to the disk and renamed, and the
directory entry is flushed. Pickle never appears: object arrays are refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ident.data.foreign_files import Unread, content_of, npz_arrays, shown
from workflow.engine import codec, documents
from workflow.engine.errors import InputError, cannot, naming

# Ending of a file that is not whole yet.
TEMPORARY_SUFFIX = ".part"
# Earliest date a zip entry can carry; a constant makes the bytes reproducible.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` by `content` atomically. Raises InputError (one line) where the disk refuses."""
    write_together({path: content})


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Replace files that belong together: none where the disk has no room for all of them, each atomically.

    For a link the file that it names is replaced; a device or pipe gets its content before.

    Parameters
    ----------
    contents : mapping of Path to bytes

    Raises
    ------
    InputError
        One line: the disk refuses.
    """
    places = {}
    for path in contents:
        place = _replaced(path)
        if place is not None:
            places[path] = place

    # All are written beside their places and flushed before the first one is renamed.
    temporary = {path: _temporary(place) for path, place in places.items()}
    try:
        for path, whole in temporary.items():
            with cannot("write", path), open(whole, "wb") as stream:
                stream.write(contents[path])
                stream.flush()
                os.fsync(stream.fileno())
        for path in contents.keys() - places.keys():
            with cannot("write", path), open(path, "wb", opener=documents.at_once) as stream:
                stream.write(contents[path])
        for path, whole in temporary.items():
            with cannot("write", path):
                os.replace(whole, places[path])
    except BaseException:
        for leftover in temporary.values():
            # What went wrong first is what is said.
            with suppress(OSError):
                leftover.unlink(missing_ok=True)
        raise
    # The renaming itself is on the disk once the folder is flushed.
    for folder in {place.parent for place in places.values()}:
        with cannot("write", folder):
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _replaced(path: Path) -> Path | None:
    """The regular file, there or not, that a new one takes the place of; links are followed. None for what is
    written into: devices, pipes, files without a name (of /proc). Raises InputError."""
    target = Path(os.path.realpath(path))
    with cannot("write", path), suppress(FileNotFoundError):
        if not stat.S_ISREG(path.stat().st_mode) or not target.exists():
            return None
    return target


def _temporary(path: Path) -> Path:
    """Where a file is before it is whole, beside its place."""
    return path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")


def try_out(path: Path) -> None:
    """Whether a file of this name can be made: permission bits know neither of read-only file systems nor of
    the administrator. Raises OSError."""
    trial = _temporary(path)
    trial.touch()
    trial.unlink()


def check_writable(path: Path) -> None:
    """Refuse an output file before the work is done: its directory must be there and take new files."""
    place = _replaced(path)
    with cannot("write", path):
        if path.is_dir():
            raise InputError(f"cannot write {path}: it is a directory")
        if place is None:
            if not os.access(path, os.W_OK):
                raise InputError(f"cannot write {path}: permission denied")
        elif not place.parent.is_dir():
            raise InputError(f"cannot write {path}: {place.parent} is not a directory")
        elif path.exists() and os.path.samestat(path.stat(), os.fstat(1)):
            raise InputError(f"cannot write {path}: standard output goes there already")
        else:
            try_out(place)


def refuse_in_the_way(read: Iterable[Path], written: Iterable[tuple[str, Path]]) -> None:
    """Refuse, before the work is done, a file that is read twice, and an output (option, file) that is read,
    another output, or out of reach."""
    seen = dict[str, str]()
    for path in read:
        place = os.path.realpath(path)
        if place in seen:
            raise InputError(f"{path}: given twice; every source counts once")
        seen[place] = "a source"
    for option, target in written:
        place = os.path.realpath(target)
        if place in seen:
            raise InputError(f"{option} {target}: that is {seen[place]} already")
        seen[place] = option
        check_writable(target)


def write_text(path: Path, content: str) -> None:
    """Atomic UTF-8 text."""
    write_bytes(path, content.encode("utf-8"))


def write_new_directory(out: Path, texts: Mapping[str, str]) -> list[Path]:
    """Files by name in a directory, made where it is absent: all of them or none. Raises InputError."""
    existed = out.is_dir()
    files = {out / name: text.encode() for name, text in texts.items()}
    try:
        with naming(f"cannot write {out}"):
            out.mkdir(parents=True, exist_ok=True)
        write_together(files)
    except InputError:
        if not existed and out.is_dir():
            out.rmdir()
        raise
    return list(files)


def csv_text(columns: Mapping[str, codec.AnyArray]) -> str:
    """Signals (T,) as CSV with one header line; nine digits, far below any sensor's noise."""
    stream = io.StringIO()
    table = np.column_stack(list(columns.values()))
    np.savetxt(stream, table, "%.9g", ",", header=",".join(columns), comments="")
    return stream.getvalue()


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Atomic JSON as of `json_bytes`."""
    write_bytes(path, json_bytes(document))


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Strict JSON: non-finite floats become `{"$float": "inf"}` and come back as floats."""
    tagged, _ = codec.pack(document)
    return (json.dumps(tagged, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode("utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """The document written by `write_json`. Raises InputError naming the file."""
    with naming(str(path)):
        return codec.unpack(dict, documents.read_json(path), {})


def npz_bytes(arrays: Mapping[str, codec.AnyArray]) -> bytes:
    """npz file content; equal arrays give equal bytes. Raises TypeError for object arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in arrays.items():
            array = np.asanyarray(value)
            if array.dtype.hasobject:
                raise TypeError(f"array {name!r} has dtype {array.dtype}: objects would need pickle")
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            # Level 1: signals shrink about as far as they will, at a tenth of the time of level 6.
            entry.compress_type = zipfile.ZIP_DEFLATED
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            archive.writestr(entry, content.getvalue(), compresslevel=1)
    return buffer.getvalue()


def read_npz(path: Path) -> dict[str, codec.AnyArray]:
    """Arrays of an npz file by name, read without pickle. Raises InputError naming the file."""
    with naming(str(path)), cannot("read", path):
        arrays = npz_arrays(content_of(path))
    for name, array in arrays.items():
        if isinstance(array, Unread):
            raise InputError(f"{path}: '{shown(name)}' holds {array.why}")
    return arrays


def sha256_of_bytes(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Hash of a file's content. Raises InputError naming the file."""
    with cannot("read", path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def remove_leftovers(directory: Path) -> None:
    """Delete temporary files that a killed writer left in a directory (hold its lock)."""
    for leftover in directory.glob(f".*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


@contextmanager
def locked(directory: Path, what: str, *below: Path) -> Iterator[None]:
    """Hold a directory against a second writer; the system lets go of the lock when the process dies.

    Leftovers of killed writers are deleted in it and in the directories `below`; `what` is being written.
    """
    import fcntl

    for place in below:
        # Files of others must not be written or deleted through it.
        if place.is_symlink():
            raise InputError(f"{place}: a link; a {what} keeps its files in its own directory")
    # A link at its place would have its target opened in the name of whoever runs this.
    no_link = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW
    with os.fdopen(os.open(directory / "lock", no_link, 0o666), "w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{directory}: another process is writing this {what}") from error
        for place in (directory, *below):
            remove_leftovers(place)
        yield
