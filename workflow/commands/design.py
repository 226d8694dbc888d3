"""`flexlink design`: one controller for one or several plants, from files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from workflow.config.design_file import DesignFile, read_design_file
from workflow.engine.errors import InputError, need
from workflow.engine.progress import Progress

if TYPE_CHECKING:
    from control_design.controllers.c_code import Dialect
    from workflow.tasks.summary import RunSummary


def design_controller(
    sources: Path | Sequence[Path],
    specification_path: Path | None,
    *,
    out: Path | None = None,
    seed: int = 2006,
    dialect: Dialect | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Design and certify one controller for one or several plants (files: `workflow.tasks.design_source`).

    Without a design file the source must be a run directory, whose own specification is taken. With `out` the
    controller is written, by its ending as JSON, MAT file or C source, and beside it a reference filter if
    there is one (`dialect` says how C is written); a controller that is not certified carries that in its
    name. A specification that no controller can meet is a result (not certified, the reason in `verdict`), as
    in a run. Raises InputError.
    """
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(path) for path in sources]
    if not paths:
        raise InputError("nothing to design for: give at least one run directory or file with a plant")
    need(*paths)
    file = read_design_file(specification_path) if specification_path is not None else DesignFile()
    # Here: what designs takes seconds to load, and a design file that is refused does not need it.
    from workflow.commands.designed import designed

    return designed(
        paths,
        file,
        name=str(specification_path or paths[0]),
        out=out,
        seed=seed,
        dialect=dialect,
        progress=progress,
    )
