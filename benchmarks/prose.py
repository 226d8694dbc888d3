"""How long the sentences of README, documents and templates are, and words of our own, a row per file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, main

ROOT = Path(__file__).parents[1]
LONG = 28
"""A sentence of more words is long."""
OWN = re.compile(
    r"behind (its|the|their) (dry )?friction|interests?\b(?! rate)|com(e|es|ing) to rest|asked for|\banew\b"
    r"|taken up|whole responses|for good\b|beyond the list|\bis none\b|told apart|in words\b|beside a\b"
    r"|(that|what) is left\b|nobody (has )?(said|stated|asked)|\bpromise|yardstick|imitat|rivals?\b"
    r"|of one's own|is no sharp|lets? it be",
    re.IGNORECASE,
)
"""Words for which the field has a better one."""
WHERE = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "docs/**/*.md",
    "*/templates/**/*.j2",
    "workflow/cli.py",
)
_END = re.compile(r"(?<=[.!?])\s+|\n\s*\n|\n\s*(?:[-*#]|\d\.)+\s*|;\s|:\s*\n")
_WORD = re.compile(r"[A-Za-z][\w'-]*")


def run(out: Print) -> None:
    out(f"{'file':<52}{'sentences':>10}{'median':>8}{'90 %':>6}{f'above {LONG}':>10}   words{'own':>6}")
    for path in files():
        found = list(sentences(path))
        lengths = [len(_WORD.findall(sentence)) for sentence in found]
        own = sum(len(OWN.findall(sentence)) for sentence in found)
        if lengths:
            median, most = np.percentile(lengths, [50, 90])
            share = 100 * np.mean(np.array(lengths) > LONG)
            name = str(path.relative_to(ROOT))
            out(f"{name:<52}{len(lengths):10d}{median:8.0f}{most:6.0f}{share:8.0f} %{own:14d}")


def files() -> list[Path]:
    return sorted({path for pattern in WHERE for path in ROOT.glob(pattern) if path.is_file()})


def sentences(path: Path) -> Iterator[str]:
    """Sentences of more than three words: of a document without code and tables, of a template without its
    statements, of a command line its help."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        text = "\n\n".join(re.findall(r'help="([^"]+)"', text))
    elif path.suffix == ".md":
        text = re.sub(r"```.*?```", "\n\n", text, flags=re.DOTALL)
        text = "\n".join("" if line.startswith(("    ", "|", ">>>")) else line for line in text.splitlines())
    else:
        text = re.sub(r"\{#.*?#\}|\{%.*?%\}", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"\{\{.*?\}\}|`[^`]*`", "X", text, flags=re.DOTALL)
    text = re.sub(r"<[^>]+>|\]\([^)]*\)", " ", text)
    for sentence in _END.split(text):
        if len(_WORD.findall(sentence)) > 3:
            yield " ".join(sentence.split())


if __name__ == "__main__":
    main(run, seeds="none")
