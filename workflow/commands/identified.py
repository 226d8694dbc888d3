"""`flexlink identify`: log files in; model files, a page and a table of numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ident.basis.model_files import ModelFile
from ident.basis.options import IdentOptions
from ident.data.record import Record
from workflow.config.run_config import UncertaintyOptions
from workflow.config.settings import check
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.tasks import truth
from workflow.tasks.log_identification import LogIdentification, identify_records
from workflow.tasks.model_files import MODEL_SUFFIXES, write_model
from workflow.tasks.records import refuse_constant_input, with_common_sampling_time
from workflow.tasks.results import IdentifiedPlant
from workflow.tasks.summary import RunSummary, model_numbers, uncertainty_numbers
from workflow.text.formats import count
from workflow.text.templates import rows_of, words


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
    if export is not None and export.suffix.lower() not in MODEL_SUFFIXES:
        raise InputError(f"--export {export}: the ending must be {' or '.join(MODEL_SUFFIXES)}")
    # A log given twice would count its noise twice as well known, or validate what it was fitted to.
    written = [("--out", out), ("--report", report), ("--export", export)]
    storage.refuse_in_the_way([*logs, *validation], [(name, path) for name, path in written if path])
    progress = progress or Progress()
    progress.plan((("identify", 2.0), ("uncertainty", 1.0), *((("report", 4.0),) if report else ())))
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

    true_modes = truth.truth_beside([*logs, *validation], output_name)
    measured = [read(Path(path)) for path in logs]
    fresh_logs = [read(Path(path)) for path in validation]
    for record in measured:
        refuse_constant_input(record)
    common = with_common_sampling_time([*measured, *fresh_logs])
    result = identify_records(
        common[: len(measured)],
        common[len(measured) :],
        options,
        promised=promised,
        band_rad_s=band_rad_s,
        noise_order=noise_order,
        with_plot=report is not None,
        progress=progress,
    )
    result = replace(result, true_modes=truth.beside(result.about, true_modes), input_limit=input_limit)
    if report is not None:
        from workflow.report.identify_page import identify_page  # loads matplotlib: a second

        with progress.stage("report") as update:
            inputs = {str(path): storage.sha256_of_file(Path(path)) for path in (*logs, *validation)}
            storage.write_text(report, identify_page(result, inputs, update))
    if out is not None:
        plant = IdentifiedPlant(result.spread.nominal, result.spread.posterior, level)
        storage.write_npz(out, codec.to_arrays(plant))
    if export is not None:
        write_model(export, ModelFile(result.about.model, result.spread.frequency))
    return _summary(result, out, report, export)


def _summary(
    result: LogIdentification, out: Path | None, report: Path | None, export: Path | None
) -> RunSummary:
    about, spread = result.about, result.spread
    return RunSummary(
        title=f"{about.input} to {about.output}",
        sections=rows_of("summary/identification.j2", result=result),
        numbers={
            **model_numbers(about),
            "warnings": [words(item) for item in result.careful],
            "logs": [_log_numbers(record) for record in (*result.measured, *result.fresh_records)],
            "uncertainty": uncertainty_numbers(spread),
            "file": None if out is None else str(out),
            "model_file": None if export is None else str(export),
        },
        verdict=count(len(result.careful), "warning"),
        report_path=None if report is None else str(report),
    )


def _log_numbers(record: Record) -> dict[str, Any]:
    return {
        "name": record.name,
        "dt_s": record.dt_s,
        "time_column": codec.plain(record.time_column),
        "input_unit": "".join(record.input_units),
        "output_unit": "".join(record.output_units),
        "input_cut_samples": record.cut,
    }
