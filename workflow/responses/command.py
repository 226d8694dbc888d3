"""`flexlink identify` of a measured frequency response: a table of points in; model files and numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ident.basis.model_files import ModelFile
from ident.basis.options import IdentOptions
from ident.data.frequency_uncertainty import FREQUENCIES
from ident.data.frf_records import FrfRepeats, measured_response
from ident.frequency_fit import identify_frf
from ident.uncertainty.nominal import nominal_near
from workflow.config.command_files import refuse_model_ending
from workflow.describe.summary import RunSummary
from workflow.engine import codec, interrupts, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.responses.words import response_sections
from workflow.tasks.exports import model_bytes
from workflow.tasks.results import IdentifiedPlant
from workflow.text.findings.sentences import words
from workflow.text.formats import count


def identify_response(
    paths: Sequence[Path],
    dt_s: float | None,
    *,
    level: float = 0.95,
    options: IdentOptions | None = None,
    out: Path | None = None,
    export: Path | None = None,
    refused: Sequence[str] = (),
    progress: Progress | None = None,
) -> RunSummary:
    """Fit a model to a measured response with variances, or to repeated sweeps.

    Parameters
    ----------
    paths : sequence of Path
        One file or several of one response.
    dt_s : float or None
        Period at which the model runs [s]; None is refused.
    level : float
        Probability of an ellipse.
    options : IdentOptions, optional
        Of the pole search.
    out : Path, optional
        npz with model and posterior, for `flexlink design`.
    export : Path, optional
        The model as .json or .mat.
    refused : sequence of str
        Options of logs that were typed, which mean nothing here.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line.
    """
    if refused:
        raise InputError(
            f"{paths[0]}: a frequency response, not a log over time: leave out {' and '.join(refused)}"
        )
    if dt_s is None:
        raise InputError(
            f"{paths[0]}: a frequency response does not say at which period the model runs: "
            "give it, --dt-s SECONDS"
        )
    refuse_model_ending(export)
    progress = progress or Progress()
    progress.plan((("identify", 1.0),))
    with progress.stage("identify"), naming(str(paths[0])):
        response = measured_response(paths, dt_s, level=level)
        if isinstance(response, FrfRepeats):
            raise InputError(
                f"{paths[0]}: one sweep: every frequency is measured once, so its spread is not known; give "
                "variance_real, variance_imag or more sweeps (flexlink identify SWEEP1 SWEEP2 SWEEP3); or a "
                "stated uncertainty, [uncertainty] multiplicative = 0.1 in the file of flexlink design --spec"
            )
        fit = identify_frf(response, options)

    # Files are written together at the end, so that a refusal leaves none.
    written: dict[Path, bytes] = {}
    if out is not None or export is not None:
        # Between the ends of what was measured; frequency 0 has no logarithm.
        positive = response.omega_rad_s[response.omega_rad_s > 0]
        omega = np.geomspace(positive[0], positive[-1], FREQUENCIES)
        if out is not None:
            nominal = nominal_near(fit.posterior, fit.model.poles, omega)
            written[out] = storage.npz_bytes(codec.to_arrays(IdentifiedPlant(nominal, fit.posterior, level)))
        if export is not None:
            written[export] = model_bytes(export, ModelFile(fit.model, fit.posterior.at(omega, level)))
    interrupts.check()
    storage.write_together(written)

    poles = fit.model.poles
    dt_s = fit.model.dt_s
    modes = []
    for omega_rad_s, zeta in zip(poles.omega_rad_s(dt_s).tolist(), poles.zeta().tolist(), strict=True):
        frequency_Hz = omega_rad_s / (2 * np.pi)
        modes.append({"omega_rad_s": omega_rad_s, "frequency_Hz": frequency_Hz, "damping": zeta})
    return RunSummary(
        title=f"frequency response {paths[0].name}",
        sections=response_sections(fit, response),
        numbers={
            "order": fit.model.order,
            "dt_s": dt_s,
            "real_poles_per_s": codec.plain(poles.decay_per_s(dt_s)),
            "modes": modes,
            "chi_square": fit.rss,
            "degrees_of_freedom": fit.degrees_of_freedom,
            "verdicts": [words(item) for item in fit.verdicts],
            "warnings": [words(item) for item in fit.warnings],
            "file": None if out is None else str(out),
            "model_file": None if export is None else str(export),
        },
        verdict=count(len(fit.warnings), "warning"),
    )
