"""`flexlink identify`: log files in; model files, a page and a table of numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ident.basis.options import IdentOptions
from ident.data.record import Record
from workflow.config.settings import check
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine import storage
from workflow.engine.errors import naming
from workflow.engine.progress import Progress

if TYPE_CHECKING:
    from workflow.tasks.summary import RunSummary


def identify_logs(
    logs: Sequence[Path],
    input_name: str,
    output_name: str,
    *,
    time: str | None = None,
    dt_s: float | None = None,
    time_unit: str | None = None,
    reference: str | None = None,
    input_limit: float | None = None,
    validation: Sequence[Path] = (),
    options: IdentOptions | None = None,
    level: float = 0.95,
    promise: str = "as recorded",
    band_rad_s: tuple[float, float] | None = None,
    noise_order: int | None = None,
    out: Path | None = None,
    report: Path | None = None,
    export: Path | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Identify one channel from log files (tangent uncertainty) and write what is asked for.

    out: npz with model and posterior, for `flexlink design`; report: HTML page; export: the model as .json
    or .mat. Every file is written when everything is known, and whole. reference: column of the reference of
    logs made in closed loop, for the two-stage method. input_limit: what the amplifier gives at most; larger
    commands in the logs are taken as that. time_unit: of the time column, where its name does not say it.
    band_rad_s: fit inside this band only, friction and drift below it and noise above it left out. promise:
    what the ellipses are about, as `uncertainty.promise` of a configuration; output_name is then the position
    of the shaft that the friction acts on. noise_order: largest order of the noise model behind the ellipses;
    none given: 8, or 32 where that leaves coloured residuals. Raises InputError: one line naming file, column
    or line.
    """
    promised = check(UncertaintyOptions, {"level": level, "promise": promise}, source="options")
    # A log given twice would count its noise twice as well known, or validate what it was fitted to.
    written = [("--out", out), ("--report", report), ("--export", export)]
    storage.refuse_in_the_way([*logs, *validation], [(name, path) for name, path in written if path])
    references = [] if reference is None else [reference]

    def read(path: Path) -> Record:
        with naming(str(path)):
            record = Record.from_file(
                path,
                [input_name],
                [output_name],
                time=time,
                dt_s=dt_s,
                time_unit=time_unit,
                references=references,
            )
            return record if input_limit is None else record.limited(input_limit)

    measured = [read(Path(path)) for path in logs]
    fresh_logs = [read(Path(path)) for path in validation]
    # Here: what identifies takes seconds to load, and a log that is refused does not need it.
    from workflow.commands.identified import Asked, identified

    return identified(
        measured,
        fresh_logs,
        Asked(
            (*logs, *validation), options, promised, band_rad_s, noise_order, input_limit, out, report, export
        ),
        progress or Progress(),
    )
