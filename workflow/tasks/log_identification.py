"""What `flexlink identify` does: log files in; model, ellipses, tests, a page and model files out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ident.basis.model_files import ModelFile
from ident.basis.options import IdentOptions
from ident.checks.residual_tests import residual_advice
from ident.checks.validation import FreshFit, ResidualTest, fit_on_fresh_data, whiteness_test
from ident.closed_loop import TwoStage, two_stage
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.data.signal_filter import band_limited, settling_time_s
from ident.identify import Identification, identify
from ident.stabilisation import Stabilisation, stabilisation
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.uncertainty.embedding import EmbeddingOptions, tangent
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress, Silence
from workflow.report.environment import rows_of
from workflow.report.formats import count
from workflow.tasks.results import IdentifiedChannel, IdentifiedPlant, UncertainChannel
from workflow.tasks.stages.identify import settled
from workflow.tasks.stages.records import read_log, refuse_constant_input, with_common_sampling_time
from workflow.tasks.stages.uncertainty import (
    N_BANDS,
    display_grid,
    residual_tests,
    uncertain_channel,
)
from workflow.tasks.summary import RunSummary, model_numbers, sections_of, uncertainty_numbers

# Largest orders of the noise model that are tried, until the residuals behind it are white.
_NOISE_ORDERS = (8, 32)

# A first stage that explains less of the input than this has gone wrong.
_EXPLAINED_PERCENT = 50.0

MODEL_SUFFIXES = (".json", ".mat")


@dataclass(frozen=True, eq=False)
class LogIdentification:
    """Everything that was found in a set of logs.

    `measured` are the records as read, `used` the same as the fit saw them (inside the band; with the input
    that the reference explains, where the logs come from a closed loop). `about` and `spread` are results as
    of a run's stages; `careful` says what to look at, one sentence each. The stabilisation plot is None where
    nobody asked for it.
    """

    measured: tuple[Record, ...]
    fresh_records: tuple[Record, ...]
    options: IdentOptions
    about: IdentifiedChannel
    spread: UncertainChannel
    careful: tuple[str, ...]

    @property
    def found(self) -> Identification:
        return self.about.identification

    @property
    def used(self) -> tuple[Record, ...]:
        return self.about.used

    @property
    def fresh(self) -> tuple[FreshFit, ...]:
        return self.about.fresh

    @property
    def plot(self) -> Stabilisation | None:
        return self.about.stabilisation

    @property
    def frequency(self) -> FrequencyUncertainty:
        return self.spread.frequency

    @property
    def empirical(self) -> FrequencyUncertainty | None:
        return self.spread.empirical


def identify_logs(
    logs: Sequence[Path],
    input_name: str,
    output_name: str,
    *,
    time: str | None = None,
    dt_s: float | None = None,
    reference: str | None = None,
    validation: Sequence[Path] = (),
    options: IdentOptions | None = None,
    level: float = 0.95,
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
    logs made in closed loop, for the two-stage method. band_rad_s: fit inside this band only, friction and
    drift below it and noise above it left out. noise_order: largest order of the noise model behind the
    ellipses; none given: 8, or 32 where that leaves coloured residuals. Raises InputError: one line naming
    file, column or line.
    """
    if not 0.5 < level < 1:
        raise InputError(f"--level must lie between 0.5 and 1, got {level}")
    if export is not None and export.suffix.lower() not in MODEL_SUFFIXES:
        raise InputError(f"--export {export}: the ending must be {' or '.join(MODEL_SUFFIXES)}")
    _refuse_files_in_the_way([*logs, *validation], {"--out": out, "--report": report, "--export": export})
    progress = progress or Silence()
    progress.plan((("identify", 2.0), ("uncertainty", 1.0), *((("report", 4.0),) if report else ())))
    references = [] if reference is None else [reference]

    def read(path: Path) -> Record:
        return read_log(path, [input_name], [output_name], time=time, dt_s=dt_s, references=references)

    measured = [read(Path(path)) for path in logs]
    fresh_logs = [read(Path(path)) for path in validation]
    for record in measured:
        refuse_constant_input(record)
    common = with_common_sampling_time([*measured, *fresh_logs])
    result = identify_records(
        common[: len(measured)],
        common[len(measured) :],
        options,
        level=level,
        band_rad_s=band_rad_s,
        noise_order=noise_order,
        with_plot=report is not None,
        progress=progress,
    )
    if report is not None:
        from workflow.report.identify_page import identify_page  # matplotlib takes its second only here

        progress.start("report")
        inputs = {str(path): storage.sha256_of_file(Path(path)) for path in (*logs, *validation)}
        content = identify_page(result, inputs, lambda f, m: progress.update("report", f, m))
        storage.write_text(report, content)
        progress.finish("report", 0.0, taken_up=False)
    if out is not None:
        plant = IdentifiedPlant(result.spread.nominal, result.spread.posterior, level)
        storage.write_npz(out, codec.to_arrays(plant))
    if export is not None:
        write_model(export, ModelFile(result.about.model, result.spread.frequency))
    return _summary(result, out, report, export)


def identify_records(
    measured: Sequence[Record],
    fresh_records: Sequence[Record] = (),
    options: IdentOptions | None = None,
    *,
    level: float = 0.95,
    band_rad_s: tuple[float, float] | None = None,
    noise_order: int | None = None,
    with_plot: bool = True,
    progress: Progress | None = None,
) -> LogIdentification:
    """The same on records that are there already, nothing written.

    The noise is modelled where the residuals are not white. Records with a reference are taken as made in
    closed loop. Raises InputError.
    """
    options, progress = options or IdentOptions(), progress or Silence()
    progress.start("identify")
    with naming("identify"):
        used, opened = list(measured), None
        if band_rad_s is not None:
            # A pair far outside the band could only describe the filter's skirts.
            options = options.model_copy(
                update={
                    "omega_min_rad_s": options.omega_min_rad_s or band_rad_s[0] / 2,
                    "omega_max_rad_s": options.omega_max_rad_s
                    or min(2 * band_rad_s[1], 0.9 * np.pi / measured[0].dt_s),
                }
            )

            def inside(record: Record) -> Record:
                filtered = band_limited(record, *band_rad_s)
                settled_s = settling_time_s(record.dt_s, *band_rad_s)
                # Of a short record half is kept, whatever the filter's start leaves in it.
                start = min(round(settled_s / record.dt_s), record.n_samples // 2)
                return filtered.slice(start, record.n_samples)

            used = [inside(record) for record in measured]
            fresh_records = [inside(record) for record in fresh_records]
        if any(record.reference is not None for record in measured):
            # The first stage runs its model from rest, so it has to be fitted as from rest: free responses
            # that it estimated would be missing in the input it makes.
            opened = two_stage(
                used,
                options.model_copy(update={"estimate_initial_state": False, "noise": "white"}),
                EmbeddingOptions(estimate_initial_state=False),
            )
            used = list(opened.records)
        share = 0.6 if with_plot else 1.0
        found = settled(
            identify(used, options, progress=lambda f, m: progress.update("identify", share * f, m))
        )
        plot = None
        if with_plot:
            plot = stabilisation(
                used,
                found,
                options,
                progress=lambda f, m: progress.update("identify", share + (1 - share) * f, m),
            )
        about = IdentifiedChannel(
            name=found.model.output_name,
            input=found.model.input_name,
            output=found.model.output_name,
            identification=found,
            used=tuple(used),
            bounded=tuple(used),
            fresh=tuple(fit_on_fresh_data(found.model, record) for record in fresh_records),
            fresh_roles=tuple("validation" for _ in fresh_records),
            stabilisation=plot,
            band_rad_s=band_rad_s,
            two_stage=None if opened is None else opened.verdict,
        )
        progress.finish("identify", 0.0, taken_up=False)
        progress.start("uncertainty")
        posterior, tests = _posterior(used, found, noise_order)
        omega = display_grid(found.model, used)
        if band_rad_s is not None:
            omega = omega[(omega >= band_rad_s[0]) & (omega <= band_rad_s[1])]
            if omega.size < N_BANDS:
                raise ValueError(
                    f"the band {band_rad_s[0]:g} to {band_rad_s[1]:g} rad/s is too narrow to show"
                )
        spread = uncertain_channel(
            about.name,
            "tangent",
            level,
            posterior,
            about,
            omega,
            omega,
            empirical_band_rad_s=band_rad_s,
            tests=tests,
        )
    progress.finish("uncertainty", 0.0, taken_up=False)
    return LogIdentification(
        measured=tuple(measured),
        fresh_records=tuple(fresh_records),
        options=options,
        about=about,
        spread=spread,
        careful=(*_careful(found, spread), *_first_stage_error(opened, omega)),
    )


def _posterior(
    used: Sequence[Record], found: Identification, noise_order: int | None
) -> tuple[ResponsePosterior, tuple[ResidualTest, ...]]:
    """Tangent posterior and its residual tests, with as much of a noise model as the residuals ask for.

    White-noise bounds around coloured residuals are far too narrow, so the data decide.
    """
    if whiteness_test(found.residuals).passed:
        posterior = tangent(used, found.model)
        return posterior, residual_tests(posterior, used)
    best: tuple[float, ResponsePosterior, tuple[ResidualTest, ...]] | None = None
    for order in _NOISE_ORDERS if noise_order is None else (noise_order,):
        posterior = tangent(used, found.model, EmbeddingOptions(coloured_noise=True, max_ar_order=order))
        tests = residual_tests(posterior, used)
        whiteness = next(test for test in tests if test.name == "whiteness")
        # A longer noise model has to make the residuals whiter: inside a band it can also turn upon itself.
        if best is None or whiteness.probability > best[0]:
            best = (whiteness.probability, posterior, tests)
        if whiteness.passed:
            break
    assert best is not None
    return best[1], best[2]


def _careful(found: Identification, spread: UncertainChannel) -> list[str]:
    """Warnings of the fit, and what to do about residual tests that fail."""
    advice = residual_advice(
        spread.test("whiteness"), spread.test("independence"), noise_order=spread.noise_order
    )
    return [*found.warnings, *advice]


def _first_stage_error(opened: TwoStage | None, omega_rad_s: RealArray) -> list[str]:
    """What the ellipses of a second stage do not hold."""
    if opened is None:
        return []
    error = 100 * float(np.median(opened.relative_error(omega_rad_s)))
    explained = min(opened.fit_percent)
    lost = [
        f"the reference explains only {explained:.3g} % of the input: what is made of it is not to be relied "
        "on; check the reference column, start the records at rest, or fit within a band"
    ]
    return [
        *(lost if explained < _EXPLAINED_PERCENT else []),
        "the logs come from a closed loop: the error of the first stage (reference to input, a standard "
        f"deviation of {error:.2g} % of the response in the median) is in no ellipse; with four records or "
        "more, uncertainty.method = 'records' of flexlink run takes it from their scatter",
    ]


def _summary(
    result: LogIdentification, out: Path | None, report: Path | None, export: Path | None
) -> RunSummary:
    about, spread = result.about, result.spread
    return RunSummary(
        title=f"{about.input} to {about.output}",
        sections=sections_of(rows_of("summary/identification.j2", result=result)),
        numbers={
            **model_numbers(about),
            "warnings": list(result.careful),
            "uncertainty": uncertainty_numbers(spread),
            "file": None if out is None else str(out),
            "model_file": None if export is None else str(export),
        },
        verdict=count(len(result.careful), "warning"),
        report_path=None if report is None else str(report),
    )


def _refuse_files_in_the_way(logs: Sequence[Path], written: Mapping[str, Path | None]) -> None:
    """Refuse before the work is done.

    A log given twice would count its noise twice as well known, or validate what it was fitted to; an output
    file must not be a log, another output, or out of reach.
    """
    seen: dict[Path, str] = {}
    for path in logs:
        place = Path(path).resolve()
        if place in seen:
            raise InputError(f"{path}: given twice; expected different experiments")
        seen[place] = "a log"
    for option, target in written.items():
        if target is None:
            continue
        if target.resolve() in seen:
            raise InputError(f"{option} {target}: that is {seen[target.resolve()]} already")
        seen[target.resolve()] = option
        storage.check_writable(target)


def write_model(path: Path, file: ModelFile) -> None:
    """JSON or MAT by the ending (`MODEL_SUFFIXES`), atomically."""
    content = file.to_mat() if path.suffix.lower() == ".mat" else file.to_json().encode("utf-8")
    storage.write_bytes(path, content)


def read_model(path: Path) -> ModelFile:
    """The model in a file of `write_model`. Raises InputError: one line that names the file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    with naming(str(path)):
        if path.suffix.lower() == ".mat":
            return ModelFile.from_mat(content, str(path))
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: not a UTF-8 text file (byte {error.start})") from error
        return ModelFile.from_json(text, str(path))
