"""What the run found, figure by figure, in sentences made from its numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from validation.paper.bounds import TWO_SIGMA_LEVEL, Coverage
from validation.paper.experiments import RECIPE_BUDGET, Comparison, PaperResults
from validation.paper.methods import BETTER_STARTS, JUDGED_BAND_RAD_S, METHODS
from validation.paper.surface import minima_along, slices
from workflow.report.formats import listing, number

# A response is matched where its RMS error stays below this; a fit is good within these points of the best.
_MATCHED = 0.1
_CLOSE_TO_BEST = 10.0
_BAND = f"between {JUDGED_BAND_RAD_S[0]:.0f} and {JUDGED_BAND_RAD_S[1]:.0f} rad/s"


@dataclass(frozen=True)
class Finding:
    """Whether the run agrees with what the paper reports, by medians and majorities, and what it found."""

    agrees: bool
    headline: str
    sentences: tuple[str, ...]


def findings_of(results: PaperResults) -> tuple[Finding, ...]:
    """One per figure."""
    makers: Sequence[Callable[[PaperResults], Finding]] = (_one, _two, _three, _four, _five, _six, _seven)
    return tuple(make(results) for make in makers)


def _one(results: PaperResults) -> Finding:
    study, shares = results.surface, results.surface.shares
    coarsest, finest = study.counts[0], study.counts[-1]
    drawn = study.surface.first.size
    elsewhere = study.descended - study.reached
    inside = _span([item.inside for item in study.counts])
    several = finest.inside > 1
    # The border of the window: what a reader of the paper's picture sees in front.
    ((cut, along),) = slices(study.surface, [float(study.surface.second[0])])
    by_variant = [
        100 * shares.hits["order 4", coordinates, variant] / shares.searches
        for coordinates in ("raw", "log")
        for variant in sorted(_variants(results))
    ]
    half = len(by_variant) // 2
    return Finding(
        several,
        f"{finest.inside} minima inside the window"
        if several
        else "one minimum inside the window, not several",
        (
            f"Minima inside the paper's window: {inside}, on grids of {coarsest.n_points} to "
            f"{finest.n_points} points per axis. The lowest points at its border are {coarsest.border} on "
            f"the coarsest grid and {finest.border} on the finest: side valleys that run on out of the "
            f"window. The cut at gamma = {cut:.4f} has {minima_along(along)} local minima along beta.",
            f"Followed downhill, with the window no longer in the way, {study.reached} of the "
            f"{study.descended} border points of the {drawn}-point grid end in the global minimum and "
            f"{elsewhere} elsewhere.",
            f"At order 4 the {half} DIRECT variants, {shares.evaluations} evaluations and one descent from "
            f"the best point, end in the global minimum in {_share(results, 'order 4', 'raw')} of the "
            f"searches in (x, beta, gamma) and in {_share(results, 'order 4', 'log')} in logarithmic "
            f"coordinates; single variants range over {_range_words(by_variant[:half])} and "
            f"{_range_words(by_variant[half:])}. At order 2 the shares are "
            f"{_share(results, 'order 2', 'raw')} and {_share(results, 'order 2', 'log')} "
            f"({shares.searches} records each).",
        ),
    )


def _two(results: PaperResults) -> Finding:
    shown, recipe = results.simulation, results.recipe_score
    own, many = shown.scores["GOBF"], shown.medians["GOBF"]
    matched = _usually(shown, "GOBF") and many["response_error"] < _MATCHED
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
            f"{_BAND} (median of {number(many['trials'])} records {_percent(many['response_error'])}, mode "
            f"found in {number(many['mode_found'])}).",
            "The search as printed, DIRECT alone in the raw box with "
            f"{RECIPE_BUDGET * results.settings.evaluations} evaluations, {found} on this record: "
            f"{_percent(recipe.response_error)} RMS. The paper does not say how long it searched, nor from "
            "which bounds.",
            "Near half the sampling rate the curves part: the held input puts a zero there that 30 dB "
            "cannot show.",
        ),
    )


def _three(results: PaperResults) -> Finding:
    shown = results.simulation
    peers = METHODS[1:]
    found = [name for name in peers if _usually(shown, name)]
    return Finding(
        not found,
        f"the mode is usually found by {listing(found)}"
        if found
        else "none of the three usually finds the mode",
        (
            f"{_mode_counts(shown, peers)} RMS error {_BAND} on the drawn record: {_errors(shown, peers)}; "
            f"GOBF {_percent(shown.scores['GOBF'].response_error)}.",
            "The same structures from a better start, Steiglitz-McBride, on the same noise: "
            f"{_errors(shown, BETTER_STARTS)}. {_mode_counts(shown, BETTER_STARTS)}",
            "ARX has no start to choose; under white output noise its noise model is wrong, and it is "
            "biased.",
        ),
    )


def _four(results: PaperResults) -> Finding:
    shown = results.experiment
    found = [name for name in METHODS if _usually(shown, name)]
    return Finding(
        set(found) == {"GOBF", "OE"},
        f"the resonance is usually found by {listing(found)}"
        if found
        else "nobody usually finds the resonance",
        (
            f"The arm's first mode lies at {number(shown.machine.mode[0])} rad/s with damping "
            f"{number(shown.machine.mode[1])}: the motor's back-EMF damps it. "
            f"{_mode_counts(shown, METHODS)} RMS error against the linear arm on the drawn record: "
            f"{_errors(shown, METHODS)}.",
            f"From a better start: {_errors(shown, BETTER_STARTS)}. {_mode_counts(shown, BETTER_STARTS)} "
            "The paper's OE did find the resonance of its machine, whose damping and noise it does not "
            "give.",
            "The second mode is out of reach of order 4 for every method.",
        ),
    )


def _five(results: PaperResults) -> Finding:
    shown = results.experiment
    own, many = shown.scores["GOBF"].fit_percent, shown.medians["GOBF"]
    residual = shown.trial.fresh.output[:, 0] - shown.simulated["GOBF"]
    power = np.abs(np.fft.rfft(residual)) ** 2
    slow = np.fft.rfftfreq(residual.size, shown.trial.fresh.dt_s) < 1.0
    return Finding(
        many["fit_percent"] >= shown.median_ceiling_percent - _CLOSE_TO_BEST,
        f"median fit {number(many['fit_percent'])} %, of {number(shown.median_ceiling_percent)} % that the "
        "sensor noise leaves",
        (
            f"Free run from rest on fresh data, nothing taken out: fit {number(own)} % (median of "
            f"{number(many['trials'])} records {number(many['fit_percent'])} %); the true tip without noise "
            f"would reach {number(shown.ceiling_percent)} %.",
            f"{_percent(float(power[slow].sum() / power.sum()))} of the power of what is left lies below 1 "
            "Hz: the tip integrates whatever dry friction does.",
        ),
    )


def _six(results: PaperResults) -> Finding:
    shown = results.experiment
    peers = METHODS[1:]
    own = shown.medians["GOBF"]["fit_percent"]
    adequate = [name for name in peers if shown.medians[name]["fit_percent"] >= own - _CLOSE_TO_BEST]
    return Finding(
        not adequate,
        "median fits " + listing([_median_fit(shown, name) for name in METHODS]),
        (
            f"Fit on the fresh data drawn: {_fits(shown, peers)}; medians over "
            f"{number(shown.medians['GOBF']['trials'])} records "
            + listing([_median_fit(shown, name) for name in METHODS])
            + (
                f". Within {number(_CLOSE_TO_BEST)} points of GOBF: {listing(adequate)}." if adequate else "."
            ),
            f"From a better start: {_fits(shown, BETTER_STARTS)}. The fit of a free run is won at low "
            "frequency, where the tip moves most: a model without the mode can still score well, so Fig. 4 "
            "says more.",
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
            f"the frequencies {_BAND} (classical) and {number(study.inside_percent['tangent'][0])} % "
            "(tangent); an honest bound of two standard deviations holds it at "
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
        "No bound from one record can hold the linear arm when dry friction moves the response itself: "
        f"over the {with_friction.records} records the mean of all tangent models is "
        f"{number(with_friction.offset_percent)} % off the linear arm, with bounds of "
        f"{number(with_friction.radius_percent)} %; without friction {number(without.offset_percent)} % "
        f"off, with bounds of {number(without.radius_percent)} %. Records at several amplitudes show this "
        "part of the uncertainty (ident.uncertainty.conditions)."
    )


def _variants(results: PaperResults) -> set[str]:
    return {variant for _, _, variant in results.surface.shares.hits}


def _mode_counts(shown: Comparison, names: Sequence[str]) -> str:
    trials = number(shown.medians[names[0]]["trials"])
    counts = listing([f"{number(shown.medians[name]['mode_found'])} for {name}" for name in names])
    return f"Mode found, of {trials} records: {counts}."


def _usually(shown: Comparison, name: str) -> bool:
    """In more than half of the records: one draw is luck."""
    return shown.medians[name]["mode_found"] > shown.medians[name]["trials"] / 2


def _median_fit(shown: Comparison, name: str) -> str:
    fit = shown.medians[name]["fit_percent"]
    return f"{name} {number(fit)} %" if np.isfinite(fit) else f"{name} runs away"


def _share(results: PaperResults, problem: str, coordinates: str) -> str:
    return f"{number(results.surface.shares.share_percent(problem, coordinates))} %"


def _range_words(values: Sequence[float]) -> str:
    return f"{number(min(values))} to {number(max(values))} %"


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
