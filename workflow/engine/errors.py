"""Errors that reach the person at the keyboard, each one line long, each with its exit code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from errno import ENXIO
from pathlib import Path

# Exit code: all done.
EXIT_OK = 0
# Exit code of an error of our own, as Python leaves after an exception.
EXIT_INTERNAL = 1
# Exit code of a check that fails, as pytest, diff and grep leave.
EXIT_CHECK_FAILED = EXIT_INTERNAL
# Exit code for wrong usage, as of shells and click.
EXIT_BAD_INPUT = 2
# Exit code of a result that is not certified: the first that means nothing elsewhere.
EXIT_NOT_CERTIFIED = 3
# Exit code after an interrupt: 128 + SIGINT, as shells expect.
EXIT_INTERRUPTED = 130

# Characters of a complaint: two to four lines of a terminal.
LONGEST_LINE = 300
# Characters of a complaint, at least, that say what is wrong and where.
_LEAST_BEFORE_COMMAND = 120
# Characters between a comma and the command, as in '; type: flexlink ...'.
_WORDS_BEFORE_COMMAND = 30


def one_line(text: object) -> str:
    """The text without line breaks or runs of blanks, for a message that must stay on one line."""
    return printable(" ".join(str(text).split()))


def printable(text: str) -> str:
    """Control characters as escapes: a column title from a file must not steer the terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


def shortened(value: object, most: int = 80) -> str:
    """How a value is written, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # hexadecimal digits in TOML give integers that Python does not write in decimal ones
        text = f"<{type(value).__name__} with too many digits>"
    return cut(text, most)


def cut(text: str, most: int) -> str:
    """The text, its end left out where it is longer."""
    return text if len(text) <= most else text[: most - 3] + "..."


def cut_inside(text: str, most: int = LONGEST_LINE) -> str:
    """The text, cut where it is longer: at its end, or before the command to type that it ends with.

    A command is never cut, for it would not work: a line with long names and paths gets longer than `most`.
    """
    if len(text) <= most:
        return text
    at = text.rfind(": flexlink ")
    if at < 0:
        return cut(text, most)
    # Words before the command that tell the reader what it is: 'type', 'name it'.
    words = max(text.rfind(sign, 0, at) for sign in ";,.?(:")
    start = at + 1
    if at - words < _WORDS_BEFORE_COMMAND:
        start = words + 1
    tail = text[start:].lstrip()
    room = max(most - 5 - len(tail), _LEAST_BEFORE_COMMAND)
    return f"{text[:room]} ... {tail}" if len(text) > room + 5 + len(tail) else text


class InputError(ValueError):
    """Something the user gave (file, key, path, column) cannot be used; the message is one line."""

    exit_code = EXIT_BAD_INPUT

    def __init__(self, message: object) -> None:
        super().__init__(cut_inside(one_line(message)))


class StageError(RuntimeError):
    """A library failed in the middle of a stage although its input was accepted; one line."""

    exit_code = EXIT_INTERNAL

    def __init__(self, message: object) -> None:
        super().__init__(cut_inside(one_line(message)))


class CommandInterruptedError(RuntimeError):
    """Ctrl-C; `out` is the directory in which what is finished is kept."""

    exit_code = EXIT_INTERRUPTED

    def __init__(self, out: Path) -> None:
        super().__init__("interrupted")
        self.out = out


def need(*paths: Path | None) -> None:
    """Refuse a path that is not there, and one that would be waited for, before anything slow is loaded.
    Raises InputError."""
    for path in paths:
        if path is not None and not path.exists():
            raise InputError(f"cannot read {path}: no such file or directory")
        if path is not None and not (path.is_file() or path.is_dir()):
            raise InputError(f"cannot read {path}: a pipe, socket or device; expected a file")


@contextmanager
def cannot(do: str, path: Path) -> Iterator[None]:
    """What the system refuses, in one line: `cannot write PATH: reason`. Raises InputError."""
    try:
        yield
    except OSError as error:
        reason = "a pipe or socket that nobody reads" if error.errno == ENXIO else error.strerror or error
        raise InputError(f"cannot {do} {path}: {reason}") from error


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Turn a library's complaint about user input into an `InputError` that says where it arose.

    `LinAlgError` is a `ValueError` too, but of the computation: it becomes a `StageError`.
    """
    # Not at the top: the command line settles how many threads numpy takes before numpy is loaded.
    from numpy.linalg import LinAlgError

    try:
        yield
    except (InputError, StageError):
        raise
    except LinAlgError as error:
        raise StageError(f"{where}: linear algebra failed: {error}") from error
    except ValueError as error:
        # Some complaints of the rooms begin with the file already.
        raise InputError(error if str(error).startswith(where) else f"{where}: {error}") from error
    except OSError as error:
        raise InputError(f"{where}: {describe_os_error(error, where)}") from error


def describe_os_error(error: OSError, known: object = None) -> str:
    """`path: reason` without the errno number; only the reason where the path is `known` to the reader."""
    reason = error.strerror or str(error)
    named = error.filename and str(error.filename) != str(known)
    return f"{error.filename}: {reason}" if named else reason
