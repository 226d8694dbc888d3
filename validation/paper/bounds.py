"""Fig. 7: two-sigma bounds by the paper's stochastic embedding and by the tangent method, and the truth.

Two standard deviations in every direction of the complex plane hold 1 - exp(-2) = 86.5 % of a Gaussian: that
is the share of frequencies at which an honest bound should hold the truth, on average over records.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.posterior import ResponsePosterior
from ident.checks.residual_tests import whiteness_test
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.identification import Identification
from ident.one_input import identify
from ident.uncertainty import FrequencyUncertainty
from ident.uncertainty.embedding import tangent
from validation.paper.classical import classical
from validation.paper.machines import LinkExperiment, PaperMachine, SimulationExample
from validation.paper.methods import JUDGED_BAND_RAD_S, gobf_options
from validation.paper.settings import PaperSettings
from workflow.engine.randomness import stage_rng

# Probability of an ellipse of two standard deviations in the plane: 1 - exp(-2).
TWO_SIGMA_LEVEL = float(-np.expm1(-2.0))
# Ways to bounds, by the names of the table.
RECIPES = ("classical", "tangent", "tangent (poles from the data)")


@dataclass(frozen=True)
class Coverage:
    """How the bounds of one recipe hold on one machine, in the judged band, over `records` records.

    inside_percent: share of frequencies whose two-sigma ellipse holds the truth, mean over the records;
    radius_percent: median largest semi-axis relative to |G|; offset_percent: median distance of the mean
    of all centres from the truth, relative to |G| (what no number of records would average away).
    """

    machine: str
    recipe: str
    records: int
    inside_percent: float
    radius_percent: float
    offset_percent: float


@dataclass(frozen=True, eq=False)
class BoundsStudy:
    """Both bounds of the drawn record on omega (F,), the truth there, and the coverage over several records.

    inside_percent is of the drawn record alone, over the judged band and over all frequencies drawn; distance
    and distance_frictionless (F,) are that of the truth from the centre in units of two sigma, for the drawn
    record and for one of the same arm without dry friction.
    """

    omega_rad_s: RealArray
    truth: ComplexArray
    bounds: dict[str, FrequencyUncertainty]
    inside_percent: dict[str, tuple[float, float]]
    distance: dict[str, RealArray]
    distance_frictionless: dict[str, RealArray]
    coverage: tuple[Coverage, ...]


def posteriors_of(record: Record) -> dict[str, ResponsePosterior]:
    """Response posterior of one record by each recipe; the noise is modelled where it is not white."""
    ordered = identify([record], gobf_options())
    chosen = identify([record], IdentOptions())
    classical_recipe, tangent_recipe, chosen_recipe = RECIPES
    posteriors = {
        classical_recipe: classical([record], ordered.model, _embedding_options(ordered)),
        tangent_recipe: tangent([record], ordered.model, _embedding_options(ordered)),
    }
    if np.array_equal(chosen.model.poles.values, ordered.model.poles.values):
        posteriors[chosen_recipe] = posteriors[tangent_recipe]  # the data chose order 4 too
    else:
        posteriors[chosen_recipe] = tangent([record], chosen.model, _embedding_options(chosen))
    return posteriors


def _embedding_options(found: Identification) -> EmbeddingOptions:
    return EmbeddingOptions(coloured_noise=not whiteness_test(found.residuals).passed)


def study_bounds(
    record: Record, omega_rad_s: RealArray, settings: PaperSettings, report: Callable[[float, str], None]
) -> BoundsStudy:
    """Bounds of the drawn record, then coverage over `repeats` records of each machine."""
    truth = LinkExperiment().response(omega_rad_s)
    low, high = JUDGED_BAND_RAD_S
    band = (omega_rad_s >= low) & (omega_rad_s <= high)
    bounds = _shown(record, omega_rad_s)
    distance = {name: bound.normalised_distance(truth) for name, bound in bounds.items()}
    frictionless = LinkExperiment(friction=False)
    linear = frictionless.trial(stage_rng(settings.seed, "paper", "bounds", frictionless.name, "0")).fitted
    machines: list[PaperMachine] = [SimulationExample(), frictionless, LinkExperiment()]
    rows: list[Coverage] = []
    for number, machine in enumerate(machines):

        def partly(fraction: float, message: str, done: int = number) -> None:
            report((done + fraction) / len(machines), message)

        rows += coverage_of(machine, omega_rad_s[band], settings, partly)
    return BoundsStudy(
        omega_rad_s=omega_rad_s,
        truth=truth,
        bounds=bounds,
        inside_percent={
            name: (100 * float((values[band] <= 1).mean()), 100 * float((values <= 1).mean()))
            for name, values in distance.items()
        },
        distance=distance,
        distance_frictionless={
            name: bound.normalised_distance(truth) for name, bound in _shown(linear, omega_rad_s).items()
        },
        coverage=tuple(rows),
    )


def _shown(record: Record, omega_rad_s: RealArray) -> dict[str, FrequencyUncertainty]:
    posteriors = posteriors_of(record)
    return {name: posteriors[name].at(omega_rad_s, TWO_SIGMA_LEVEL) for name in RECIPES[:2]}


def coverage_of(
    machine: PaperMachine,
    omega_rad_s: RealArray,
    settings: PaperSettings,
    report: Callable[[float, str], None],
) -> list[Coverage]:
    """Every recipe on `repeats` records of one machine, omega (F,)."""
    truth = machine.response(omega_rad_s)
    size = np.abs(truth)
    ellipses: dict[str, list[FrequencyUncertainty]] = {name: [] for name in RECIPES}
    for k in range(settings.repeats):
        report(k / settings.repeats, f"{machine.name}, record {k + 1}")
        record = machine.trial(stage_rng(settings.seed, "paper", "bounds", machine.name, str(k))).fitted
        for name, posterior in posteriors_of(record).items():
            ellipses[name].append(posterior.at(omega_rad_s, TWO_SIGMA_LEVEL))
    rows = []
    for name, bounds in ellipses.items():
        mean = np.mean([bound.centre for bound in bounds], axis=0)
        rows.append(
            Coverage(
                machine=machine.name,
                recipe=name,
                records=settings.repeats,
                inside_percent=100 * float(np.mean([bound.contains(truth).mean() for bound in bounds])),
                radius_percent=100 * float(np.median([b.ellipse().semi_major / size for b in bounds])),
                offset_percent=100 * float(np.median(np.abs(mean - truth) / size)),
            )
        )
    return rows
