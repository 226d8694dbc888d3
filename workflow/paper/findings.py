"""What the run found, figure by figure, in sentences made from its numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from workflow.paper.bounds import TWO_SIGMA_LEVEL, Coverage
from workflow.paper.experiments import RECIPE_BUDGET, Comparison, PaperResults
from workflow.paper.methods import BETTER_STARTS, METHODS
from workflow.report.words import listing, number

# A response is matched where its RMS error stays below this; a fit is good within these points of the best.
_MATCHED = 0.1
_CLOSE_TO_BEST = 10.0


@dataclass(frozen=True)
class Finding:
    """Whether the run agrees with what the paper reports, and what it found."""

    agrees: bool
    headline: str
    sentences: tuple[str, ...]


def findings_of(results: PaperResults) -> tuple[Finding, ...]:
    """One per figure."""
    makers: Sequence[Callable[[PaperResults], Finding]] = (_one, _two, _three, _four, _five, _six, _seven)
    return tuple(make(results) for make in makers)


def _one(results: PaperResults) -> Finding:
    study = results.surface
    finest = study.counts[-1]
    drawn = next((c for c in study.counts if c.n_points == study.surface.first.size), finest)
    several = finest.inside > 1
    shares, searches = study.shares, study.shares.searches
    border = f"{study.counts[0].border} to {finest.border}"
    grids = f"{study.counts[0].n_points} to {finest.n_points}"
    headline = (
        f"{finest.inside} minima inside the window"
        if several
        else "one minimum inside the window, not several"
    )
    return Finding(
        several,
        headline,
        (
            f"Inside the paper's window we count {_span([c.inside for c in study.counts])} on grids of "
            f"{grids} "
            f"points per axis. What grows with the grid ({border}) is the number of lowest points at the "
            "border: "
            "side valleys that run on out of the window. A coarse grid or a cut at constant gamma makes "
            "minima "
            "of them.",
            f"Followed downhill with the window no longer in the way, {study.reached} of the "
            f"{study.descended} "
            f"border points on the {drawn.n_points}-point grid end in the global minimum"
            + (", so the valleys do trap a descent." if study.reached < study.descended else "."),
            f"A search does need more than a descent at order 4. There the {len(_variants(results))} DIRECT "
            f"variants with {shares.evaluations} evaluations and one descent from their best point end in "
            "the "
            f"global minimum in {number(shares.share_percent('order 4', 'raw'))} % of the searches from the "
            f"paper's box and {number(shares.share_percent('order 4', 'log'))} % in logarithmic coordinates "
            f"({searches} records each); at order 2 in {number(shares.share_percent('order 2', 'raw'))} % "
            "and "
            f"{number(shares.share_percent('order 2', 'log'))} %. Coordinates matter, the variant hardly.",
        ),
    )


def _two(results: PaperResults) -> Finding:
    shown, recipe = results.simulation, results.recipe_score
    own, many = shown.scores["GOBF"], shown.medians["GOBF"]
    matched = own.mode_found and own.response_error < _MATCHED
    found = "finds the mode too" if recipe.mode_found else "misses the mode"
    mode = (
        "no pair"
        if own.mode is None
        else f"{number(own.mode[0], 4)} rad/s with damping {number(own.mode[1])}"
    )
    return Finding(
        matched,
        "the model matches the plant" if matched else "the model does not match the plant",
        (
            f"GOBF puts the mode at {mode}; true are {number(shown.machine.mode[0], 4)} rad/s and "
            f"{number(shown.machine.mode[1])}. The response is off by {_percent(own.response_error)} RMS "
            "between "
            f"1 and 100 rad/s (median of {number(many['trials'])} records "
            f"{_percent(many['response_error'])}, mode "
            f"found in {number(many['mode_found'])}).",
            "The search as printed, DIRECT alone in the raw box with "
            f"{RECIPE_BUDGET * results.settings.evaluations} "
            f"evaluations, {found} on this record: {_percent(recipe.response_error)} RMS. "
            "The paper does not say how long it searched, nor from which bounds.",
            "Near half the sampling rate the curves part: the held input puts a zero there that 30 dB "
            "cannot show.",
        ),
    )


def _three(results: PaperResults) -> Finding:
    shown = results.simulation
    peers = METHODS[1:]
    found = [name for name in peers if shown.scores[name].mode_found]
    return Finding(
        not found,
        "none of the three finds the mode" if not found else f"{listing(found)} finds the mode",
        (
            f"{_mode_counts(shown, peers)}. RMS error between 1 and 100 rad/s on the drawn record: "
            f"{_errors(shown, peers)}; GOBF {_percent(shown.scores['GOBF'].response_error)}.",
            "It is the starts, more than the noise: from a Steiglitz-McBride start the same structures "
            "find the "
            f"mode ({_mode_counts(shown, BETTER_STARTS)}) and come to {_errors(shown, BETTER_STARTS)}. ARX "
            "has "
            "no start to choose; it is biased, because its noise model is wrong.",
        ),
    )


def _four(results: PaperResults) -> Finding:
    shown = results.experiment
    found = [name for name in METHODS if shown.scores[name].mode_found]
    agrees = set(found) == {"GOBF", "OE"}
    return Finding(
        agrees,
        f"the resonance is found by {listing(found)}" if found else "nobody finds the resonance",
        (
            f"The arm's first mode lies at {number(shown.machine.mode[0])} rad/s with damping "
            f"{number(shown.machine.mode[1])} (the motor's back-EMF damps it). "
            f"{_mode_counts(shown, METHODS)}; "
            f"RMS error against the linear arm: {_errors(shown, METHODS)}.",
            f"With a better start: {_mode_counts(shown, BETTER_STARTS)}, {_errors(shown, BETTER_STARTS)}. "
            "The "
            "paper's OE did find the resonance of its machine, whose damping and noise it does not give.",
            "The second mode is out of reach of order 4 for every method.",
        ),
    )


def _five(results: PaperResults) -> Finding:
    shown = results.experiment
    own, many = shown.scores["GOBF"].fit_percent, shown.medians["GOBF"]
    good = own >= shown.ceiling_percent - _CLOSE_TO_BEST
    return Finding(
        good,
        f"fit {number(own)} %, of {number(shown.ceiling_percent)} % that the sensor noise leaves",
        (
            f"Free run from rest on fresh data, nothing taken out: fit {number(own)} % (median of "
            f"{number(many['trials'])} records {number(many['fit_percent'])} %); the true tip without noise "
            "would "
            f"reach {number(shown.ceiling_percent)} %.",
            "What is left moves slowly: the tip integrates whatever dry friction does, and no linear model "
            "knows it.",
        ),
    )


def _six(results: PaperResults) -> Finding:
    shown = results.experiment
    peers = METHODS[1:]
    own = shown.scores["GOBF"].fit_percent
    better = [name for name in peers if shown.scores[name].fit_percent >= own]
    return Finding(
        not better,
        f"GOBF {number(own)} %, the others {_fits(shown, peers)}",
        (
            f"Fit on the same fresh data: {_fits(shown, peers)}; medians over "
            f"{number(shown.medians['GOBF']['trials'])} records "
            + listing([f"{name} {number(shown.medians[name]['fit_percent'])} %" for name in METHODS])
            + ".",
            f"From a better start: {_fits(shown, BETTER_STARTS)}. The fit of a free run is won at low "
            "frequency, "
            "where the tip moves most: a model without the mode can still score well, so Fig. 4 says more.",
        ),
    )


def _seven(results: PaperResults) -> Finding:
    study = results.bounds
    omega, size = study.omega_rad_s, np.abs(study.truth)
    radius = study.bounds["classical"].ellipse().semi_major / size
    low = float(np.median(radius[(omega >= 1) & (omega <= 10)]))
    high = float(np.median(radius[omega >= 100]))
    of = {(item.machine, item.recipe): item for item in study.coverage}
    return Finding(
        high > low,
        f"bounds grow from {_percent(low)} of |G| (1 to 10 rad/s) to {_percent(high)} (above 100 rad/s)",
        (
            f"On this record the truth lies inside at {number(study.inside_percent['classical'][0])} % of "
            "the "
            "frequencies between 1 and 100 rad/s (classical) and "
            f"{number(study.inside_percent['tangent'][0])} % "
            f"(tangent); an honest bound of two standard deviations holds it at "
            f"{_percent(TWO_SIGMA_LEVEL)}, on average over records.",
            "Means over records: "
            + "; ".join(_coverage_words(of, name) for name in _machines(study.coverage))
            + ".",
            _friction_words(of),
        ),
    )


def _coverage_words(of: dict[tuple[str, str], Coverage], machine: str) -> str:
    parts = [
        f"{recipe} {number(item.inside_percent)} %" for (name, recipe), item in of.items() if name == machine
    ]
    return f"{machine}: {listing(parts)}"


def _machines(coverage: Sequence[Coverage]) -> list[str]:
    return list(dict.fromkeys(item.machine for item in coverage))


def _friction_words(of: dict[tuple[str, str], Coverage]) -> str:
    with_friction, without = of["experiment", "tangent"], of["experiment without friction", "tangent"]
    return (
        "No bound from one record can hold the linear arm when dry friction moves the response itself: over "
        "the "
        f"{with_friction.records} records the mean of all tangent models is "
        f"{number(with_friction.offset_percent)} % "
        f"off the linear arm, with bounds of {number(with_friction.radius_percent)} %; without friction "
        f"{number(without.offset_percent)} % off, with bounds of {number(without.radius_percent)} %. "
        "Records at "
        "several amplitudes show this part of the uncertainty (ident.conditions)."
    )


def _variants(results: PaperResults) -> set[str]:
    return {variant for _, _, variant in results.surface.shares.hits}


def _mode_counts(shown: Comparison, names: Sequence[str]) -> str:
    trials = number(shown.medians[names[0]]["trials"])
    counts = listing([f"{name} {number(shown.medians[name]['mode_found'])}" for name in names])
    return f"mode found, of {trials} records: {counts}"


def _errors(shown: Comparison, names: Sequence[str]) -> str:
    return listing([f"{name} {_percent(shown.scores[name].response_error)}" for name in names])


def _fits(shown: Comparison, names: Sequence[str]) -> str:
    fits = [(name, shown.scores[name].fit_percent) for name in names]
    return listing(
        [f"{name} {number(fit)} %" if np.isfinite(fit) else f"{name} runs away" for name, fit in fits]
    )


def _percent(share: float) -> str:
    return f"{number(100 * share)} %"


def _span(values: Sequence[int]) -> str:
    return f"{min(values)}" if min(values) == max(values) else f"{min(values)} to {max(values)}"
