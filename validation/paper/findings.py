"""Which figures come out as the paper reports, and the few numbers in the page's sentences that no result
holds as such. The sentences stand in `validation/templates`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validation.paper.experiments import Comparison, PaperResults
from validation.paper.methods import METHODS
from validation.paper.surface import minima_along, slices

# A response is matched where its RMS error stays below this; a fit is good within these points of the best.
_MATCHED = 0.1
# Points of fit by which a model may be worse than the best and still count as adequate.
CLOSE_TO_BEST = 10.0
# Methods that GOBF is compared with.
PEERS = METHODS[1:]


@dataclass(frozen=True)
class Findings:
    """What the run found beside its results.

    agrees: by number of the figure, whether medians and majorities are as the paper reports
    usually: methods that find the mode in more than half of the records, by machine
    border_cut: gamma of the window's border, and the local minima of the cost along beta there
    searches_percent: least and largest share of one DIRECT variant at order 4, by coordinates
    slow_share: of the power of the residual on fresh data, what lies below 1 Hz
    adequate: peers whose median fit comes within `CLOSE_TO_BEST` points of GOBF's
    radius_low, radius_high: median radius of the classical bound over |G|, 1 to 10 and above 100 rad/s
    """

    agrees: dict[int, bool]
    usually: dict[str, tuple[str, ...]]
    border_cut: tuple[float, int]
    searches_percent: dict[str, tuple[float, float]]
    slow_share: float
    adequate: tuple[str, ...]
    radius_low: float
    radius_high: float


def findings_of(results: PaperResults) -> Findings:
    """One draw is luck: figures are judged by medians and majorities over the records."""
    simulation = results.simulation
    experiment = results.experiment
    ((gamma, along),) = slices(results.surface.surface, [float(results.surface.surface.second[0])])
    fresh = experiment.trial.fresh
    residual = fresh.output[:, 0] - experiment.simulated["GOBF"]
    power = np.abs(np.fft.rfft(residual)) ** 2
    slow = np.fft.rfftfreq(residual.size, fresh.dt_s) < 1.0
    fits = {name: many["fit_percent"] for name, many in experiment.medians.items()}
    adequate = tuple(name for name in PEERS if fits[name] >= fits["GOBF"] - CLOSE_TO_BEST)
    bounds = results.bounds
    radius = bounds.bounds["classical"].ellipse().semi_major / np.abs(bounds.truth)
    in_low_decade = (bounds.omega_rad_s >= 1) & (bounds.omega_rad_s <= 10)
    is_high = bounds.omega_rad_s >= 100
    low = float(np.median(radius[in_low_decade]))
    high = float(np.median(radius[is_high]))
    usually = {"simulation": _usually(simulation), "experiment": _usually(experiment)}
    return Findings(
        agrees={
            1: results.surface.counts[-1].inside > 1,
            2: "GOBF" in usually["simulation"] and simulation.medians["GOBF"]["response_error"] < _MATCHED,
            3: not set(PEERS) & set(usually["simulation"]),
            4: set(usually["experiment"]) == {"GOBF", "OE"},
            5: fits["GOBF"] >= experiment.median_ceiling_percent - CLOSE_TO_BEST,
            6: not adequate,
            7: high > low,
        },
        usually=usually,
        border_cut=(gamma, minima_along(along)),
        searches_percent={name: _range(results, name) for name in ("raw", "log")},
        slow_share=float(power[slow].sum() / power.sum()),
        adequate=adequate,
        radius_low=low,
        radius_high=high,
    )


def _usually(shown: Comparison) -> tuple[str, ...]:
    return tuple(
        name for name in METHODS if shown.medians[name]["mode_found"] > shown.medians[name]["trials"] / 2
    )


def _range(results: PaperResults, coordinates: str) -> tuple[float, float]:
    shares = results.surface.shares
    percent = [
        100 * hits / shares.searches
        for (problem, searched, _), hits in shares.hits.items()
        if (problem, searched) == ("order 4", coordinates)
    ]
    return min(percent), max(percent)
