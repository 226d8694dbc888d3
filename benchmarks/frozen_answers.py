"""Some eighty questions (`frozen_questions`): which answers moved from the stored ones, from what to what.

    make frozen                               asks them in two processes; exit code 1 where an answer moved
    make frozen STORE=1                       stores the answers: benchmarks/results/frozen_answers.txt
    python -m benchmarks.frozen_answers --only "exact|EMPS" --against other --store

Every kind of value has its tolerance and the reason for it (`KINDS`). A value that appears or vanishes moved,
as does an error that is raised, or not any more. `--slow` asks what takes too long for every day as well, to
be stored under another name by `--against NAME --store`. What a constant or a move of the diagnosis' search
earns is seen with `--change "module:NAME=value ..."` and `--without "Scan LookAlike"`.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import signal
import sys
import time
import traceback
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.frozen_questions import QUESTIONS, Answer, Question
from benchmarks.harness import RESULTS, Print, main
from diagnosis.search import moves

# CPU seconds of one question, after which it has no answer.
LONGEST_S = 180.0
# Seconds until a process that hangs is given up.
HANGS_S = 1800.0
# CPU seconds assumed of a question that was never stored.
_GUESS_S = 8.0
# A stored duration stays where it is until it is off by this factor, so that storing changes answers only.
_OTHER_DURATION = 1.5


class Kind(NamedTuple):
    """How far a value may move: relative to the stored one, or by so much if that is more."""

    relative: float
    absolute: float
    why: str


KINDS = {
    "said": Kind(0.0, 0.0, "a verdict, a name or a count is another one or is not"),
    "lines": Kind(2e-2, 0.0, "numbers in words are rounded to two or three digits; the words are the same"),
    "margins": Kind(1e-3, 1e-9, "a flat optimum ends elsewhere by rounding, .05 % in gamma (margins.toml)"),
    "model": Kind(1e-3, 1e-9, "least squares repeat to 1e-6; below what any interval of theirs resolves"),
    "spread": Kind(1e-2, 1e-9, "evidence is flat in its hyperparameters, and some are drawn"),
    "sizes": Kind(2e-2, 1e-9, "a descent ends where the likelihood changes little; a tenth of an interval"),
    "probabilities": Kind(0.0, 5e-2, "Monte Carlo of a few hundred draws, and odds are exponentials of gaps"),
    "gaps": Kind(2e-2, 1e-2, "follow the sizes"),
}
_NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Moved(NamedTuple):
    """A value that is not the stored one. share: of its tolerance; above 1 it fails."""

    kind: str
    name: str
    before: Any
    now: Any
    share: float

    def __str__(self) -> str:
        shown = (
            json.dumps(value, ensure_ascii=False) if value is not _NOTHING else "(nothing)"
            for value in self[2:4]
        )
        return f"{self.kind}: {self.name}: " + " -> ".join(shown)


_NOTHING = object()


def moved(before: Answer, now: Answer) -> list[Moved]:
    """What is not as it was stored, within its tolerance or not."""
    moves = []
    for kind in KINDS:
        old = before.get(kind, {})
        new = now.get(kind, {})
        for name in {**old, **new}:
            absent = 0.0 if kind == "probabilities" else _NOTHING
            pair = old.get(name, absent), new.get(name, absent)
            share = _share(KINDS[kind], *pair, of_lines=kind == "lines")
            if share > 0:
                moves.append(Moved(kind, name, *pair, share))
    return moves


def _share(kind: Kind, before: Any, now: Any, *, of_lines: bool) -> float:
    """Share of the tolerance that the difference takes; infinite where none is tolerated."""
    if before == now or (before != before and now != now):
        return 0.0
    if of_lines and isinstance(before, str) and isinstance(now, str):
        return _share_of_line(kind, before, now)
    values = before, now
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return np.inf
    allowed = max(kind.absolute, kind.relative * abs(before))
    off = abs(now - before)
    return float(off / allowed) if allowed > 0 and np.isfinite(off) else np.inf


def _share_of_line(kind: Kind, before: str, now: str) -> float:
    """Share of the tolerance that the difference of two sentences takes; infinite where words differ.

    Numbers may differ by a unit of the last digit, or by the relative tolerance.
    """
    if _NUMBER.sub("#", before) != _NUMBER.sub("#", now):
        return np.inf
    worst = 0.0
    for old, new in zip(_NUMBER.findall(before), _NUMBER.findall(now), strict=True):
        a, b = (float(number.replace("−", "-")) for number in (old, new))
        mantissa, _, power = old.partition("e")
        digit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2])) if "." in old else 0.0
        allowed = max(1.01 * digit, kind.relative * abs(a))
        worst = max(worst, abs(a - b) / allowed if allowed else np.inf * (a != b or 0))
    return worst


@dataclass
class Stored:
    """Answers of a file and the CPU seconds they took: a line per question, and one per kind of value."""

    path: Path
    answers: dict[str, Answer] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Stored:
        stored = cls(path)
        name = ""
        for line in path.read_text("utf-8").splitlines() if path.is_file() else ():
            if line.startswith("    "):
                kind, _, values = line.strip().partition(" ")
                stored.answers[name][kind] = json.loads(values)
            elif line and line[0] != "#":
                name, _, seconds = line.rpartition(" | ")
                stored.answers[name] = {}
                stored.cpu_s[name] = float(seconds.removesuffix(" s"))
        return stored

    def put(self, name: str, answer: Answer, cpu_s: float) -> None:
        before = self.cpu_s.get(name, 0.0)
        self.answers[name] = answer
        if not before / _OTHER_DURATION < cpu_s < before * _OTHER_DURATION:
            self.cpu_s[name] = float(f"{cpu_s:.1f}")

    def write(self, order: Sequence[str]) -> None:
        """In this order; answers to questions that are not asked any more are left out."""
        lines = [f"# python -m benchmarks.frozen_answers --store --against {self.path.stem}"]
        for name in order:
            if name in self.answers:
                lines.append(f"{name} | {self.cpu_s[name]:g} s")
                lines += [
                    f"    {kind} {json.dumps(self.answers[name][kind], ensure_ascii=False)}"
                    for kind in KINDS
                    if kind in self.answers[name]
                ]
        self.path.write_text("\n".join(lines) + "\n", "utf-8")


def plain(answer: Answer) -> Answer:
    """An answer as it comes back from a file: floats with six digits, nothing of numpy."""

    def value(item: Any) -> Any:
        if isinstance(item, np.generic):
            item = item.item()
        if isinstance(item, float):
            return float(f"{item:.6g}")
        return [value(part) for part in item] if isinstance(item, list | tuple) else item

    return {
        kind: {name: value(item) for name, item in values.items()}
        for kind, values in answer.items()
        if values
    }


def asked(question: Question) -> tuple[Answer, str]:
    """The answer, or the error as one; and where that was raised."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return plain(question.ask()), ""
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        line = " ".join(f"{type(error).__name__}: {error}".split())
        return {"lines": {"raises": line}}, f"{Path(place.filename).name}:{place.lineno}"


def serve(connection: Connection, change: str, without: str) -> None:
    """A process that answers questions by name until none comes."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    quiet = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(quiet, descriptor)
    for name in without.split():
        getattr(moves, name).proposed = lambda *told: []
    for module, name, value in re.findall(r"(\S+):(\w+)=(\S+)", change):
        setattr(importlib.import_module(module), name, eval(value, {"np": np}))
    while name := connection.recv():
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # its signal ends the process, in compiled code too
        begin = _cpu_s()
        answer, place = asked(QUESTIONS[name])
        signal.setitimer(signal.ITIMER_PROF, 0)
        connection.send((answer, place, _cpu_s() - begin))


def _cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


class Worker:
    """A process, the question it has, and since when."""

    def __init__(self, *changes: str) -> None:
        context = get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=serve, args=(other, *changes))
        self.process.start()
        other.close()
        self.name = ""
        self.since = 0.0

    def ask(self, name: str) -> None:
        self.name = name
        self.since = time.monotonic()
        self.connection.send(name)

    def take(self) -> tuple[Answer, str, float]:
        """The answer, or how the process ended without one."""
        try:
            return self.connection.recv()  # type: ignore[no-any-return]
        except EOFError:
            self.process.join()
            code = self.process.exitcode or 0
            how = (
                f"no answer after {LONGEST_S:g} s of CPU" if code == -signal.SIGPROF else f"died, exit {code}"
            )
            return {"lines": {"raises": how}}, "", LONGEST_S

    def end(self) -> None:
        self.process.kill()
        self.process.join()


def answers(
    names: Sequence[str], jobs: int, *changes: str
) -> Iterator[tuple[str, tuple[Answer, str, float]]]:
    """Name and answer with its place and CPU seconds, as they come."""
    left = deque(names)
    workers = list[Worker]()
    try:
        for _ in range(min(jobs, len(names))):
            workers.append(Worker(*changes))
            workers[-1].ask(left.popleft())
        while workers:
            ready = wait([of_worker.connection for of_worker in workers], timeout=10.0)
            for worker in [*workers]:
                if time.monotonic() - worker.since > HANGS_S and worker.connection not in ready:
                    worker.process.kill()
                if worker.connection not in ready:
                    continue
                name = worker.name
                result = worker.take()
                if not left or not worker.process.is_alive():
                    workers.remove(worker)
                    worker.end()
                    if left:
                        workers.append(worker := Worker(*changes))
                if left:
                    worker.ask(left.popleft())
                yield name, result
    finally:
        for worker in workers:
            worker.end()


def run(
    out: Print,
    *,
    only: str = "",
    slow: bool = False,
    store: bool = False,
    against: str = "frozen_answers",
    change: str = "",
    without: str = "",
    stop: bool = False,
    jobs: int = 2,
) -> None:
    """only: a pattern of names; stop: at the first answer that moved."""
    stored = Stored.read(RESULTS / f"{against}.txt")
    wanted = [
        name for name, question in QUESTIONS.items() if re.search(only, name) and (slow or not question.slow)
    ]
    skipped = {
        name: next(place for place in QUESTIONS[name].needs if not place.exists())
        for name in wanted
        if not all(place.exists() for place in QUESTIONS[name].needs)
    }
    for place in dict.fromkeys(skipped.values()):
        out(f"skipped, {place} is not here: {', '.join(name for name in skipped if skipped[name] == place)}")

    def expected_s(name: str) -> float:
        return stored.cpu_s.get(name, _GUESS_S)

    ready = sorted((name for name in wanted if name not in skipped), key=expected_s, reverse=True)
    left_s = sum(map(expected_s, ready))
    begin = time.monotonic()
    count = 0
    all_s = left_s
    spent_s = 0.0
    wrong = list[str]()
    within = list[tuple[float, str]]()
    for name, (answer, place, cpu_s) in answers(ready, jobs, change, without):
        count = count + 1
        left_s = left_s - expected_s(name)
        spent_s = spent_s + cpu_s
        before = stored.answers.get(name)
        off = moved(before or {}, answer)
        lines = list[str]()
        if before is None:
            state = "not stored"
            if not store:
                lines = [f"it is stored by: {_storing(name, against)}"]
        else:
            lines = [str(move) for move in off if move.share > 1]
            within += [(move.share, f"{name}: {move}") for move in off if move.share <= 1]
            state = "moved" if lines else "same"
        # In place of a line for each value that vanished.
        if place and (lines or before is None):
            lines = [f"raises, in {place}: {answer['lines']['raises']}"]
        if lines:
            wrong.append(name)
        time_left_s = left_s * (time.monotonic() - begin) / max(all_s - left_s, 1.0)
        out(
            f"[{count}/{len(ready)}] {name}: {state}, {cpu_s:.1f} s CPU ({expected_s(name):g} s expected); "
            f"about {time_left_s / 60:.1f} min left"
        )
        for line in lines:
            out(f"    {line}")
        if store:
            stored.put(name, answer, cpu_s)
        if stop and wrong:
            break
    if store:
        stored.write(list(QUESTIONS))
    out()
    if within:
        share, line = max(within)
        out(f"{len(within)} values moved within their tolerance, the furthest by {share:.0%} of it: {line}")
    minutes = (time.monotonic() - begin) / 60
    out(
        f"{count} of {len(ready)} questions, {spent_s:.0f} s CPU in {minutes:.1f} min; skipped "
        f"{len(skipped)}; {'stored, of them moved' if store else 'not as stored'} {len(wrong)}"
        + (f": {', '.join(wrong)}" if wrong else "")
    )
    if wrong and not store:
        out(f"if that is meant, {_storing('', against)} and say why in the commit")
        sys.exit(1)


def _storing(name: str, against: str) -> str:
    """The command that stores answers."""
    if not name and against == "frozen_answers":
        return "make frozen STORE=1"
    words = f" --only '^{re.escape(name)}$'" if name else ""
    words += f" --against {against}" if against != "frozen_answers" else ""
    return f"python -m benchmarks.frozen_answers --store{words}"


if __name__ == "__main__":
    main(run, writes=False)
