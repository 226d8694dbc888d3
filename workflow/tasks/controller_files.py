"""A controller as files, and its reference filter beside it; one that is not certified says so inside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from control_design.controllers.c_code import Dialect, c_header, c_source
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from workflow.engine import codec, storage
from workflow.text.templates import render_text

RUN_FILES = ("controller.json", "controller.c", "controller.h")
"""What a run leaves in its directory; those of a reference filter are named after them (`filter_file`)."""


def _noted(code: Callable[..., str], found: ReferenceFilter, dialect: Dialect) -> bytes:
    """The C code of a reference filter behind a note on how it is called."""
    names = dialect.beside("reference_filter")
    note = render_text("reference_filter_note.h.j2", prefix=names.prefix).rstrip()
    return f"{note}\n{code(_as_law(found), names.prefix, names.number)}".encode("ascii")


def _mat(controller: Controller) -> bytes:
    stream = BytesIO()
    controller.save_mat(stream)
    return stream.getvalue()


def _filter_mat(found: ReferenceFilter) -> bytes:
    stream: Any = BytesIO()  # scipy takes any binary file; its annotations know of paths only
    scipy.io.savemat(stream, codec.plain(found))
    return bytes(stream.getvalue())


def _as_law(found: ReferenceFilter) -> Controller:
    """The controller's generator serves: a state space without limits, from reference to filtered one."""
    return Controller(
        A=found.A,
        B=found.B,
        C=found.C,
        D=found.D,
        dt_s=found.dt_s,
        computational_delay_samples=0,
        anti_windup_gain=np.zeros_like(found.B),
        name="reference_filter",
    )


_CONTROLLER: Mapping[str, Callable[[Controller, Dialect], bytes]] = {
    ".json": lambda controller, _: controller.to_json().encode(),
    ".mat": lambda controller, _: _mat(controller),
    ".c": lambda controller, c: c_source(controller, c.prefix, c.number).encode("ascii"),
    ".h": lambda controller, c: c_header(controller, c.prefix, c.number).encode("ascii"),
}
_FILTER: Mapping[str, Callable[[ReferenceFilter, Dialect], bytes]] = {
    ".json": lambda found, _: found.to_json().encode(),
    ".mat": lambda found, _: _filter_mat(found),
    ".c": partial(_noted, c_source),
    ".h": partial(_noted, c_header),
}
SUFFIXES = (".json", ".mat", ".c")


def filter_file(controller_file: Path) -> Path:
    """Where the reference filter of a controller is written: beside it, by the same ending."""
    return controller_file.with_name(f"{controller_file.stem}_reference_filter{controller_file.suffix}")


def filter_bytes(found: ReferenceFilter, suffix: str, dialect: Dialect = Dialect()) -> bytes:  # noqa: B008
    """The file's content, by the ending."""
    return _FILTER[suffix.lower()](found, dialect)


def targets(out: Path) -> list[Path]:
    """Files of a controller written to `out`: those of a run in a directory, C with its header."""
    if out.is_dir():
        return [out / name for name in RUN_FILES]
    return [out, out.with_suffix(".h")] if out.suffix.lower() == ".c" else [out]


def write_controller(
    out: Path,
    controller: Controller,
    reference_filter: ReferenceFilter | None,
    *,
    certified: bool,
    about: str = "",
    dialect: Dialect | None = None,
) -> list[Path]:
    """Write the `targets` of `out` where their content is not there already; the files there are now.

    about: what it is certified for; dialect: of the C code.
    """
    c = dialect or Dialect()
    known = f", certified for {about}" if about else ""
    law = replace(controller, name=controller.name + (known if certified else " (NOT CERTIFIED)"))
    content = {path: _CONTROLLER[path.suffix.lower()](law, c) for path in targets(out)}
    if reference_filter is not None:
        content |= {
            filter_file(path): filter_bytes(reference_filter, path.suffix, c) for path in targets(out)
        }
    storage.write_together(
        {path: data for path, data in content.items() if not path.is_file() or path.read_bytes() != data}
    )
    return list(content)
