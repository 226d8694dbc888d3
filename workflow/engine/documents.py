"""The one door for text that somebody wrote (docs/limits.md): size, nesting and numbers are checked before
anything looks at what is said."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ident.data.json_text import MOST_LEVELS, json_value
from workflow.engine.errors import InputError, cannot, shortened

# Largest document that is read: far above any that flexlink writes.
MOST_BYTES = 32 * 2**20
# Largest TOML file that is read: far above what a person writes.
MOST_TOML_BYTES = 2**20
# Largest integer that is read: what numpy holds.
LARGEST_INTEGER = 2**63 - 1
# The parser's time grows with the square of a dotted key's length.
_LONGEST_TOML_LINE = 20_000
# Endings of logs that a configuration or a document may have as well.
_ANY_TEXT = (".txt", ".dat", ".json")


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """UTF-8 text of a file. Raises InputError naming it."""
    with cannot("read", path), open(path, "rb", opener=at_once) as stream:
        # Pipes have no size: one byte more than is allowed.
        content = stream.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InputError(f"{path}: larger than {most_bytes / 2**20:g} MiB")
    try:
        # Editors on Windows like to put a mark in front.
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start})") from error


def at_once(path: str, flags: int) -> int:
    """Open what is there; a pipe without anybody at its other end is not waited for. Raises OSError."""
    descriptor = os.open(path, flags & ~os.O_CREAT | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)
    return descriptor


def read_toml(path: Path) -> tuple[str, dict[str, Any]]:
    """Text and content of a TOML file. Raises InputError naming the file, for syntax with line and column."""
    # A log in its place is told by its ending, before its content is taken for TOML.
    ending = Path(path.name.lower().removesuffix(".gz")).suffix
    if ending not in (".toml", *_ANY_TEXT) and path.is_file():
        # It loads numpy, which a configuration can do without.
        from ident.data.record_files import READERS

        if ending in READERS:
            from ident.data.foreign_files import path_as_typed

            command = f"flexlink init {path_as_typed(path)} --out my.toml"
            raise InputError(f"{path}: a log, not a TOML file; write one: {command}")
    text = read_text(path, MOST_TOML_BYTES)
    longest = max(map(len, text.splitlines()), default=0)
    if longest > _LONGEST_TOML_LINE:
        raise InputError(f"{path}: a line of {longest} characters, at most {_LONGEST_TOML_LINE} are read")
    return text, _parsed(tomllib.loads, text, str(path), "TOML")


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError naming the file."""
    return json_object(read_text(path), str(path))


def json_object(text: str, source: str) -> dict[str, Any]:
    """The object in a JSON text, with nothing in it that whoever looks at its values would fail on.

    Raises InputError, one line that begins with `source`: syntax, a name twice, no object, nested deeper than
    `MOST_LEVELS`, an integer beyond 64 bits, text that is no Unicode.
    """
    document = _parsed(json_value, text, source, "JSON")
    if not isinstance(document, dict):
        raise InputError(f"{source}: expected a JSON object, found {type(document).__name__}")
    return document


def _parsed(parse: Callable[[str], Any], text: str, source: str, what: str) -> Any:
    """What a parser makes of a text. Raises InputError with line and column."""
    try:
        document = parse(text)
    except RecursionError:
        raise InputError(f"{source}: nested deeper than {MOST_LEVELS} levels") from None
    except ValueError as error:  # syntax, or an integer of more digits than Python reads
        raise InputError(f"{source}: not valid {what}: {error}") from error
    _refuse_extremes(document, source)
    return document


def _refuse_extremes(document: Any, source: str) -> None:
    """Level by level, so that no depth is too much for the check itself."""
    level: list[tuple[str, Any]] = [("", document)]
    for _ in range(MOST_LEVELS + 1):
        below: list[tuple[str, Any]] = []
        for key, value in level:
            _refuse_strange_text(key, key, source)
            if isinstance(value, dict):
                below += [(str(name), item) for name, item in value.items()]
            elif isinstance(value, list):
                below += [(key, item) for item in value]
            elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise InputError(f"{source}: {shortened(key)}: an integer beyond 64 bits, {shortened(value)}")
            elif isinstance(value, str):
                _refuse_strange_text(value, key, source)
        level = below
    if level:
        raise InputError(f"{source}: nested deeper than {MOST_LEVELS} levels")


def _refuse_strange_text(text: str, key: str, source: str) -> None:
    """Refuse what no file name and no other document can hold: NUL, and half of a pair of UTF-16 (JSON can
    write it as an escape)."""
    if "\0" in text:
        raise InputError(f"{source}: {shortened(key)}: a NUL character in {shortened(text)}")
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise InputError(f"{source}: {shortened(key)}: half a character of UTF-16 in {shortened(text)}")
