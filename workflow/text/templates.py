"""The environments of all templates; they load no matplotlib, so texts for terminals come from them too."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import marshal
import re
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from jinja2.bccache import Bucket, BytecodeCache
from markupsafe import Markup

from workflow.text.findings.sentences import words
from workflow.text.formats import FILTERS, TESTS
from workflow.text.options import option, stated


@cache
def environment(*own: tuple[str, Callable[..., Any]], package: str = "workflow") -> Environment:
    """The environment of all pages and texts; another package's templates come before ours.

    own: filters (name, function) beside those of all. Everything that comes from the user is escaped.
    """
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "workflow"))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=None if own else CompiledTemplates(),
    )
    made.filters.update(FILTERS, words=words, labelled=labelled, option=option, stated=stated)
    made.filters.update(own)
    made.tests.update(TESTS)
    return made


def labelled(rows: Markup, head: Sequence[str]) -> Markup:
    """Rows of a table whose cells carry the words of their column, for screens too narrow for columns."""

    def of_row(row: re.Match[str]) -> str:
        words = iter(Markup.escape(word) for word in head)

        def labelled_cell(_: re.Match[str]) -> str:
            # Cells behind the last word, and those of a column without one, stay as they are.
            word = next(words, "")
            return f'<td data-head="{word}">' if word else "<td>"

        return re.sub("<td>", labelled_cell, row[0])

    return Markup(re.sub("<tr.*?</tr>", of_row, rows, flags=re.DOTALL))


def render_text(template: str, **values: Any) -> str:
    """Plain text by template: for terminals and files. Nothing is escaped."""
    return Markup(environment().get_template(template).render(**values)).unescape()


class CompiledTemplates(BytecodeCache):
    """Kept as Python keeps its own: in `__pycache__`, a file each, nothing where none can be written.

    jinja2's own cache of files reads pickles. Here a file counts only when it is whole, for the Python, the
    jinja2 and the text it was made of, and for the modules of `filters`: those of constants are evaluated
    when a template is compiled.
    """

    def __init__(self, filters: Path = Path(__file__).parent) -> None:
        code = b"".join(path.read_bytes() for path in sorted(filters.glob("*.py")))
        self._made_by = f"{sys.version} {jinja2.__version__} {hashlib.sha256(code).hexdigest()}"

    def load_bytecode(self, bucket: Bucket) -> None:
        with contextlib.suppress(OSError):
            content = _file(bucket).read_bytes()
            # A SHA-256 has 32 bytes. A file that was written only in part has another one.
            digest, code = content[:32], content[32:]
            if digest == self._digest(bucket, code):
                bucket.code = marshal.loads(code)

    def dump_bytecode(self, bucket: Bucket) -> None:
        if sys.dont_write_bytecode or bucket.code is None:
            return
        path = _file(bucket)
        code = marshal.dumps(bucket.code)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            # Half of it would not count.
            path.write_bytes(self._digest(bucket, code) + code)

    def _digest(self, bucket: Bucket, code: bytes) -> bytes:
        return hashlib.sha256(f"{self._made_by} {bucket.checksum}".encode() + code).digest()


def _file(bucket: Bucket) -> Path:
    beside = Path(__file__).with_name(f"template-{bucket.key}.py")
    return Path(importlib.util.cache_from_source(str(beside))).with_suffix(".template")
