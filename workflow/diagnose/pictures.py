"""The pictures of a case's page."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from plant.modal import linear_arm
from workflow.diagnose.content import CasePage
from workflow.diagnose.document import gaps_by_experiment, residuals_by_model
from workflow.diagnose.words import effect_words
from workflow.figures.gap_answer import draw_probabilities, draw_waterfall
from workflow.figures.gap_controller import LoopRun, draw_controller_check
from workflow.figures.gap_next import draw_next_experiment
from workflow.figures.gap_records import ResidualRecord, draw_residual_spectra, draw_residual_traces
from workflow.figures.gap_where import draw_bands_and_experiments, draw_curves, draw_regimes

_MOST_REGIMES = 6


def drawers_of(content: CasePage) -> dict[str, Callable[[], Figure]]:
    """Name -> how to draw it; only what there is something to draw for."""
    found, case, where = content.found, content.loaded.case, content.where
    dt = case.rig.sampling.dt_s
    regimes = [finding for finding in where.regimes if finding.found][:_MOST_REGIMES]
    curves = [curve for curve in where.curves if curve.found]
    ranked = sorted(found.probabilities.items(), key=lambda item: -item[1])
    accepted = set(found.combination) or {"none" if found.verdict == "none" else "unknown"}
    residuals = residuals_by_model(found)
    held_out = {"stated": found.gap_before, "refit": found.gap_refit, "repaired": found.gap_after}
    models = content.models
    shown = tuple(dict.fromkeys(("stated", models[-1])))
    drawers: dict[str, Callable[[], Figure]] = {
        "waterfall": lambda: draw_waterfall(
            {model: held_out[model] for model in models},
            {name: {m: e[m] for m in models} for name, e in gaps_by_experiment(found).items()},
            found.noise_floor,
        ),
        "bands": lambda: draw_bands_and_experiments(where.bands, where.experiments),
        "traces": lambda: draw_residual_traces(
            [
                ResidualRecord(e.name, e.role == "held_out", {m: residuals[m][e.name] for m in shown})
                for e in case.experiments
            ],
            dt,
        ),
        "probabilities": lambda: draw_probabilities(
            [effect_words(name) for name, _ in ranked],
            [p for _, p in ranked],
            [name in accepted for name, _ in ranked],
        ),
        "spectra": lambda: draw_residual_spectra(
            {model: list(residuals[model].values()) for model in models},
            _modes_Hz(content),
            dt,
        ),
    }
    if regimes:
        drawers["regimes"] = lambda: draw_regimes(regimes)
    if curves:
        drawers["curves"] = lambda: draw_curves(curves)
    coming = content.next_experiment
    proposal = coming.proposal
    if proposal is not None and proposal.separates:
        drawers["next"] = lambda: draw_next_experiment(
            np.arange(proposal.voltage_V.size, dtype=np.float64) * proposal.dt_s,
            proposal.voltage_V,
            coming.differences(),
            (coming.rivals[0].name, coming.rivals[1].name),
        )
    check = content.check
    if check is not None:
        drawers["controller"] = lambda: draw_controller_check(
            check.time_s,
            check.arm_m * check.reference_rad,
            tuple(
                LoopRun("repaired" if i > 1 else "stated", i % 2 == 1, run.tip_m, run.command_V)
                for i, run in enumerate(check.runs)
            ),
        )
    return drawers


def _modes_Hz(content: CasePage) -> list[float]:
    poles = linear_arm(content.loaded.case.rig).poles_rad_s()
    upper = poles[poles.imag > 0]
    return sorted(float(abs(pole)) / (2 * np.pi) for pole in upper)
