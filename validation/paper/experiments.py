"""Everything the seven figures show, computed in one go: no files, no pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.basis.model import GobfModel
from ident.data.arrays import ComplexArray, RealArray
from validation.paper.bounds import BoundsStudy, study_bounds
from validation.paper.machines import LinkExperiment, PaperMachine, SimulationExample, Trial
from validation.paper.methods import (
    BETTER_STARTS,
    METHODS,
    LinearModel,
    Score,
    fit_methods,
    fit_percent,
    free_run,
    median_scores,
    score,
)
from validation.paper.settings import DT_S, PaperSettings
from validation.paper.surface import SurfaceStudy, paper_recipe, study_surface
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng

# Stages with the seconds they take on one core, compilation of the kernels not counted.
STAGES = (("surface", 10.0), ("simulation", 6.0), ("experiment", 6.0), ("bounds", 12.0), ("page", 6.0))
# Frequencies of a curve.
_N_FREQUENCIES = 400
# The paper does not print how long it searched; ten times our budget, and a hundred times changes nothing.
RECIPE_BUDGET = 10


@dataclass(frozen=True, eq=False)
class Comparison:
    """The methods on one machine: one drawn record, and medians over several.

    ceiling_percent is the fit that the true output itself would reach on the noisy fresh record, drawn and
    median; medians is by method, see `methods.median_scores`.
    """

    machine: PaperMachine
    trial: Trial
    omega_rad_s: RealArray
    truth: ComplexArray
    models: dict[str, LinearModel]
    scores: dict[str, Score]
    simulated: dict[str, RealArray]
    ceiling_percent: float
    median_ceiling_percent: float
    medians: dict[str, dict[str, float]]


@dataclass(frozen=True, eq=False)
class PaperResults:
    """Results of one run; `recipe` is GOBF by the paper's own search on the simulation record."""

    settings: PaperSettings
    surface: SurfaceStudy
    simulation: Comparison
    recipe: GobfModel
    recipe_score: Score
    experiment: Comparison
    bounds: BoundsStudy


def frequencies() -> RealArray:
    """The paper's axis, 0.1 rad/s on, up to half the sampling rate (its own goes to 1000 rad/s)."""
    return np.geomspace(0.1, 0.999 * np.pi / DT_S, _N_FREQUENCIES)


def run_experiments(settings: PaperSettings, progress: Progress) -> PaperResults:
    """Results of every experiment of the paper; the same settings give the same numbers."""
    with progress.stage("surface") as report:
        surface = study_surface(settings, report)
    with progress.stage("simulation") as report:
        simulation = compare(SimulationExample(), settings, report)
    recipe = paper_recipe(simulation.trial.fitted, RECIPE_BUDGET * settings.evaluations)
    with progress.stage("experiment") as report:
        experiment = compare(LinkExperiment(), settings, report)
    with progress.stage("bounds") as report:
        bounds = study_bounds(experiment.trial.fitted, experiment.omega_rad_s, settings, report)
    return PaperResults(
        settings=settings,
        surface=surface,
        simulation=simulation,
        recipe=recipe,
        recipe_score=score(simulation.machine, simulation.trial, recipe, simulation.omega_rad_s),
        experiment=experiment,
        bounds=bounds,
    )


def compare(
    machine: PaperMachine, settings: PaperSettings, report: Callable[[float, str], None]
) -> Comparison:
    """Models of every method on the drawn record (trial 0), and their scores over `repeats` trials."""
    omega = frequencies()
    collected: dict[str, list[Score]] = {name: [] for name in (*METHODS, *BETTER_STARTS)}
    ceilings: list[float] = []
    first: tuple[Trial, dict[str, LinearModel]] | None = None
    for number in range(settings.repeats):
        report(number / settings.repeats, f"record {number + 1}")
        trial = machine.trial(stage_rng(settings.seed, "paper", machine.name, str(number)))
        models = fit_methods(trial.fitted)
        first = first or (trial, models)
        ceilings.append(fit_percent(trial.fresh.output[:, 0], trial.fresh_clean))
        for name, model in models.items():
            collected[name].append(score(machine, trial, model, omega))
    assert first is not None
    trial, models = first
    return Comparison(
        machine=machine,
        trial=trial,
        omega_rad_s=omega,
        truth=machine.response(omega),
        models=models,
        scores={name: of_trials[0] for name, of_trials in collected.items()},
        simulated={name: free_run(model, trial.fresh) for name, model in models.items()},
        ceiling_percent=ceilings[0],
        median_ceiling_percent=float(np.median(ceilings)),
        medians=median_scores(collected),
    )
