"""A thousand generated logs of all kinds against who wrote them (`tests/ident/generated_logs.py`).

Each log is given to `flexlink look` and `flexlink identify` as a user gives it, without options; a refusal
that names a command or options is followed as it is printed. A log whose unit, columns or rows nobody can
tell has to be asked about; all others have to be read. What counts first is what is read wrongly without a
word.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import tempfile
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.harness import Print, main
from ident.data.record import Record
from tests.ident.generated_logs import Log, generated
from workflow.cli import main as flexlink

# A log that is read otherwise than it was written, and no doubt is told.
WRONG = "read wrongly without a word"
# One that is refused, and whose refusal leads nowhere.
UNHELPFUL = "refused, no hint helps"
# One that is read once the hint of its refusal is followed.
HINT = "refused, the hint helps"
GOOD = ("right", "asked")
# A refusal is followed that often.
_HINTS = 4


class ReadError(BaseException):
    """A command has read its log: here it would compute."""

    def __init__(self, record: Record) -> None:
        self.record = record


def _stop(logs: Any, **_: object) -> None:
    raise ReadError(logs.measured[0])


def told_by(arguments: Sequence[str]) -> tuple[Record | None, str]:
    """The record that a command goes on with, if it gets so far, and what it prints."""
    printed = io.StringIO()
    with (
        mock.patch("workflow.commands.identify.identify_logs", _stop),
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(printed),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error")
        try:
            flexlink(list(arguments))
        except ReadError as read:
            return read.record, printed.getvalue()
    return None, printed.getvalue()


def pasted(said: str, log: Log, path: Path) -> list[str]:
    """The options that a refusal names, what the user knows filled in."""
    command = re.search(r"flexlink identify (.*)", said)
    words = shlex.split(command[1].rstrip(" .)")) if command else re.findall(r"--[a-z-]+(?: [\w.]+)?", said)
    words = [part for word in words for part in (word.split() if word.startswith("--") else [word])]
    known = {
        "--input": log.names[1],
        "--output": log.names[2],
        "--time": log.names[0],
        "--dt-s": repr(log.dt_s),
    }
    known |= {"--time-unit": log.clock or log.unit, "--decimal": {".": "point", ",": "comma"}[log.decimal]}
    options: dict[str, list[str]] = {}
    for k, word in enumerate(words):
        if word.startswith("--") and word not in options:
            value = words[k + 1] if k + 1 < len(words) and not words[k + 1].startswith("--") else ""
            if not command or value.isupper() or not value:
                value = known.get(word, value)
            options[word] = [] if word == "--repair" else [value]
    if "--time" in options:
        options.pop("--dt-s", None)  # one of them is to be given
    return [part for option, value in options.items() for part in (option, *value)]


def difference(record: Record, log: Log) -> str:
    """From the truth; empty if there is none."""
    if abs(record.dt_s - log.dt_s) > 2e-3 * log.dt_s:
        return f"every {record.dt_s:g} s, true {log.dt_s:g} s"
    for what, signal, true in (("input", record.input, log.u), ("output", record.output, log.y)):
        if len(true) and len(signal) != len(true):
            return f"{len(signal)} samples, true {len(true)}"
        if len(true) and np.any(np.abs(signal[:, 0] - true) > 1e-6 * (1 + np.abs(true))):
            return f"{what} {signal[:3, 0]}, true {true[:3]}"
    if log.reference and record.reference_names != (log.reference,):
        return f"reference {record.reference_names}, true {log.reference}"
    for unit, true_unit in zip((*record.input_units, *record.output_units), log.units, strict=False):
        if unit not in ("", true_unit):
            return f"in {unit}, true {true_unit}"
    return ""


def outcome(log: Log, folder: Path) -> tuple[str, str]:
    """What became of a log, and the words that say why."""
    path = folder / log.file
    options = list[str]()
    path.write_bytes(log.content)
    record, first = told_by(["identify", str(path)])
    last = first
    follows = 0
    while record is None and follows < _HINTS:
        hinted = pasted(last, log, path)
        if not hinted:
            break
        options = [*options, *hinted]
        follows = follows + 1
        record, last = told_by(["identify", str(path), *options])
    why = f"{first.strip()} -> {shlex.join(options)} -> {last.strip()}".replace(str(folder), "")
    if record is None:
        return ("right" if log.answer == "refuse" else UNHELPFUL), why
    if log.told and log.told not in told_by(["look", str(path)])[1]:
        return WRONG, f"`look` says nothing of {log.told!r}"
    if log.answer == "refuse" and not follows:
        return WRONG, "read, though nobody can tell"
    wrong = difference(record, log)
    if not follows:
        if wrong and log.answer == "ask" and record.doubts:
            return "asked", ""
        if not wrong:
            return "right", wrong
        return "read wrongly, a doubt is told" if record.doubts else WRONG, wrong
    if wrong and not (log.answer == "refuse" or (log.answer == "ask" and record.doubts)):
        return "read wrongly after its hint", f"{wrong}: {why}"
    return ("asked" if log.answer != "read" else HINT), why


def run(out: Print, *, seed: int = 47, count: int = 1000, examples: int = 40) -> None:
    outcomes = Counter[str]()
    shown = list[str]()
    with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
        for number in range(count):
            log = generated(seed, number)
            what, why = outcome(log, Path(folder))
            outcomes[what] += 1
            shown += [] if what in GOOD else [f"{what}: [{number}] {log.kind}: {why}"]
    out(f"{count} logs")
    for what, many in outcomes.most_common():
        out(f"{what:<40}{many:6d}{many / count:9.1%}")
    for line in shown[:examples]:
        out(f"    {' '.join(line.split())[:500]}")


if __name__ == "__main__":
    main(run)
