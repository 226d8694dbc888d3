"""MATLAB files as plain variables: the one place that knows what scipy raises on files it cannot read."""

from __future__ import annotations

import io
from os import PathLike
from typing import Any


def mat_variables(content: str | PathLike[str] | bytes, source: object) -> dict[str, Any]:
    """Variables of a MATLAB file up to version 7.2, by name, as scipy reads them.

    content: a path, or the bytes of a file; source: what a complaint names.

    Raises ValueError if it is a version 7.3 file (HDF5), or no MATLAB file.
    """
    import scipy.io  # here: few runs read such files, and every command would wait for it

    stream: Any = io.BytesIO(content) if isinstance(content, bytes) else content
    try:
        raw = scipy.io.loadmat(stream)
    except NotImplementedError:  # scipy's word for version 7.3
        raise ValueError(f"{source}: a version 7.3 .mat file; save it with '-v7' in MATLAB") from None
    except Exception as error:  # scipy raises many kinds on damaged files
        raise ValueError(f"{source}: not a MATLAB .mat file ({type(error).__name__})") from None
    return {name: value for name, value in raw.items() if not name.startswith("__")}
