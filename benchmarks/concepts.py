"""How much the product asks a reader to hold in mind, counted room by room from its syntax trees.

    python -m benchmarks.concepts            the table
    python -m benchmarks.concepts --lower    takes the ceilings (tests/golden/ceilings.toml) down to them

statements   without docstrings, imports, raises and passes, so that formatting changes none of them
numbers      at module level; of a pair of assignments each counts
double       names of classes that are defined in more than one module of the product
options      of the command line, written by hand; settings: fields of pydantic models

A ceiling is never raised here: `--lower` refuses while a figure stands above its ceiling.
"""

from __future__ import annotations

import ast
import collections
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from benchmarks.harness import Print, main

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = ROOT / "tests" / "golden" / "ceilings.toml"
PRODUCT = ("workflow", "ident", "diagnosis", "control_design", "plant", "flexlink")
BESIDE = ("validation", "benchmarks", "tests")
FIGURES = (
    "files",
    "lines",
    "statements",
    "functions",
    "classes",
    "dataclasses",
    "numbers",
    "settings",
    "options",
    "double",
)


def _numeric(value: ast.expr) -> bool:
    constants = [part.value for part in ast.walk(value) if isinstance(part, ast.Constant)]
    numbers = [one for one in constants if isinstance(one, int | float) and not isinstance(one, bool)]
    return bool(numbers) and not any(isinstance(one, str) for one in constants)


def _module_numbers(body: Iterable[ast.stmt]) -> Iterator[ast.expr]:
    for one in body:
        if not isinstance(one, ast.Assign | ast.AnnAssign) or one.value is None:
            continue
        target = one.targets[0] if isinstance(one, ast.Assign) else one.target
        if isinstance(target, ast.Tuple) and isinstance(one.value, ast.Tuple):
            yield from filter(_numeric, one.value.elts)
        elif isinstance(target, ast.Name) and not isinstance(one.value, ast.Call) and _numeric(one.value):
            yield one.value


def _counts_as_statement(node: ast.AST) -> bool:
    said = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    docstring = said and isinstance(node.value.value, str)  # type: ignore[attr-defined]
    skipped = isinstance(node, ast.Import | ast.ImportFrom | ast.Raise | ast.Pass)
    return isinstance(node, ast.stmt) and not skipped and not docstring


def count(source: str) -> tuple[collections.Counter[str], set[str]]:
    """Figures of one module, and the names of its classes."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
    found = collections.Counter(
        files=1,
        lines=source.count("\n"),
        statements=sum(map(_counts_as_statement, nodes)),
        functions=sum(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for node in nodes),
        classes=len(classes),
        numbers=sum(1 for _ in _module_numbers(tree.body)),
        options=sum(
            isinstance(node, ast.Call) and ast.unparse(node.func) in ("typer.Option", "typer.Argument")
            for node in nodes
        ),
    )
    for one in classes:
        found["dataclasses"] += any("dataclass" in ast.unparse(mark) for mark in one.decorator_list)
        bases = " ".join(map(ast.unparse, one.bases))
        if any(base in bases for base in ("BaseModel", "Settings", "Table")):
            found["settings"] += sum(isinstance(member, ast.AnnAssign) for member in one.body)
    return found, {one.name for one in classes}


def figures(root: Path = ROOT) -> dict[str, collections.Counter[str]]:
    """Of every room, of the product and of what stands beside it."""
    rooms: dict[str, collections.Counter[str]] = {}
    places: collections.Counter[str] = collections.Counter()
    for room in PRODUCT + BESIDE:
        rooms[room] = collections.Counter()
        for path in sorted((root / room).rglob("*.py")):
            found, names = count(path.read_text(encoding="utf-8"))
            rooms[room].update(found)
            if room in PRODUCT:
                places.update(names)
    product = sum((rooms[room] for room in PRODUCT), collections.Counter())
    product["double"] = sum(times > 1 for times in places.values())
    return {**{room: rooms[room] for room in PRODUCT}, "product": product} | {r: rooms[r] for r in BESIDE}


def ceilings() -> dict[str, dict[str, int]]:
    return tomllib.loads(CEILINGS.read_text(encoding="utf-8"))


def above(found: Mapping[str, Mapping[str, int]], held: Mapping[str, Mapping[str, int]]) -> list[str]:
    """In words, each figure that stands above its ceiling."""
    return [
        f"{room}: {found[room][figure]} {figure}, the ceiling is {most}"
        for room, most_of in held.items()
        for figure, most in most_of.items()
        if found[room][figure] > most
    ]


def run(out: Print, *, lower: bool = False) -> None:
    found = figures()
    out("room".ljust(15) + "".join(figure.rjust(12) for figure in FIGURES))
    for room, counted in found.items():
        out(room.ljust(15) + "".join(str(counted[figure]).rjust(12) for figure in FIGURES))
    if lower:
        held = ceilings()
        if higher := above(found, held):
            sys.exit("no ceiling is raised: " + "; ".join(higher))
        head = CEILINGS.read_text(encoding="utf-8").partition("[")[0]
        tables = (
            f"[{room}]\n" + "".join(f"{figure} = {found[room][figure]}\n" for figure in most_of)
            for room, most_of in held.items()
        )
        CEILINGS.write_text(head + "\n".join(tables), encoding="utf-8")


if __name__ == "__main__":
    main(run)
