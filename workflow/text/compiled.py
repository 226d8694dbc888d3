"""Compiled templates beside the compiled modules: to compile those of a page takes half a second."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import marshal
import os
import sys
import tempfile
from pathlib import Path

import jinja2
from jinja2.bccache import Bucket, BytecodeCache


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
            digest, code = content[:32], content[32:]
            if digest == self._digest(bucket, code):
                bucket.code = marshal.loads(code)

    def dump_bytecode(self, bucket: Bucket) -> None:
        if sys.dont_write_bytecode or bucket.code is None:
            return
        path, code = _file(bucket), marshal.dumps(bucket.code)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            # Several processes may write at once: each its own file, and the last one stays.
            handle, part = tempfile.mkstemp(dir=path.parent, suffix=".part")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(self._digest(bucket, code) + code)
                os.replace(part, path)
            except BaseException:
                Path(part).unlink(missing_ok=True)
                raise

    def _digest(self, bucket: Bucket, code: bytes) -> bytes:
        return hashlib.sha256(f"{self._made_by} {bucket.checksum}".encode() + code).digest()


def _file(bucket: Bucket) -> Path:
    beside = Path(__file__).with_name(f"template-{bucket.key}.py")
    return Path(importlib.util.cache_from_source(str(beside))).with_suffix(".template")
