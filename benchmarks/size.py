"""How large the house is: lines, boxes and arrows of every package, and the sentences left in Python.

Lines: all lines of `*.py`. Boxes: files or folders seen from the top of the package; arrows: imports between
two of them, the package's own `__init__` left out. Sentences: lines of string literals of four words or more
that are no docstring, no error (`raise`, a call of an exception) and no help text of an option.
"""

from __future__ import annotations

import ast
from pathlib import Path

import grimp

from benchmarks.harness import Print, main

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("plant", "ident", "control_design", "diagnosis", "workflow")
BESIDE = ("flexlink", "validation", "benchmarks", "tests")
HELP = ("Option", "Argument", "Typer", "command", "Field")


def sentences(source: str) -> int:
    """Lines of sentences in one module."""
    tree = ast.parse(source)
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        # A string that stands alone is a docstring.
        name = ast.unparse(node.func).split(".")[-1] if isinstance(node, ast.Call) else ""
        alone = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Raise) or alone or name in HELP or name.endswith("Error"):
            skipped.update(ast.walk(node))
        elif isinstance(node, ast.JoinedStr) and node not in skipped:
            skipped.update(set(ast.walk(node)) - {node})
    lines = 0
    for node in ast.walk(tree):
        if node in skipped or not isinstance(node, ast.Constant | ast.JoinedStr):
            continue
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        text = "".join(str(p.value) if isinstance(p, ast.Constant) else "X" for p in parts)
        of_words = isinstance(node, ast.JoinedStr) or isinstance(node.value, str)
        lines += (node.end_lineno or 0) - node.lineno + 1 if of_words and text.count(" ") > 2 else 0
    return lines


def boxes_and_arrows(package: str) -> tuple[int, int]:
    graph = grimp.build_graph(package, cache_dir=None)
    boxes = graph.find_children(package)
    for box in boxes:
        graph.squash_module(box)
    arrows = sum(len(graph.find_modules_directly_imported_by(box) & boxes) for box in boxes)
    return len(boxes), arrows


def run(out: Print) -> None:
    out(f"{'':<16}{'lines':>7}{'files':>7}{'sentences':>11}{'boxes/arrows':>14}")
    total = [0, 0, 0]
    for package in (*PRODUCT, *BESIDE):
        texts = [path.read_text(encoding="utf-8") for path in (ROOT / package).rglob("*.py")]
        counts = sum(text.count("\n") for text in texts), len(texts), sum(map(sentences, texts))
        drawn = "" if package in BESIDE else "{}/{}".format(*boxes_and_arrows(package))
        out(f"{package:<16}{counts[0]:>7}{counts[1]:>7}{counts[2]:>11}{drawn:>14}")
        if package in PRODUCT:
            total = [a + b for a, b in zip(total, counts, strict=True)]
        if package == PRODUCT[-1]:
            out(f"{'product':<16}{total[0]:>7}{total[1]:>7}{total[2]:>11}")


if __name__ == "__main__":
    main(run)
