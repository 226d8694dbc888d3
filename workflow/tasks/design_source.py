"""Plants for `flexlink design`, from whatever file describes them, with what the design file says of them.

A source is one of: a run directory; .npz written by `flexlink identify --out` (model and posterior); .json or
.mat written by `flexlink identify --export` (model and ellipses); .json, .mat or .npz with plain A, B, C, D
and dt_s of a user's own discrete model; a table with a measured frequency response: with variances, as
repeated points, or as one sweep with a stated uncertainty.
Several sources are several plants that one controller has to serve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from control_design.analysis.joint_coverage import ResponseDraws, at_level
from control_design.plants.plant_set import UncertainPlant, count_integrators, frequency_response
from control_design.plants.stated_uncertainty import StatedDiscs
from ident.basis.model_format import FORMAT
from ident.data.ellipses import chi2_radius
from ident.data.finding import FindingKind
from ident.data.frf_records import is_response, measured_response
from ident.data.record_files import READERS
from ident.frequency_fit import identify_frf
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.uncertainty.nominal import NominalAgreement
from workflow.config.design_file import DesignFile
from workflow.config.run_config import RunConfig
from workflow.engine import codec
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.exports import Logged, read_model
from workflow.tasks.pipeline import config_of
from workflow.tasks.results import IdentifiedPlant, RunResults
from workflow.tasks.system_documents import DOCUMENTS, read_document
from workflow.tasks.system_files import read_state_space
from workflow.text.findings.sentences import words
from workflow.text.sentences.design import NOTHING_STATED, nominal_inside

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False)
class DesignSource:
    """A plant with what its file says of it.

    Attributes
    ----------
    plant : UncertainPlant
    origin : str
        Kind of the file, in words.
    remarks : tuple of str
        What is worth knowing about the plant, a line each.
    config : RunConfig, optional
        Of a run: its specification and options.
    certified_for : str
        Of a run: what a certificate is about; "" otherwise.
    units : tuple of two str
        Of input and output, "" where they are not known.
    logged : Logged, optional
        Of a run: the columns that input and output have in the logs.
    part : str
        Which part of the run's set the plant is, "" where the set has one.
    path : Path
        Its file or directory.
    """

    plant: UncertainPlant
    origin: str
    remarks: tuple[str, ...] = ()
    config: RunConfig | None = None
    certified_for: str = ""
    units: tuple[str, str] = ("", "")
    logged: Logged | None = None
    part: str = ""
    path: Path = Path()


def load_sources(paths: Sequence[Path], design: DesignFile) -> list[DesignSource]:
    """Plants of a design, by different names and with one sampling time.

    Parameters
    ----------
    paths : sequence of Path
        Files or run directories, one or more.
    design : DesignFile
        Its `plant` and `uncertainty` sections say what files leave open.

    Returns
    -------
    list of DesignSource
        In the order of the paths; a run directory gives one for each part of its set.

    Raises
    ------
    InputError
        One line that names the file.
    """
    sources = list[DesignSource]()
    for path in paths:
        several = _sources_of_run(path) if path.is_dir() else [load_source(path, design)]
        sources += [replace(source, path=path) for source in several]
    if "level" in design.plant.model_fields_set:
        level = design.plant.level
        sources = [
            replace(source, plant=at_level(source.plant, level)) if level_can_change(source.plant) else source
            for source in sources
        ]
    stated = [source for source in sources if isinstance(source.plant.uncertainty, StatedDiscs)]
    if design.uncertainty is not None and not stated:
        raise InputError(
            f"{design.name} [uncertainty]: nothing to state it for: {paths[0]} brings its own ellipses"
        )
    if len(paths) == 1:
        return sources

    # One controller runs at one period.
    for source in sources[1:]:
        if not np.isclose(source.plant.dt_s, sources[0].plant.dt_s, rtol=1e-9, atol=0):
            raise InputError(
                f"{source.path}: sampling time {source.plant.dt_s:.6g} s, but {paths[0]} has "
                f"{sources[0].plant.dt_s:.6g} s: one controller runs at one"
            )

    # Shortest names that differ: of the file, with its folder, or the whole path.
    names = [path.stem if path.suffix else path.name for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.absolute().parent.name}/{path.name}" for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    by_path = dict(zip(paths, names, strict=True))

    # A run in several parts says behind its own name which part of it a plant is.
    renamed = []
    for source in sources:
        name = by_path[source.path]
        if source.part:
            name = f"{name}, {source.part}"
        renamed.append(replace(source, plant=replace(source.plant, name=name)))
    return renamed


def _sources_of_run(path: Path) -> list[DesignSource]:
    """Plants of a run directory: several where its set has several parts. Raises InputError."""
    run = RunDirectory.open(path)
    config = config_of(run)
    results = RunResults(run)
    about = results.certified_for(config)
    channel = config.control_channel
    units = results.records.unit(channel.input), results.records.unit(channel.output)
    logged = Logged.of(config, results.records)
    parts = [member.about for member in results.uncertainty.channels[config.control_index].members]
    sources = []
    for plant, part in zip(results.uncertainty.plants(config), parts, strict=True):
        remarks = (f"about {about}",)
        sources.append(DesignSource(plant, "run directory", remarks, config, about, units, logged, part))
    return sources


def level_can_change(plant: UncertainPlant) -> bool:
    """Whether its ellipses are known at every level: those of a posterior."""
    return isinstance(plant.uncertainty, ResponsePosterior | ResponseDraws)


def load_source(path: Path, design: DesignFile) -> DesignSource:
    """One plant from a file, by its content; of a run directory the first part of its set.

    Raises
    ------
    InputError
        One line that names the file.
    """
    if path.is_dir():
        return _sources_of_run(path)[0]
    if _ending(path) in READERS and _ending(path) not in DOCUMENTS:
        return _measured(path, design)
    document = read_document(path)
    if "A" not in document and _ending(path) in READERS and is_response(path):
        return _measured(path, design)
    with naming(str(path)):
        if codec.DOCUMENT in document:
            identified = codec.from_arrays(IdentifiedPlant, document)
            name = identified.model.output_name
            nominal = identified.model.to_control()
            plant = UncertainPlant(
                nominal, name=name, uncertainty=identified.posterior, level=identified.level
            )
            return DesignSource(plant, "model and posterior of flexlink identify")
        if document.get("format") == FORMAT:
            exported = read_model(path)
            name = exported.model.output_name
            nominal = exported.model.to_control()
            ellipses = exported.ellipses
            if ellipses is None:
                return _stated(name, nominal, design, "exported model")
            plant = UncertainPlant(nominal, name=name, uncertainty=ellipses, level=ellipses.level)
            return DesignSource(plant, "exported model with ellipses", _inside(ellipses, plant.nominal))
        nominal = read_state_space(path, document)
        _refuse_untold_integrators(path, nominal, design)
        return _stated(path.stem, nominal, design, "state space")


def _ending(path: Path) -> str:
    """The ending that says the format; of a file packed by gzip that before .gz."""
    if path.suffix.lower() == ".gz":
        return Path(path.stem).suffix.lower()
    return path.suffix.lower()


def _stated(name: str, nominal: control.StateSpace, design: DesignFile, origin: str) -> DesignSource:
    """A model that brings no ellipses: with the uncertainty of the design file, if it states one."""
    if design.uncertainty is None:
        return DesignSource(UncertainPlant(nominal, name=name), origin, (NOTHING_STATED,))
    weight = design.uncertainty.multiplicative or design.uncertainty.additive
    assert weight is not None
    with naming(f"{design.name} [uncertainty]"):
        relative = design.uncertainty.multiplicative is not None
        discs = StatedDiscs(nominal, weight, "multiplicative" if relative else "additive")
    return DesignSource(UncertainPlant(nominal, name=name, uncertainty=discs), origin)


def _refuse_untold_integrators(path: Path, nominal: control.StateSpace, design: DesignFile) -> None:
    """Nothing, for a model with as many poles at z = 1 as the design file states.

    Raises InputError otherwise: such a pole decides how often the Nyquist curve has to turn, so it is never
    guessed.
    """
    poles = np.asarray(nominal.poles(), dtype=np.complex128)
    counted = count_integrators(poles)
    stated = design.plant.integrators
    if counted != stated:
        away = np.sort(np.abs(poles - 1.0))[counted:stated]
        near = f" (another pole is {away[0]:.3g} away)" if away.size else ""
        raise InputError(
            f"{path}: {counted} of its poles at z = 1 (integration){near}, [plant] says {stated}: write "
            f"integrators = {counted} in [plant] of {design.name} if that is meant"
        )


def _measured(path: Path, design: DesignFile) -> DesignSource:
    """The plant of a measured frequency response.

    Its size comes from variances, from repeated points, or, of one sweep, from what the design file states.
    The nominal model is that of the design file, or one fitted to the response.
    """
    about = design.plant
    if about.dt_s is None:
        raise InputError(
            f"{path}: a frequency response does not say at which period the controller runs: write dt_s in "
            f"[plant] of {design.name}"
        )
    with naming(str(path)):
        response, stated = _read_response(path, design)
        if response.omega_rad_s.size < 2:
            raise InputError(f"{path}: one frequency is no response; expected many")
    origin = "measured response"
    remarks = tuple[str, ...]()
    if about.nominal is not None:
        nominal = read_state_space(about.nominal, read_document(about.nominal))
        # Periods that are written with all their digits differ by rounding only.
        if not np.isclose(float(nominal.dt), about.dt_s, rtol=1e-9, atol=0):
            raise InputError(
                f"{about.nominal}: dt_s = {float(nominal.dt):.6g}, but [plant] says {about.dt_s:.6g}"
            )
        _refuse_untold_integrators(about.nominal, nominal, design)
    with naming(str(path)):
        if stated and about.nominal is not None:
            return replace(_stated(path.stem, nominal, design, origin), remarks=_inside(response, nominal))
        if about.nominal is None:
            fit = about.fit.model_copy(update={"integrators": about.integrators})
            fitted = identify_frf(response, fit)
            nominal = fitted.model.to_control()
            origin = "measured response, poles of a fitted model"
            if stated:
                # Chi-square tells nothing of an uncertainty that somebody stated.
                verdicts = [item for item in fitted.verdicts if item.kind is not FindingKind.CHI_SQUARE]
                remarks = tuple(words(item) for item in (*verdicts, *fitted.warnings))
                remarks = (*remarks, *_inside(response, nominal))
                return replace(_stated(path.stem, nominal, design, origin), remarks=remarks)
            remarks = tuple(words(item) for item in (*fitted.verdicts, *fitted.warnings))
            if about.ellipses == "fitted":
                plant = UncertainPlant(
                    nominal, name=path.stem, uncertainty=fitted.posterior, level=response.level
                )
                return DesignSource(plant, "model fitted to a measured response", remarks)
        plant = UncertainPlant(nominal, name=path.stem, uncertainty=response, level=response.level)
    return DesignSource(plant, origin, (*remarks, *_inside(response, nominal)))


def _read_response(path: Path, design: DesignFile) -> tuple[FrequencyUncertainty, bool]:
    """The response, and whether its size is what the design file states."""
    about = design.plant
    assert about.dt_s is not None
    measured = measured_response(
        [path],
        about.dt_s,
        level=about.level,
        pool_neighbours=about.pool_neighbours,
        outlier_threshold=about.outlier_threshold,
    )
    if isinstance(measured, FrequencyUncertainty):
        return measured, False
    if design.uncertainty is None:
        raise InputError(
            f"{path}: one sweep: every frequency is measured once, so its spread is not known; give "
            "variance_real, variance_imag or a stated uncertainty, as [uncertainty] multiplicative = 0.1 in "
            f"{design.name}"
        )
    # Every frequency stands here once: this only sorts.
    grid, first = np.unique(measured.omega_rad_s, return_index=True)
    centre = measured.response[first]
    weight = design.uncertainty.multiplicative or design.uncertainty.additive
    assert weight is not None
    size = np.abs(centre) if design.uncertainty.multiplicative is not None else 1.0
    # As `StatedDiscs` sees the weight.
    tustin = 2j / about.dt_s * np.tan(np.minimum(grid * about.dt_s / 2, np.pi / 2))
    deviation = size * np.abs(weight.at(tustin)) / chi2_radius(about.level)
    covariance = deviation[:, None, None] ** 2 * np.eye(2)
    return FrequencyUncertainty(grid, centre, covariance, about.dt_s, about.level, "stated"), True


def _inside(ellipses: FrequencyUncertainty, nominal: control.StateSpace) -> tuple[str, ...]:
    """A line on the share of ellipses that hold the nominal model; at zero frequency it may be infinite."""
    moving = ellipses.omega_rad_s > 0
    above_zero = replace(
        ellipses,
        omega_rad_s=ellipses.omega_rad_s[moving],
        centre=ellipses.centre[moving],
        covariance=ellipses.covariance[moving],
    )
    agreement = NominalAgreement.of(above_zero, lambda omega: frequency_response(nominal, omega))
    return (nominal_inside(agreement, ellipses.omega_rad_s.size),)
