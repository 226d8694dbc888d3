"""`flexlink identify`: logs in; model files, a page and a table of numbers out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ident.basis.options import IdentOptions
from workflow.commands.logs import Logs
from workflow.config.command_files import refuse_model_ending
from workflow.config.run_config import ClosedLoopData
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.describe.summary import RunSummary
from workflow.engine import codec, interrupts, storage
from workflow.engine.errors import naming
from workflow.engine.progress import Progress
from workflow.tasks.early_refusals import (
    fit_options,
    naming_readings,
    refuse_constant_input,
    refuse_hopeless_channel,
    single_channel,
)
from workflow.text.findings.sentences import words
from workflow.text.formats import count
from workflow.text.options import speaking


def identify_logs(
    logs: Logs,
    *,
    options: IdentOptions | None = None,
    described: UncertaintyOptions | None = None,
    band_rad_s: tuple[float, float] | None = None,
    loop: ClosedLoopData | None = None,
    out: Path | None = None,
    report: Path | None = None,
    export: Path | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Identify one channel from logs and write what is asked for.

    Every file is written when everything is known, and whole.

    Parameters
    ----------
    logs : Logs
    options : IdentOptions, optional
        Of the pole search.
    described : UncertaintyOptions, optional
        What the ellipses describe. Where friction is identified the output is the position of the shaft on
        which it acts.
    band_rad_s : tuple of two float, optional
        The data are confined to this band [rad/s].
    loop : ClosedLoopData, optional
        How logs that were made in closed loop are used.
    out : Path, optional
        npz with model and posterior, for `flexlink design`.
    report : Path, optional
        HTML page.
    export : Path, optional
        The model as .json or .mat.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line.
    """
    progress = progress or Progress()
    described = described or UncertaintyOptions()
    refuse_model_ending(export)
    for record in logs.measured:
        refuse_constant_input(record)
    with naming("identify"):
        channel = single_channel(logs.measured[0], fit_options(options), described, band_rad_s)
    records = [*logs.measured, *logs.fresh]
    with naming_readings(records):
        refuse_hopeless_channel(channel, logs.measured, loop or ClosedLoopData(), progress)

    # What is refused does not wait for what identifies: that takes seconds to load.
    from ident.basis.model_files import ModelFile
    from ident.command_timing import timing_of, with_equivalent_command
    from workflow.describe.identification import model_numbers
    from workflow.describe.identify import identify_sections
    from workflow.describe.uncertainty import uncertainty_numbers
    from workflow.tasks.exports import model_bytes
    from workflow.tasks.identification import made_in_loop
    from workflow.tasks.log_identification import identify_records
    from workflow.tasks.records import with_common_sampling_time
    from workflow.tasks.results import IdentifiedPlant
    from workflow.tasks.simulated_rig import beside, truth_beside

    steps = [("identify", 2.0), ("uncertainty", 1.0)]
    if report:
        steps.append(("report", 4.0))
    progress.plan(steps)

    # The records on one clock, with the command that acted between their rows.
    true_modes = truth_beside(logs.files, logs.measured[0].output_names[0])
    in_loop = loop is not None and loop.stated
    common = with_common_sampling_time(records)
    n_measured = len(logs.measured)
    with speaking("identify"), naming_readings(records), naming("identify"):
        timing = timing_of(
            common,
            in_loop=in_loop or made_in_loop(common[:n_measured]),
            stated_period_s=logs.controller_period_s,
            averaged=logs.command_averaged,
        )
        common = with_equivalent_command(common, timing)
    with speaking("identify"), naming_readings(records):
        result = identify_records(
            common[:n_measured],
            common[n_measured:],
            options,
            described=described,
            band_rad_s=band_rad_s,
            loop=loop,
            with_plot=report is not None,
            timing=timing,
            progress=progress,
        )
    result = replace(result, true_modes=beside(result.about, true_modes), input_limit=logs.input_limit)

    # Files are written together at the end, so that a refusal leaves none.
    written: dict[Path, bytes] = {}
    if report is not None:
        # Only a page needs what draws.
        from workflow.report.pages import identify_page

        with progress.stage("report") as update:
            inputs = {str(path): storage.sha256_of_file(path) for path in logs.files}
            with speaking("identify"):
                written[report] = identify_page(result, inputs, update).encode()
    if out is not None:
        plant = IdentifiedPlant(result.spread.nominal, result.spread.posterior, described.level)
        written[out] = storage.npz_bytes(codec.to_arrays(plant))
    if export is not None:
        written[export] = model_bytes(export, ModelFile(result.about.model, result.spread.frequency))
    interrupts.check()
    storage.write_together(written)
    with speaking("identify"):
        about = result.about
        spread = result.spread
        log_numbers = []
        for record in (*result.measured, *result.fresh_records):
            log_numbers.append(
                {
                    "name": record.name,
                    "dt_s": record.dt_s,
                    "time_column": codec.plain(record.time_column),
                    "input_unit": "".join(record.input_units),
                    "output_unit": "".join(record.output_units),
                    "input_cut_samples": record.cut,
                }
            )
        return RunSummary(
            title=f"{about.input} to {about.output}",
            sections=identify_sections(result),
            numbers={
                **model_numbers(about),
                "warnings": [words(item) for item in result.careful],
                "logs": log_numbers,
                "uncertainty": uncertainty_numbers(spread),
                "file": None if out is None else str(out),
                "model_file": None if export is None else str(export),
            },
            verdict=count(len(result.careful), "warning"),
            report_path=None if report is None else str(report),
        )
