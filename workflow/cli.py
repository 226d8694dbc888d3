"""The command line: every command parses, makes one library call, prints, and leaves an exit code.

0 ok; 1 internal error; 2 something given is wrong (one line on standard error, nothing half-written); 3 the
result is not certified or misses its specification (the report is written all the same; of `certify`, which
is a check and leaves as pytest or diff, 1).
"""

from __future__ import annotations

import inspect
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from enum import StrEnum
from functools import cache
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from workflow.engine import interrupts
from workflow.engine.errors import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_INTERNAL,
    EXIT_INTERRUPTED,
    EXIT_NOT_CERTIFIED,
    EXIT_OK,
    CommandInterruptedError,
    InputError,
    StageError,
    cut_inside,
    describe_os_error,
    need,
    one_line,
)
from workflow.engine.threads import one_thread
from workflow.field_options import NONE, SETTINGS, completed, option_name, with_fields

if TYPE_CHECKING:
    from workflow.commands.logs import Reading
    from workflow.config.settings import ModelT
    from workflow.console import TerminalProgress
    from workflow.describe.summary import RunSummary

_READING = (
    *("input_name", "output_name", "reference", "time", "time_unit", "dt_s"),
    *("scale", "units", "unwrap", "decimal", "input_limit", "controller_period_s", "command_averaged"),
)
# Keys of [specification] that options change most often; all others stand in a configuration.
_OF_SPECIFICATION = (
    *("bandwidth_rad_s", "lowest_bandwidth_rad_s", "modulus_margin", "effort_limit", "mode_peak_ratio"),
    *("controller_order", "controller_dt_s", "delay_margin_s"),
)
_OF_LOOP = ("input_name", "output_name", "reference", "time", "time_unit", "decimal", "dt_s")
_SIMULATOR = ("mjcf", "fmu", "python", "motion", "log", "dt_s", "repair", "resample_s")
# Manifests of what can be continued.
_MANIFESTS = ("manifest.json", "study.json", "diagnose.json", "blind.json")


class _Commands(TyperGroup):
    """Options for fields of settings are made when their command is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, remaining = super().resolve_command(ctx, args)
        function = _commands().get(name or "")
        if hasattr(function, "of_fields"):
            command = _completed(function)
        return name, command, remaining


@cache
def _completed(command: Callable[..., Any]) -> Any:
    """A command with its options for fields of settings, as Typer makes it of an app of this one command."""
    app_of_one = typer.Typer(add_completion=False, rich_markup_mode=None)
    app_of_one.command()(completed(command))
    return typer.main.get_command(app_of_one)


app = typer.Typer(
    name="flexlink",
    cls=_Commands,
    help="From a flexible-link arm and its logs to a robust controller with a certificate.",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    # Markup would swallow every [unit], [section] and [default] in the help.
    rich_markup_mode=None,
    epilog="Exit codes: 0 done; 1 internal error; 2 something given is wrong (one line says what and where); "
    "3 the result is not certified, the report says why (of certify 1); 130, 143, 129 interrupted by Ctrl-C, "
    "SIGTERM, SIGHUP. Example: flexlink run --out "
    "runs/first",
)


Jobs = Annotated[
    int | None, typer.Option(min=1, help="Processes on this machine [default: one per processor]")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Compute on the workers of a Dask cluster, e.g. tcp://host:8786 (extra 'distributed')."
    ),
]
Earlier = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="RUN",
        help="Take over from this run every stage that was made from the same; without logs or --config also "
        "its configuration, with the options below changed. It stays as it is.",
    ),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Continue what is in --out; what is finished there is kept.")
]
Replace = Annotated[bool, typer.Option("--replace", help="Delete what an earlier call left at --out first.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print every row of the table.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress on standard error.")]


def _limit(seconds: float | None) -> float | None:
    interrupts.limit(seconds)
    return seconds


# A command has but to name it as a parameter.
TimeLimit = Annotated[
    float | None,
    typer.Option(
        min=1e-3,
        callback=_limit,
        metavar="SECONDS",
        help="End after so long as if interrupted, with exit code 142; what is done is kept for --resume, "
        "where the command has it.",
    ),
]
CPrefix = Annotated[
    str | None,
    typer.Option(
        "--c-prefix",
        help="What names in the C code begin with: PREFIX_step, PREFIX_state; controller if left out.",
    ),
]
CFloat = Annotated[
    bool | None,
    typer.Option(
        "--c-float/--c-double", help="Numbers of the C code; double if left out. Fixed point is not offered."
    ),
]


Logs = Annotated[
    list[Path], typer.Argument(help="CSV or other tables, npz, MAT, ... (docs/logs.md); used together.")
]
SomeLogs = Annotated[
    list[Path] | None, typer.Argument(help="Log files (docs/logs.md); of excite with --closed-loop.")
]
Config = Annotated[
    Path | None, typer.Option(help="TOML file (see examples/ and README); without it the built-in arm.")
]
NewDirectory = Annotated[Path, typer.Option(help="Directory for what is written; new or empty.")]
Source = Annotated[
    list[Path],
    typer.Argument(
        help="Run directory; npz of `flexlink identify --out`; JSON or MAT of its --export, or with A, B, C, "
        "D, dt_s of your own model; CSV with a measured frequency response. Several: one controller for all."
    ),
]
DesignFile = Annotated[
    Path | None,
    typer.Option(
        "--spec",
        "--specification",
        help="TOML with the keys of [specification], and [plant], [uncertainty], [synthesis], [certificate], "
        "[achievable_performance], [reference_filter] where needed; for a run directory its own if left out.",
    ),
]
Cases = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Case folder with case.toml, rig.toml and logs, or a TOML file like case.toml with a column map "
        "beside logs of your own, or one that names a simulator's model; several give an overview as well."
    ),
]
# A list, so that logs typed without --log are told so.
SimulatorCaseFile = Annotated[
    list[Path] | None,
    typer.Argument(help="TOML file that names a simulator's model and logs, in place of the options below."),
]
# Any number: it is fixed so that results repeat.
_SEED = 2006
Seed = Annotated[int, typer.Option(min=0, help="Root of the random starts.")]

PictureFile = StrEnum("PictureFile", {"PDF": "pdf", "PNG": "png"})
Json = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on standard output.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"flexlink {metadata.version('flexlink')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    pass


@app.command(short_help="Everything, from records to report.html.")
@with_fields(reading=_READING, specification=_OF_SPECIFICATION)
def run(
    log: SomeLogs = None,
    config: Config = None,
    out: Annotated[
        Path | None, typer.Option(help="Run directory, new or empty [default: runs/<name>-<date>-<time>]")
    ] = None,
    earlier: Earlier = None,
    resume: Resume = False,
    replace: Replace = False,
    c_prefix: CPrefix = None,
    c_float: CFloat = None,
    time_limit: TimeLimit = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Records -> model -> ellipses -> controller -> certificate -> closed loop -> report.html."""
    need(config, *(log or []))
    typed = _stated({name: of_fields.pop(name) for name in _OF_SPECIFICATION})
    of_logs = [option_name(name) for name in _stated(of_fields)]
    if of_logs and not log:
        raise InputError(
            f"{of_logs[0]} says how logs are read: name them, as in flexlink run LOG... {of_logs[0]}"
        )
    with _watched(quiet) as progress:
        # Progress says a word before it: it takes its time to load.
        from workflow.commands.run import run_from_files

        summary = run_from_files(
            config,
            out,
            log or (),
            _reading(of_fields),
            earlier_path=earlier,
            typed=_specified(typed),
            resume=resume,
            replace=replace,
            c_code=_c_code(c_prefix, c_float),
            progress=progress,
        )
    _show(summary, as_json, verbose=verbose)
    _leave(summary)


@app.command(short_help="Simulate experiments and write them as CSV.")
def simulate(
    out: NewDirectory,
    config: Config = None,
    time_limit: TimeLimit = None,
    as_json: Json = False,
) -> None:
    """Simulate the experiments of a configuration and write them as CSV."""
    need(config)
    from workflow.commands.run import simulate_to_csv

    _show_files(simulate_to_csv(config, out), as_json)


@app.command(short_help="Plan an experiment: voltages as CSV, plan, page.")
@with_fields(
    limits=(
        "band_Hz",
        "duration_s",
        "dt_s",
        "peak_V",
        "motion",
        "rms_V",
        "angle_deg",
        "rig",
        "gain_rad_per_Vs",
        "noise_std_rad",
        "lead_in_s",
    ),
    reading=("input_name", "output_name", "reference", "time", "time_unit", "decimal"),
    plan=("realisations", "periods"),
)
def excite(
    out: NewDirectory,
    log: SomeLogs = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Plan a reference for the loop that made the logs.")
    ] = False,
    seed: Seed = _SEED,
    time_limit: TimeLimit = None,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Plan random-phase multisines that tell response, noise and nonlinear distortion apart."""
    stated = _stated(of_fields)
    counts: dict[str, Any] = {
        name: stated.pop(name) for name in ("realisations", "periods") if name in stated
    }
    if closed_loop != bool(log):
        raise InputError("--closed-loop goes with logs of the loop: flexlink excite --closed-loop LOG... ...")
    if log:
        need(*log)
        from workflow.excite import write_reference

        of_reference = ("band_Hz", "duration_s", "lead_in_s")
        counts |= {name: stated[name] for name in of_reference if name in stated}
        summary = write_reference(
            log,
            out,
            _reading({name: of_fields[name] for name in _OF_LOOP}),
            largest_command=stated.get("peak_V"),
            largest_motion=stated.get("motion"),
            rms=next(iter(stated.get("rms_V", ())), None),
            seed=seed,
            **counts,
        )
        _show(summary, as_json)
        return
    if not {"dt_s", "peak_V", "band_Hz", "duration_s"} <= stated.keys():
        raise InputError(
            "an experiment in open loop needs --dt-s SECONDS, --voltage LARGEST, --band LOW HIGH "
            "and --duration SECONDS"
        )
    if "motion" in stated:
        raise InputError("--motion goes with --closed-loop; in open loop --angle bounds the motion")
    from workflow.excite import ExperimentLimits, write_experiment

    _show_files(write_experiment(_settings(ExperimentLimits, stated), out, seed=seed, **counts), as_json)


@app.command(short_help="What a log holds: columns, units, sampling, ranges.")
@with_fields(reading=("time", "time_unit", "decimal"))
def look(
    log: Annotated[Path, typer.Argument(help="CSV or other tables, npz, MAT, ... (docs/logs.md).")],
    out: Annotated[Path | None, typer.Option(help="Write a page here (HTML, one file).")] = None,
    time_limit: TimeLimit = None,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Columns, units, sampling (period, jitter, missing rows), ranges, clipping and quantisation of a log."""
    need(log)
    from workflow.look import look as look_at_log

    _show(look_at_log(log, out=out, **of_fields), as_json)


@app.command(short_help="Write a configuration that runs, from logs.")
@with_fields(reading=_READING)
def init(
    log: Logs,
    out: Annotated[Path, typer.Option(help="Write the configuration here (TOML), for `flexlink run`.")],
    replace: Replace = False,
    time_limit: TimeLimit = None,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Identify logs and write a configuration that runs: columns, roles, structure and a specification."""
    need(*log)
    from workflow.commands.init import init as write_configuration

    with _watched(quiet=False) as progress:
        summary = write_configuration(log, out, _reading(of_fields), replace_file=replace, progress=progress)
    _show(summary, as_json)


@app.command(short_help="Identify one channel from log files; one-page report.")
@with_fields(
    reading=(*_READING, "offset", "repair", "resample_s"),
    loop=("closed_loop_data.method",),
    fit=(
        "n_pairs",
        "n_real",
        "integrators",
        "input_delay_samples",
        "feedthrough",
        "relative_degree",
        "noise",
        "omega_min_rad_s",
        "omega_max_rad_s",
        "zeta_min",
        "zeta_max",
    ),
    channel=("band_rad_s",),
    ellipses=("level", "response", "max_ar_order"),
    files=("validation", "report", "export"),
)
def identify(
    log: Logs,
    out: Annotated[
        Path | None, typer.Option(help="Write model and posterior here (npz), for `flexlink design`.")
    ] = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Identify one channel from log files: poles, modes, ellipses, fit, residual tests, one-page report."""
    degree = of_fields["relative_degree"]
    report_page, validation, export = (of_fields.pop(name) for name in ("report", "validation", "export"))
    # As a number, so that the settings' own complaint names what is allowed.
    if degree and degree.isdigit():
        of_fields["relative_degree"] = int(degree)
    need(*log, *(validation or []))
    from ident.data.frf_records import is_response
    from workflow.commands.logs import read_logs
    from workflow.config.run_config import ClosedLoopData
    from workflow.config.uncertainty_options import FitOptions, UncertaintyOptions
    from workflow.engine.storage import refuse_in_the_way

    options = _settings(FitOptions, of_fields)
    with _watched(quiet) as progress:
        described = _settings(UncertaintyOptions, of_fields)
        loop = _settings(ClosedLoopData, {"method": of_fields["closed_loop_data_method"]})
        # A log given twice would count its noise twice as well known, or validate what it was fitted to.
        refuse_in_the_way(
            [*log, *(validation or [])],
            [
                (name, path)
                for name, path in (("--out", out), ("--report", report_page), ("--export", export))
                if path
            ],
        )
        if not any(of_fields[name] for name in ("input_name", "output_name", "time")) and is_response(*log):
            from workflow.responses import identify_response

            of_logs = {
                **{option_name(key): of_fields[key.replace(".", "_")] for key in _OF_LOGS},
                "--report": report_page,
                "--validation": validation,
            }
            summary = identify_response(
                log,
                of_fields["dt_s"],
                level=described.level,
                options=options,
                out=out,
                export=export,
                refused=[name for name, value in of_logs.items() if value],
                progress=progress,
            )
            _identified(summary, as_json, export, out)
            return
        logs = read_logs(log, _reading(of_fields), validation or [])
        # A log that is refused does not wait for what identifies: that takes seconds to load.
        from workflow.commands.identify import identify_logs

        summary = identify_logs(
            logs,
            options=options,
            described=described,
            band_rad_s=of_fields["band_rad_s"],
            loop=loop,
            out=out,
            report=report_page,
            export=export,
            progress=progress,
        )
    _identified(summary, as_json, export, out)


# Options of `identify` that a measured response has no use for.
_OF_LOGS = (
    "reference",
    "band_rad_s",
    "input_limit",
    "max_ar_order",
    "time_unit",
    "scale",
    "offset",
    "units",
    "repair",
    "controller_period_s",
    "command_averaged",
    "closed_loop_data.method",
)


def _identified(summary: RunSummary, as_json: bool, export: Path | None, out: Path | None) -> None:
    if as_json:
        document = summary.to_document()
        print_json({key: document[key] for key in ("title", "verdict", "report", "numbers", "table")})
    else:
        _show(summary, as_json)
        for name, path in (("model", export), ("model for flexlink design", out)):
            if path is not None:
                typer.echo(f"{name}: {path}")


@app.command()
def design(
    source: Source,
    specification: DesignFile = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the controller here, by the ending: .json or .mat (discrete state space), .c (C99, "
            "with its header); or into a directory, as controller.json, .mat, .c and .h; "
            "a reference filter beside it, as NAME_reference_filter."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Write the page of the design here (HTML, one file), for the plant of one run directory; in "
            "a directory of --out it is there as report.html."
        ),
    ] = None,
    seed: Seed = _SEED,
    c_prefix: CPrefix = None,
    c_float: CFloat = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Design and certify one controller for one or several plants, identified here or brought along."""
    need(*source, specification)
    with _watched(quiet) as progress:
        from control_design.controllers.c_code import Dialect
        from workflow.config.design_file import read_design_file

        dialect = Dialect(**_c_code(c_prefix, c_float))
        # A design file that is refused does not wait for what designs: that takes seconds to load.
        file = None if specification is None else read_design_file(specification)
        from workflow.commands.design import design_controller

        summary = design_controller(
            source, file, out=out, page=report, seed=seed, dialect=dialect, progress=progress
        )
    _show(summary, as_json)
    _leave(summary)


@app.command(short_help="Certify an existing controller; hold its margins against a baseline.")
@with_fields(files=("controller", "baseline", "write_baseline"))
def certify(
    source: Source,
    specification: DesignFile = None,
    time_limit: TimeLimit = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Certify a controller for one or several plants. Exit codes: 0 certified, and no worse than --baseline;
    1 not; 2 something given is wrong."""
    need(*source, specification)
    with _watched(quiet) as progress:
        from workflow.config.command_files import CommandFiles
        from workflow.config.design_file import read_design_file

        file = None if specification is None else read_design_file(specification)
        from workflow.commands.certify import certify_controller

        summary = certify_controller(source, file, _settings(CommandFiles, of_fields), progress=progress)
    _show(summary, as_json, verbose=verbose)
    _leave(summary, EXIT_CHECK_FAILED)


@app.command(short_help="A page with sliders: designs as you move them.")
def tune(
    source: Source = None,  # type: ignore[assignment]
    specification: DesignFile = None,
    demo: Annotated[bool, typer.Option("--demo", help="Tune the built-in arm, identified first.")] = False,
    out: Annotated[Path, typer.Option(help="Saved designs go below this directory.")] = Path("runs/tuned"),
    seed: Seed = _SEED,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Tune a specification by hand on a page of this machine; Ctrl-C ends it."""
    if demo == bool(source):
        raise InputError("flexlink tune needs either a source (run directory or plant file) or --demo")
    need(*(source or ()), specification)
    with ExitStack() as held:
        with _watched(quiet) as progress:
            from workflow.config.design_file import read_design_file

            file = None if specification is None else read_design_file(specification)
            from workflow.tune import serve, tuning

            made = tuning(source or [], file, out=out, seed=seed, port=port, progress=progress)
            server = held.enter_context(made)
        serve(server, typer.echo, browser=browser)


@app.command(short_help="Write report.html of a run again.")
def report(
    directory: Annotated[Path, typer.Argument(help="Run directory.")],
    pictures: Annotated[
        list[PictureFile] | None,
        typer.Option(help="Further kind of file for every picture in figures/, beside SVG; may be repeated."),
    ] = None,
    time_limit: TimeLimit = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write report.html of a run directory again and print its table."""
    with _watched(quiet) as progress:
        from workflow.commands.run import rebuild_report
        from workflow.engine.run_directory import RunDirectory

        summary = rebuild_report(RunDirectory.open(directory), pictures or (), progress)
    _show(summary, as_json, verbose=verbose)


@app.command(short_help="Many designs for one plant: table, Pareto plot.")
def study(
    config: Annotated[Path, typer.Option(help="TOML file of the study (see examples/study.toml).")],
    out: NewDirectory,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    replace: Replace = False,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Controller tuning study: specification, ellipses, synthesis or payload varied over one plant, of one
    loop or of several joints."""
    need(config)
    _one_of(jobs, scheduler)
    with _watched(quiet) as progress:
        from workflow.study.settings import load_study

        # One that is refused does not wait for what computes: seconds.
        file = load_study(config)
        from workflow.study.work import run_study

        summary = run_study(
            file, out, jobs=jobs, scheduler=scheduler, resume=resume, replace=replace, progress=progress
        )
    _show(summary, as_json)
    _leave(summary)


@app.command(short_help="What logs can tell of a simulator's model, in seconds.")
@with_fields(simulator=_SIMULATOR)
def check(
    case: SimulatorCaseFile = None,
    time_limit: TimeLimit = None,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """What logs of a MuJoCo, FMU or Python model tell: their quality, smallest sizes that show, candidates
    that act alike, what a next record needs."""
    stated = _of_simulator("check", case or [], of_fields)
    need(*case or [])
    if case and len(case) > 1:
        raise InputError("check: expected one case file")
    from workflow.diagnose.check import check as look_at_case
    from workflow.diagnose.simulator_settings import settings_of

    _show(look_at_case(case[0] if case else settings_of(stated, "--log")), as_json)


@app.command(short_help="Cause and size of a model error; how much of it is explained.")
@with_fields(simulator=_SIMULATOR)
def diagnose(
    out: NewDirectory,
    case: Cases = None,
    rig: Annotated[
        str | None,
        typer.Option(
            help="Rig file in the case folder, e.g. rig_uncertain.toml [default: what the case file names, "
            "or rig.toml]"
        ),
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    replace: Replace = False,
    controller: Annotated[
        bool, typer.Option(help="Compare controllers designed on the nominal rig and on the repaired one.")
    ] = True,
    time_limit: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            help="Seconds of search after which a case tries nothing more; its page says what was left out. "
            "Not counted: starting, reading the logs, drawing the page. [default: none]",
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    **of_fields: Any,
) -> None:
    """Records and rig -> is there a gap, where, which effect, how far it shrinks, what to do next."""
    case = case or []
    stated = _of_simulator("diagnose", case, of_fields)
    _one_of(jobs, scheduler)
    if case and not any(place.exists() for place in case):
        need(*case)
    from workflow.diagnose.case_settings import case_document

    if len(case) == 1 and not {"mjcf", "fmu", "python"} & set(case_document(case[0])[1]):
        from workflow.diagnose.case_files import load_case

        # What is refused does not wait for what diagnoses to be loaded: seconds.
        load_case(case[0], rig)
    with _watched(quiet) as progress:
        from workflow.diagnose.command import diagnose_cases
        from workflow.diagnose.simulator_settings import settings_of

        diagnosed = diagnose_cases(
            case or [settings_of(stated, "--log")],
            out,
            rig=rig,
            jobs=jobs,
            scheduler=scheduler,
            resume=resume,
            replace=replace,
            controller=controller,
            time_limit_s=time_limit,
            progress=progress,
        )
    if as_json:
        for part in diagnosed.json_parts(ascii_only=_ascii_only()):
            sys.stdout.write(part)
    else:
        _show(diagnosed.summary, as_json)
    for line in diagnosed.complaints():
        _complain(line, diagnosed.exit_code)
    if diagnosed.exit_code != EXIT_OK:
        raise typer.Exit(diagnosed.exit_code)


def _of_simulator(command: str, cases: Sequence[Path], of_fields: Mapping[str, Any]) -> dict[str, Any]:
    """A simulator's case as the options state it; empty beside case files. Raises InputError."""
    stated = {name: value for name, value in of_fields.items() if value}
    model: dict[str, Any] = {name: stated.pop(name) for name in ("mjcf", "fmu", "python") if name in stated}
    log = stated.pop("log", None)
    of_logs = stated
    if cases and model and log:
        raise InputError(f"{command}: {cases[0]}: write --log before each log, as --log A.csv --log B.csv")
    if model and not log:
        raise InputError(f"{command}: --{next(iter(model))} needs the logs: --log FILE, once for each")
    if bool(cases) == bool(model) or bool(model) != bool(log):
        raise InputError(f"{command}: expected a case file, or --mjcf, --fmu or --python with --log")
    if of_logs and not model:
        option = f"--{next(iter(of_logs)).replace('_', '-')}"
        raise InputError(f"{command}: {option} is of --mjcf, --fmu or --python; a case file says it itself")
    if "mjcf" in model and "motion" in of_logs:
        raise InputError(f"{command}: --motion is of --fmu or --python")
    need(*map(Path, (*model.values(), *(log or []))))
    return {**model, "log": log, **of_logs} if model else {}


def _one_of(jobs: int | None, scheduler: str | None) -> None:
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler contradict each other: the cluster's workers set the number")


def _watched(quiet: bool) -> TerminalProgress:
    # Rich takes a moment to load.
    from workflow.console import TerminalProgress

    return TerminalProgress(quiet=quiet)


def _c_code(prefix: str | None, single: bool | None) -> dict[str, Any]:
    """The fields of a `Dialect` that are stated."""
    from control_design.controllers.c_code import Dialect
    from workflow.engine.errors import naming

    number = None
    if single is not None:
        number = "float" if single else "double"
    fields = _stated({"prefix": prefix, "number": number})
    # It refuses what is no name in C, before anything is computed.
    with naming("--c-prefix"):
        Dialect(**fields)
    return fields


def _stated(given: Mapping[str, Any]) -> dict[str, Any]:
    """What is there of some options; a switch that is off was not given."""
    return {name: value for name, value in given.items() if value is not None and value is not False}


def _reading(given: Mapping[str, Any]) -> Reading:
    """How the options of a command say that logs are read."""
    from workflow.commands.logs import Reading

    stated = dict(given)
    for name in ("scale", "offset", "unwrap", "units"):
        option = option_name(name)
        pairs = _named(option, given.get(name))
        stated[name] = pairs if name == "units" else {key: _number(option, pairs[key]) for key in pairs}
    return _settings(Reading, stated)


def _specified(typed: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of [specification] as options state them, each within its range; None of what is not to be asked.
    Raises InputError naming the option."""
    # The settings are slow to load.
    if not typed:
        return {}
    from pydantic import create_model

    from control_design.specification import Specification
    from workflow.config.settings import Section

    keys = {name: None if value == NONE else value for name, value in typed.items()}
    order = keys.get("controller_order")
    # A number, or "auto".
    if isinstance(order, str) and order.isdigit():
        keys["controller_order"] = int(order)
    elif order not in (None, "auto"):
        raise InputError(
            f"{option_name('controller_order')}: expected a number of states or auto, got {order}"
        )
    # Each by itself: what contradicts the keys beside it is found where all of them are known.
    fields: dict[str, Any] = {
        name: (Specification.model_fields[name].annotation, Specification.model_fields[name]) for name in keys
    }
    _settings(create_model("TypedSpecification", __base__=Section, **fields), keys)
    return keys


def _named(option: str, stated: Sequence[str] | None) -> dict[str, str]:
    """NAME=VALUE, as often as the option is there; a name may have = in it."""
    pairs = [text.rpartition("=") for text in stated or ()]
    for name, _, value in pairs:
        if not name or not value:
            raise InputError(f"{option} {name}{value}: expected COLUMN=VALUE")
    return {name: value for name, _, value in pairs}


def _number(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} {text}: expected a number") from None


def _settings(model: type[ModelT], given: Mapping[str, Any]) -> ModelT:
    """The settings that options state; a complaint has the option's name."""
    from workflow.config.settings import check

    try:
        stated = {key: given[key] for key in model.model_fields if given.get(key) is not None}
        return check(model, stated, source="options")
    except InputError as error:
        raise InputError(
            re.sub(r"^options: (\w+)(?=:)", lambda found: option_name(found[1]), str(error))
        ) from error


def print_json(document: Mapping[str, Any]) -> None:
    """A document, and nothing else, on standard output; in ASCII where that is not UTF-8."""
    from workflow.engine.codec import plain_text

    sys.stdout.write(plain_text(document, ascii_only=_ascii_only()))


def _ascii_only() -> bool:
    return "utf" not in (getattr(sys.stdout, "encoding", None) or "utf-8").lower()


def _show_files(files: Sequence[Path], as_json: bool) -> None:
    if as_json:
        print_json({"files": [str(path) for path in files]})
    else:
        typer.echo("\n".join(map(str, files)))


def _show(summary: RunSummary, as_json: bool, *, verbose: bool = False) -> None:
    from workflow.console import print_summary

    if as_json:
        print_json(summary.to_document())
    else:
        print_summary(summary, verbose=verbose)


def _leave(summary: RunSummary, code: int = EXIT_NOT_CERTIFIED) -> None:
    if summary.certified is False:
        raise typer.Exit(_complain(summary.verdict, code))


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; every error is one line on standard error."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    if debug:
        arguments.remove("--debug")
    elif argv is None:
        # An error is one line. Called from Python (tests!) warnings stay what the caller made of them.
        warnings.simplefilter("ignore")
    if argv is None:
        # Libraries read it when they load, which is after this line.
        one_thread()
    if not arguments:
        arguments = ["--help"]
    try:
        if argv is None:
            interrupts.watch()
        interrupts.check()
        _plug_in(arguments)
        code = int(app(arguments, standalone_mode=False) or EXIT_OK)
        sys.stdout.flush()
        # typer turns Ctrl-C into a silent exit of this code.
        return _interrupted(arguments) if code == EXIT_INTERRUPTED else code
    except KeyboardInterrupt:
        return _interrupted(arguments)
    except CommandInterruptedError as error:
        return _interrupted(arguments, error.out)
    except Exception as error:
        # A library has made an error of its own of the interrupt.
        if interrupts.came():
            return _interrupted(arguments)
        if isinstance(error, OSError) and error.filename is None:
            # Standard output goes nowhere, at the last flush neither.
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if debug:
            traceback.print_exc()
        message, code = _explain(error)
        return _complain(cut_inside(one_line(message)), code)
    finally:
        interrupts.no_limit()


def _commands() -> dict[str, Callable[..., Any]]:
    """Every registered command by its name."""
    return {
        info.name or info.callback.__name__: info.callback
        for info in app.registered_commands
        if info.callback is not None
    }


def _plug_in(arguments: Sequence[str]) -> None:
    """Register the commands that other packages bring: entry points of the group `flexlink.commands`, each a
    function with Typer's annotations. Looked for only where none of our own commands is called."""
    known = _commands()
    if next((name for name in arguments if not name.startswith("-")), None) in known:
        return
    for point in metadata.entry_points(group="flexlink.commands"):
        if point.name not in known:
            app.command(point.name)(point.load())


def _interrupted(arguments: Sequence[str], out: Path | None = None) -> int:
    """One line; with the call that continues, where something was written that can be continued."""
    called = _commands().get(arguments[0])
    hint = ""
    if called is not None and "resume" in inspect.signature(called).parameters:
        again = [text for text in arguments if text not in ("--replace", "--resume")]
        at_out = next((at for at, text in enumerate(again) if text.partition("=")[0] == "--out"), None)
        if at_out is not None:
            out = Path(again[at_out].partition("=")[2] or again[at_out + 1])
        elif out is not None:
            again += ["--out", str(out)]
        if out is not None and any((out / name).is_file() for name in _MANIFESTS):
            hint = f"; {shlex.join(['flexlink', *again, '--resume'])} continues"
    return _complain(f"{interrupts.words()}{hint}", interrupts.exit_code())


def _help(error: Exception) -> str:
    """What to type for the help of the command that complains."""
    context = getattr(error, "ctx", None)
    return f"flexlink {context.info_name} -h" if context and context.parent else "flexlink --help"


def _explain(error: Exception) -> tuple[str, int]:
    if isinstance(error, (InputError, StageError)):
        return str(error), error.exit_code
    called = getattr(getattr(error, "ctx", None), "info_name", "")
    key = getattr(error, "option_name", "").removeprefix("--").replace("-", "_")
    if called in ("check", "diagnose") and key in resolve_name(SETTINGS["simulator"]).model_fields:
        return (
            f"{called}: {key} has no option: write {key} = ... in a case file (.toml) with model "
            f"and log = [...], and call {called} on that (docs/simulators.md)"
        ), EXIT_BAD_INPUT
    # Typer's own: unknown option, missing argument ...
    if hasattr(error, "format_message"):
        return f"{error.format_message() or 'no command given'} ({_help(error)})", EXIT_BAD_INPUT
    # A file that none of ours asks about, a pipe or a terminal.
    if isinstance(error, OSError):
        what = "cannot use " if error.filename else "cannot write the output: "
        return what + describe_os_error(error), EXIT_BAD_INPUT
    if isinstance(error, MemoryError):
        return f"out of memory ({error}); shorter records, delays and searches need less", EXIT_INTERNAL
    # Typer makes an Abort of an EOFError.
    cause = error.__cause__ if isinstance(error, typer.Abort) else error
    return f"internal error: {type(cause).__name__}: {cause} (--debug shows where)", EXIT_INTERNAL


def _complain(message: str, code: int) -> int:
    # The exit code says it all the same.
    with suppress(OSError):
        print(f"flexlink: {one_line(message)}", file=sys.stderr)  # noqa: T201
    return code
