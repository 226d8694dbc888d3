"""The four methods of the paper at order 4 on one record, and the same measures for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.comparators.polynomial_fits import armax, arx, oe
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.one_input import identify
from validation.paper.machines import PaperMachine, Trial
from validation.paper.settings import N_PAIRS, N_REAL, ORDER
from validation.paper.usual_starts import usual_oe

# Methods that the paper compares.
METHODS = ("GOBF", "ARX", "ARMAX", "OE")
# Not the paper's: how the two iterative methods do from a Steiglitz-McBride start as well.
BETTER_STARTS = ("ARMAX (better start)", "OE (better start)")

# Where the response is judged: above the record's length and below the second mode, the band of control.
JUDGED_BAND_RAD_S = (1.0, 100.0)


class LinearModel(Protocol):
    """What GobfModel and the models of the comparators share."""

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray: ...
    def simulate(self, u: RealArray) -> RealArray: ...
    @property
    def poles(self) -> Any: ...


def gobf_options() -> IdentOptions:
    """Order 4 with no knowledge of the poles: the box comes from record length and sampling time alone."""
    return IdentOptions(n_real=N_REAL, n_pairs=N_PAIRS)


def fit_methods(record: Record) -> dict[str, LinearModel]:
    """METHODS and BETTER_STARTS at order 4: delay of one sample, nothing known of the poles."""
    # An unstable ARX model, tried as a start, can leave the range of doubles; the search then drops it.
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            "GOBF": identify([record], gobf_options()).model,
            "ARX": arx(record, ORDER, ORDER),
            "ARMAX": armax(record, ORDER, ORDER, ORDER, output_error_start=False),
            "OE": usual_oe(record, ORDER, ORDER),
            BETTER_STARTS[0]: armax(record, ORDER, ORDER, ORDER),
            BETTER_STARTS[1]: oe(record, ORDER, ORDER),
        }


def poles_of(model: LinearModel) -> ComplexArray:
    """Poles (n,) in the z plane."""
    poles: ComplexArray = model.poles.values if isinstance(model, GobfModel) else model.poles
    return poles


def pairs_of(model: LinearModel, dt_s: float) -> RealArray:
    """(P, 2): omega [rad/s] and damping ratio of every complex pair; negative damping is unstable."""
    poles = poles_of(model)
    is_upper = poles.imag > 1e-9
    log = np.log(poles[is_upper])
    return np.column_stack([np.abs(log) / dt_s, -log.real / np.abs(log)])


@dataclass(frozen=True)
class Score:
    """One model against the machine it was identified from.

    response_error: RMS of |G_hat - G| / |G| over the judged band; fit_percent: free run from rest on the
    fresh record, 100 (1 - |y - y_hat| / |y - mean y|); mode: the pair nearest to the true mode (omega, zeta),
    None without any; mode_found: it is within 10 % of the frequency and a factor 2 of the damping; unstable:
    a pole outside the unit circle.
    """

    response_error: float
    fit_percent: float
    mode: tuple[float, float] | None
    mode_found: bool
    unstable: bool


def score(machine: PaperMachine, trial: Trial, model: LinearModel, omega_rad_s: RealArray) -> Score:
    """The measures for one model; omega (F,) covers the judged band."""
    low, high = JUDGED_BAND_RAD_S
    is_judged = (omega_rad_s >= low) & (omega_rad_s <= high)
    inside = omega_rad_s[is_judged]
    truth = machine.response(inside)
    error = np.abs(model.frequency_response(inside) - truth) / np.abs(truth)
    pairs = pairs_of(model, trial.fitted.dt_s)
    mode = None
    if pairs.size:
        nearest = pairs[np.argmin(np.abs(np.log(pairs[:, 0] / machine.mode[0])))]
        mode = float(nearest[0]), float(nearest[1])
    return Score(
        response_error=float(np.sqrt(np.mean(error**2))),
        fit_percent=fit_percent(trial.fresh.output[:, 0], free_run(model, trial.fresh)),
        mode=mode,
        mode_found=mode is not None and is_mode(mode, machine.mode),
        unstable=bool(np.any(np.abs(poles_of(model)) > 1.0)),
    )


def is_mode(found: tuple[float, float], true: tuple[float, float]) -> bool:
    """Within 10 % in frequency and a factor 2 in damping."""
    return abs(found[0] / true[0] - 1) <= 0.1 and 0.5 <= found[1] / true[1] <= 2.0


def free_run(model: LinearModel, record: Record) -> RealArray:
    """Simulated output (T,) from rest; an unstable model may reach infinity, which is an answer too."""
    with np.errstate(over="ignore", invalid="ignore"):
        return model.simulate(record.input[:, 0])


def fit_percent(measured: RealArray, simulated: RealArray) -> float:
    """100 (1 - |y - y_hat| / |y - mean y|); minus infinity for a run that left the numbers."""
    if not np.all(np.abs(simulated) < 1e150):
        return -np.inf
    spread = np.linalg.norm(measured - measured.mean())
    return float(100 * (1 - np.linalg.norm(measured - simulated) / spread))


def median_scores(scores: Mapping[str, list[Score]]) -> dict[str, dict[str, float]]:
    """Medians over the trials, and how often the mode was found and a model was unstable."""
    return {
        name: {
            "trials": float(len(found)),
            "mode_found": float(sum(item.mode_found for item in found)),
            "unstable": float(sum(item.unstable for item in found)),
            "response_error": float(np.median([item.response_error for item in found])),
            "fit_percent": float(np.median([item.fit_percent for item in found])),
        }
        for name, found in scores.items()
    }
