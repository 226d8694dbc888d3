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

import control
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
from workflow.tasks.pipeline import certified_for, config_of
from workflow.tasks.results import IdentifiedPlant, RunResults
from workflow.tasks.system_documents import DOCUMENTS, read_document
from workflow.tasks.system_files import read_state_space
from workflow.text.templates import said, words


@dataclass(frozen=True, eq=False)
class DesignSource:
    """A plant as read; remarks say what is worth knowing about it; a run brings its own specification and
    options (`config`), and knows what a certificate is about (`certified_for`), the units of input and
    output, and the columns they have in the logs (`logged`); part: of the run's set that the plant is, where
    that has several; path: its file or directory."""

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
    """All plants, by different names and with one sampling time. Raises InputError naming the file."""
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
    for source in sources[1:]:
        if not np.isclose(source.plant.dt_s, sources[0].plant.dt_s, rtol=1e-9, atol=0):
            raise InputError(
                f"{source.path}: sampling time {source.plant.dt_s:.6g} s, but {paths[0]} has "
                f"{sources[0].plant.dt_s:.6g} s: one controller runs at one"
            )
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
    """All plants of a run directory: several where its set has several parts. Raises InputError."""
    run = RunDirectory.open(path)
    config = config_of(run)
    results = RunResults(run)
    about = certified_for(results, config)
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
    """One plant. Raises InputError: one line that names the file."""
    if path.is_dir():
        return _sources_of_run(path)[0]
    if _ending(path) in READERS and _ending(path) not in DOCUMENTS:
        return _measured(path, design)
    document = read_document(path)
    if "A" not in document and _ending(path) in READERS and is_response(path):
        return _measured(path, design)
    with naming(str(path)):
        if codec.DOCUMENT in document:
            found = codec.from_arrays(IdentifiedPlant, document)
            name, nominal = found.model.output_name, found.model.to_control()
            plant = UncertainPlant(name, nominal, found.posterior, level=found.level)
            return DesignSource(plant, "model and posterior of flexlink identify")
        if document.get("format") == FORMAT:
            exported = read_model(path)
            name, nominal = exported.model.output_name, exported.model.to_control()
            if (ellipses := exported.ellipses) is None:
                return _stated(name, nominal, design, "exported model")
            plant = UncertainPlant(name, nominal, ellipses, level=ellipses.level)
            return DesignSource(plant, "exported model with ellipses", _inside(ellipses, plant.nominal))
        nominal = read_state_space(path, document)
        _refuse_untold_integrators(path, nominal, design)
        return _stated(path.stem, nominal, design, "state space")


def _ending(path: Path) -> str:
    """The ending that says the format; of a file packed by gzip that before .gz."""
    return Path(path.stem).suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()


def _stated(name: str, nominal: control.StateSpace, design: DesignFile, origin: str) -> DesignSource:
    """A model that brings no ellipses: with the uncertainty of the design file, if it states one."""
    if design.uncertainty is None:
        return DesignSource(UncertainPlant(name, nominal), origin, (said("nothing_stated"),))
    weight = design.uncertainty.multiplicative or design.uncertainty.additive
    assert weight is not None
    with naming(f"{design.name} [uncertainty]"):
        relative = design.uncertainty.multiplicative is not None
        discs = StatedDiscs(nominal, weight, "multiplicative" if relative else "additive")
    return DesignSource(UncertainPlant(name, nominal, discs), origin)


def _refuse_untold_integrators(path: Path, nominal: control.StateSpace, design: DesignFile) -> None:
    """A pole on the circle decides how often the Nyquist curve has to turn: it is never guessed."""
    poles = np.asarray(nominal.poles(), dtype=np.complex128)
    found, told = count_integrators(poles), design.plant.integrators
    if found != told:
        away = np.sort(np.abs(poles - 1.0))[found:told]
        near = f" (another pole is {away[0]:.3g} away)" if away.size else ""
        raise InputError(
            f"{path}: {found} of its poles at z = 1 (integration){near}, [plant] says {told}: write "
            f"integrators = {found} in [plant] of {design.name} if that is meant"
        )


def _measured(path: Path, design: DesignFile) -> DesignSource:
    """A measured frequency response with variances, as repeated points, or as one sweep where the design file
    states the uncertainty."""
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
    origin, said = "measured response", tuple[str, ...]()
    if about.nominal is not None:
        nominal = read_state_space(about.nominal, read_document(about.nominal))
        if not np.isclose(float(nominal.dt), about.dt_s, rtol=1e-9, atol=0):
            raise InputError(
                f"{about.nominal}: dt_s = {float(nominal.dt):.6g}, but [plant] says {about.dt_s:.6g}"
            )
        _refuse_untold_integrators(about.nominal, nominal, design)
    with naming(str(path)):
        if stated and about.nominal is not None:
            return replace(_stated(path.stem, nominal, design, origin), remarks=_inside(response, nominal))
        if about.nominal is None:
            found = identify_frf(response, about.fit.model_copy(update={"integrators": about.integrators}))
            nominal, origin = found.model.to_control(), "measured response, poles of a fitted model"
            if stated:
                # Chi-square tells nothing of an uncertainty that somebody stated.
                told = [item for item in found.verdicts if item.kind is not FindingKind.CHI_SQUARE]
                said = (*(words(item) for item in (*told, *found.warnings)), *_inside(response, nominal))
                return replace(_stated(path.stem, nominal, design, origin), remarks=said)
            said = tuple(words(item) for item in (*found.verdicts, *found.warnings))
            if about.ellipses == "fitted":
                plant = UncertainPlant(path.stem, nominal, found.posterior, level=response.level)
                return DesignSource(plant, "model fitted to a measured response", said)
        plant = UncertainPlant(path.stem, nominal, response, level=response.level)
    return DesignSource(plant, origin, (*said, *_inside(response, nominal)))


def _read_response(path: Path, design: DesignFile) -> tuple[FrequencyUncertainty, bool]:
    """The response, and whether its size is what the design file states."""
    about = design.plant
    assert about.dt_s is not None
    found = measured_response(
        [path],
        about.dt_s,
        level=about.level,
        pool_neighbours=about.pool_neighbours,
        outlier_threshold=about.outlier_threshold,
    )
    if isinstance(found, FrequencyUncertainty):
        return found, False
    if design.uncertainty is None:
        raise InputError(
            f"{path}: one sweep: every frequency is measured once, so its spread is not known; give "
            "variance_real, variance_imag or a stated uncertainty, as [uncertainty] multiplicative = 0.1 in "
            f"{design.name}"
        )
    grid, first = np.unique(found.omega_rad_s, return_index=True)
    centre, weight = found.response[first], design.uncertainty.multiplicative or design.uncertainty.additive
    assert weight is not None
    size = np.abs(centre) if design.uncertainty.multiplicative is not None else 1.0
    # As `StatedDiscs` sees the weight.
    tustin = 2j / about.dt_s * np.tan(np.minimum(grid * about.dt_s / 2, np.pi / 2))
    deviation = size * np.abs(weight.at(tustin)) / chi2_radius(about.level)
    covariance = deviation[:, None, None] ** 2 * np.eye(2)
    return FrequencyUncertainty(grid, centre, covariance, about.dt_s, about.level, "stated"), True


def _inside(own: FrequencyUncertainty, nominal: control.StateSpace) -> tuple[str, ...]:
    inside = own.omega_rad_s > 0
    at = FrequencyUncertainty(
        own.omega_rad_s[inside], own.centre[inside], own.covariance[inside], own.dt_s, own.level, own.method
    )
    found = NominalAgreement.of(at, lambda omega: frequency_response(nominal, omega))
    return (said("nominal_inside", found, own.omega_rad_s.size),)
