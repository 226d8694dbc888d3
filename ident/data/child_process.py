"""Files that only a compiled library reads: in a process of its own, whose end is a refusal and not ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from ident.data.foreign_files import shown

_SCRIPT = Path(__file__).with_name("child_reader.py")
_SECONDS = 150
_REFUSED, _NO_LIBRARY = 2, 3


def read_in_child(kind: str, library: str, content: bytes, extra: str = "logs") -> bytes:
    """What `child_reader` makes of the bytes of a file of this kind (HDF5, parquet, xlsx, MCAP, bag, db3).

    Raises ValueError, beginning with ':': damaged, too large, too slow, or the library is not installed.
    """
    # No plug-ins that the surroundings name: a filter of HDF5 is a library that gets loaded.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("HDF5", "PYTHON"))}
    command = [sys.executable, "-I", str(_SCRIPT), kind.lower()]
    try:
        done = subprocess.run(
            command,
            input=content,
            capture_output=True,
            timeout=_SECONDS,
            env=kept | {"HDF5_PLUGIN_PRELOAD": "::"},
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f": not read in {_SECONDS} s; a smaller file, or CSV, is") from None
    if done.returncode == 0:
        return done.stdout
    said = shown(done.stderr.decode("utf-8", "replace"))
    if done.returncode == _NO_LIBRARY:
        raise ValueError(
            f": {kind} files need {library}: pip install 'flexlink[{extra}]' (or pip install {library})"
        )
    raise ValueError(
        f": {said if done.returncode == _REFUSED and said else f'not a {kind} file, or a damaged one'}"
    )
