"""Sixteen single faults put into the product at random, two a room: which test or frozen question sees each?

A mutant changes one operator, sign, constant or returned value inside a function. It is put into a copy of
the checkout, never into the checkout itself; the tests of its room run there up to the first failure, and
`frozen_answers`, up to the first answer that moved, where they all pass. A test that fails without the
mutant too is left out. `--list` prints the mutants only.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, main

ROOT = Path(__file__).resolve().parents[1]
# A room is a folder of the product without the rooms below it; its tests.
ROOMS: Mapping[str, tuple[str, ...]] = {
    "plant": ("tests/plant",),
    "ident": ("tests/ident",),
    "ident/data": ("tests/ident",),
    "control_design": ("tests/control_design",),
    "diagnosis": ("tests/diagnosis",),
    "workflow": ("tests/workflow",),
    "workflow/diagnose": ("tests/workflow",),
    "flexlink": ("tests/test_front_door.py", "tests/test_docs.py"),
}
# Not copied: large, made anew, or of no use to tests.
_LEFT_OUT = (".git", ".venv", "runs", "build", "*.egg-info", ".mypy_cache", ".ruff_cache", ".pytest_cache")
# What a message prints is read by nobody's code.
_FOR_READERS = ("__repr__", "__str__", "__format__", "__rich__", "_repr_html_")
_OPERATORS: Mapping[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "//"),
    ast.Lt: ("<", ">"),
    ast.Gt: (">", "<"),
    ast.LtE: ("<=", ">="),
    ast.GtE: (">=", "<="),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
}
# Of these the other one binds otherwise: with brackets.
_BRACKETED: Mapping[type[ast.AST], tuple[str, str]] = {
    ast.Pow: ("**", "*"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}


@dataclass(frozen=True)
class Mutant:
    """file: below the checkout; function: with its classes; statement: its bytes, the innermost one around
    the change; at: of the change in the file."""

    room: str
    file: str
    line: int
    function: str
    statement: bytes
    at: int
    before: bytes
    after: bytes

    def __str__(self) -> str:
        before, statement = (_short(text) for text in (self.before, self.statement))
        return f"{self.file}:{self.line} {self.function}: {before} -> {self.after.decode()} in {statement}"


def _short(text: bytes, most: int = 80) -> str:
    line = " ".join(text.decode().split())
    return line if len(line) <= most else f"{line[:most]}..."


class _Finder(ast.NodeVisitor):
    """All mutants of a source text."""

    def __init__(self, room: str, file: str, source: bytes) -> None:
        self.room, self.file, self.source, self.found = room, file, source, list[Mutant]()
        self._starts = [0]
        for line in source.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))
        self._functions, self._in_function, self._statement = list[str](), False, (0, 0)
        self.visit(ast.parse(source))

    def span(self, node: ast.AST) -> tuple[int, int]:
        """First byte of a node, and the one after its last."""
        first, last = (getattr(node, name) for name in ("lineno", "end_lineno"))
        return self._starts[first - 1] + node.col_offset, self._starts[last - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
            return  # messages; positions within f-strings are wrong before Python 3.12
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            self._definition(node)
            return
        outer = self._statement
        if isinstance(node, ast.stmt):
            first, last = self.span(node)
            body = getattr(node, "body", None)  # of a compound statement its head
            self._statement = first, self.span(body[0])[0] if body else last
        if self._in_function:
            self._at(node)
        for name, value in ast.iter_fields(node):
            if name not in ("annotation", "returns", "decorator_list"):
                for part in value if isinstance(value, list) else [value]:
                    if isinstance(part, ast.AST) and not _is_text(part):
                        self.visit(part)
        self._statement = outer

    def _definition(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> None:
        """Its body only: neither decorators nor defaults nor annotations."""
        was, is_class = self._in_function, isinstance(node, ast.ClassDef)
        if node.name in _FOR_READERS:
            return
        self._functions.append(node.name)
        self._in_function = was if is_class else True
        for part in node.body:
            if not _is_text(part):
                self.visit(part)
        self._in_function = was
        self._functions.pop()

    def _at(self, node: ast.AST) -> None:
        """What may be changed at this node itself."""
        match node:
            case ast.BinOp(left, op, right) | ast.BoolOp(op, [left, right]) if type(op) in _BRACKETED:
                first, last = self.span(node)
                for at, old, new in self._operator(left, right, *_BRACKETED[type(op)]):
                    text = self.source[first:at] + new.encode() + self.source[at + len(old) : last]
                    self._whole(node, f"({text.decode()})")
            case ast.BinOp(left, op, right) | ast.Compare(left, [op], [right]) if type(op) in _OPERATORS:
                self._between(left, right, *_OPERATORS[type(op)])
            case ast.AugAssign(target, op, value) if type(op) in _OPERATORS:
                old, new = _OPERATORS[type(op)]
                self._between(target, value, f"{old}=", f"{new}=")
            case ast.UnaryOp(ast.USub()):
                self._add(self.span(node)[0], b"-", "+")
            case ast.Constant(bool(value)):
                self._whole(node, str(not value))
            case ast.Constant(int(value) | float(value)):
                self._whole(node, repr(value + 1 if isinstance(value, int) or value == 0 else 2 * value))
            case ast.Return(ast.expr() as value) if not _is_none(value):
                self._whole(value, "None")
            case _:
                pass

    def _between(self, left: ast.AST, right: ast.AST, before: str, after: str) -> None:
        for at, old, new in self._operator(left, right, before, after):
            self._add(at, old.encode(), new)

    def _operator(
        self, left: ast.AST, right: ast.AST, before: str, after: str
    ) -> Iterator[tuple[int, str, str]]:
        """Where the operator is between its operands, among brackets and comments, and what it is to be."""
        first, last = self.span(left)[1], self.span(right)[0]
        gap = re.sub(rb"#[^\n]*", lambda found: b" " * len(found[0]), self.source[first:last])
        if gap.count(before.encode()) == 1:
            yield first + gap.index(before.encode()), before, after

    def _whole(self, node: ast.AST, after: str) -> None:
        first, last = self.span(node)
        self._add(first, self.source[first:last], after)

    def _add(self, at: int, before: bytes, after: str) -> None:
        function, statement = ".".join(self._functions), self.source[slice(*self._statement)]
        line = self.source.count(b"\n", 0, at) + 1
        self.found.append(Mutant(self.room, self.file, line, function, statement, at, before, after.encode()))


def _is_text(node: ast.AST) -> bool:
    """A docstring, or a comment in the form of one."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def mutants_of(room: str, file: str, source: bytes) -> list[Mutant]:
    """All there are in a source text."""
    return _Finder(room, file, source).found


def files_of(room: str, root: Path) -> list[Path]:
    """Python files of a room, without those of rooms below it."""
    below = [root / other for other in ROOMS if other.startswith(f"{room}/")]
    return sorted(
        path for path in (root / room).rglob("*.py") if not any(path.is_relative_to(one) for one in below)
    )


def drawn(root: Path, seed: int, per_room: int, rooms: Sequence[str] = tuple(ROOMS)) -> list[Mutant]:
    """So many mutants of every room, none of them twice. A file is as likely as it has mutants."""
    found = []
    for room in rooms:
        rng = np.random.default_rng([seed, list(ROOMS).index(room)])
        every = [
            one
            for path in files_of(room, root)
            for one in mutants_of(room, path.relative_to(root).as_posix(), path.read_bytes())
        ]
        found += [every[k] for k in rng.permutation(len(every))[:per_room]]
    return found


def changed(mutant: Mutant, source: bytes) -> bytes:
    """The source text with the mutant in it."""
    last = mutant.at + len(mutant.before)
    assert source[mutant.at : last] == mutant.before
    return source[: mutant.at] + mutant.after + source[last:]


class Copy:
    """A copy of a checkout into which mutants are put, and a second one that stays as it is."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        self.clean, self.path = folder / "clean", folder / "mutated"
        for copy in (self.clean, self.path):
            shutil.copytree(checkout, copy, ignore=shutil.ignore_patterns(*_LEFT_OUT))
        if (shared := checkout.parent / "shared").is_dir():
            (folder / "shared").symlink_to(shared.resolve())

    def left_behind(self) -> list[str]:
        """Python files that are not as they were."""
        files = {path.relative_to(copy) for copy in (self.clean, self.path) for path in copy.rglob("*.py")}
        return sorted(str(file) for file in files if _digest(self.clean / file) != _digest(self.path / file))

    @contextlib.contextmanager
    def holding(self, mutant: Mutant) -> Iterator[Path]:
        """The copy while the mutant is in it."""
        if left := self.left_behind():
            raise RuntimeError(f"left behind by an earlier mutant: {', '.join(left)}")
        file = self.path / mutant.file
        text = changed(mutant, file.read_bytes())
        compiled = b"njit" in text
        try:
            _forget(file)
            file.write_bytes(text)
            if compiled:
                self._kernels(from_clean=False)
            yield self.path
        finally:
            shutil.copy2(self.clean / file.relative_to(self.path), file)
            _forget(file)
            if compiled:
                self._kernels(from_clean=True)

    def _kernels(self, *, from_clean: bool) -> None:
        """Compiled kernels do not notice that one they call has changed: all are made anew."""
        for path in self.path.rglob("*.nb[ic]"):
            path.unlink()
        for path in self.clean.rglob("*.nb[ic]") if from_clean else ():
            target = self.path / path.relative_to(self.clean)
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(path, target)


def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b""


def _forget(file: Path) -> None:
    """Bytecode goes by size and second of the change, which may be the same."""
    for path in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        path.unlink()


def ran(root: Path, *words: str, cpu_s: float = 3600.0) -> tuple[int, str, float]:
    """Exit code, output and CPU seconds of `python WORDS` with the code of this checkout; the whole group of
    processes ends with it."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    limit = int(cpu_s), int(cpu_s) + 10
    process = subprocess.Popen(
        [sys.executable, *words],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, limit),
    )
    try:
        output, _ = process.communicate()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process.returncode, output, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


class Judge:
    """Asks the tests and frozen answers of a copy, and adds up what that takes."""

    def __init__(self, copy: Copy, *, slow: bool) -> None:
        self.copy, self.slow, self.cpu_s, self.fail_anyway = copy, slow, 0.0, set[str]()

    def verdict(self, mutant: Mutant, *, frozen: bool) -> str:
        """Who saw it. Raises RuntimeError where tests cannot be run."""
        while True:
            with self.copy.holding(mutant) as root:
                failed = self._failed(root, ROOMS[mutant.room])
            if failed is None:
                break
            if self._failed(self.copy.clean, [failed]) is None:
                return f"killed by {failed}"
            if failed in self.fail_anyway:  # no test, which could be left out
                raise RuntimeError(f"the tests cannot be run without a mutant either: {failed}")
            self.fail_anyway.add(failed)
        if not frozen:
            return "survived the tests"
        if not (self.copy.clean / "benchmarks" / "results" / "frozen_answers.txt").is_file():
            return "survived the tests; no frozen answers are stored"
        with self.copy.holding(mutant) as root:
            code, output = self._ran(root, "-m", "benchmarks.frozen_answers", "--stop")
        if code == 0:
            return "survived tests and frozen answers"
        question = re.search(r"not as stored \d+: (.*)", output)
        return f"survived the tests; killed by {question[1] if question else output.strip()[-200:]}"

    def _failed(self, root: Path, tests: Sequence[str]) -> str | None:
        """The first test that fails, of folders, files or names; None where all pass."""
        words = ["-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no", "-rfE", *tests]
        words += [] if self.slow else ["-m", "not slow"]
        code, output = self._ran(root, *words, *(f"--deselect={name}" for name in self.fail_anyway))
        if code in (0, 5):  # 5: no test is left
            return None
        told = re.findall(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", output, re.MULTILINE)
        return told[0] if told else f"(exit {code}: {' '.join(output.split())[-150:]})"

    def _ran(self, root: Path, *words: str) -> tuple[int, str]:
        code, output, cpu_s = ran(root, *words)
        self.cpu_s += cpu_s
        return code, output


def run(
    out: Print,
    *,
    seed: int = 0,
    per_room: int = 2,
    rooms: tuple[str, ...] = tuple(ROOMS),
    list_only: bool = False,
    slow: bool = False,
    frozen: bool = True,
) -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # or the copies would stay in /tmp
    mutants = drawn(ROOT, seed, per_room, rooms)
    if list_only:
        for mutant in mutants:
            out(f"{mutant.room:18s} {mutant}")
        return
    seen = 0
    with tempfile.TemporaryDirectory(prefix="flexlink-mutants-") as folder:
        judge = Judge(Copy(ROOT, Path(folder)), slow=slow)
        for mutant in mutants:
            judge.cpu_s = 0.0
            verdict = judge.verdict(mutant, frozen=frozen)
            seen += "killed by" in verdict
            out(f"{mutant.room:18s} {mutant}\n    {verdict}; {judge.cpu_s:.0f} s CPU")
        if judge.fail_anyway:
            out(f"left out, for they fail without a mutant: {', '.join(sorted(judge.fail_anyway))}")
    out(f"{seen} of {len(mutants)} seen")


if __name__ == "__main__":
    main(run)
