"""`flexlink identify`: log files in; model files, a page and a table of numbers out."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ident.basis.options import IdentOptions
from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.roles import roles_of
from workflow.config.settings import check
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine import storage
from workflow.engine.errors import naming
from workflow.engine.progress import Progress

if TYPE_CHECKING:
    from workflow.tasks.summary import RunSummary


def identify_logs(
    logs: Sequence[Path],
    input_name: str | None = None,
    output_name: str | None = None,
    *,
    time: str | None = None,
    dt_s: float | None = None,
    time_unit: str | None = None,
    scale: Mapping[str, float] | None = None,
    offset: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    repair: bool = False,
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
    commands in the logs are taken as that. Input, output and time that are not named are found where names
    and units leave no doubt. scale, offset, units, repair: as in `Record.from_file`.
    time_unit: of the time column, where its name does not say it.
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
    if input_name is None or output_name is None or (time is None and dt_s is None):
        with naming(str(logs[0])):
            table, log = read_table(logs[0]), shlex.quote(str(logs[0]))
            roles = roles_of(table, log, input=input_name, output=output_name, time=time, reference=reference)
        input_name, output_name = roles.input, roles.output
        time = roles.time if time is None and dt_s is None else time

    def read(path: Path) -> Record:
        with naming(str(path)):
            record = Record.from_file(
                path,
                [input_name],
                [output_name],
                time=time,
                dt_s=dt_s,
                time_unit=time_unit,
                scale=scale,
                offset=offset,
                units=units,
                repair=repair,
                references=references,
            )
            return record if input_limit is None else record.limited(input_limit)

    measured = [read(Path(path)) for path in logs]
    fresh_logs = [read(Path(path)) for path in validation]
    # Here: what identifies takes seconds to load, and a log that is refused does not need it.
    from workflow.commands.identified import identified

    return identified(
        measured,
        fresh_logs,
        files=[*logs, *validation],
        options=options,
        promised=promised,
        band_rad_s=band_rad_s,
        noise_order=noise_order,
        input_limit=input_limit,
        out=out,
        report=report,
        export=export,
        progress=progress or Progress(),
    )
