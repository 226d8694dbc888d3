"""The numbers of a run as rows: what the paper prints, where, and what we find; as CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from validation.paper.experiments import Comparison, PaperResults
from validation.paper.machines import NOISE_STD, SNR_DB
from validation.paper.methods import BETTER_STARTS, JUDGED_BAND_RAD_S, METHODS
from validation.paper.quotes import REPORTED
from validation.paper.surface import COORDINATES

_NOT_PRINTED = "not printed"


@dataclass(frozen=True)
class Row:
    """One number of ours. `paper` is what the paper prints for it, `place` where."""

    figure: int
    quantity: str
    paper: str
    place: str
    value: float
    unit: str

    @property
    def ours(self) -> str:
        """The value as text, with its unit."""
        if not math.isfinite(self.value):
            return "runs away" if self.value < 0 else "not known"
        return f"{self.value:.3g} {self.unit}".rstrip()


def rows_of(results: PaperResults) -> tuple[Row, ...]:
    """All rows, figure by figure."""
    return (
        *_surface_rows(results),
        *_simulation_rows(results),
        *_method_rows(3, results.simulation, METHODS[1:]),
        *_method_rows(4, results.experiment, METHODS),
        *_run_rows(results),
        *_bound_rows(results),
    )


def _row(figure: int, quantity: str, value: float, unit: str = "", paper: str = _NOT_PRINTED) -> Row:
    return Row(figure, quantity, paper, REPORTED[figure - 1].place, float(value), unit)


def _surface_rows(results: PaperResults) -> list[Row]:
    study = results.surface
    rows = [
        _row(1, f"{words}, grid of {count.n_points} x {count.n_points}", getattr(count, kind), paper=paper)
        for words, kind, paper in (
            ("minima inside the window", "inside", "several (none counted)"),
            ("lowest points at the window's border", "border", _NOT_PRINTED),
        )
        for count in study.counts
    ]
    rows.append(_row(1, "border points followed downhill", study.descended))
    rows.append(_row(1, "of these, descents that end in the global minimum", study.reached))
    rows.append(_row(1, "J at the global minimum", study.mean_square_minimum, paper="about 0 (axis)"))
    for problem in ("order 2", "order 4"):
        for coordinates in COORDINATES:
            words = "(x, beta, gamma)" if coordinates == "raw" else "log decay, frequency, damping"
            share = study.shares.share_percent(problem, coordinates)
            rows.append(_row(1, f"DIRECT finds the global minimum, {problem}, {words}", share, "%"))
    return rows


def _simulation_rows(results: PaperResults) -> list[Row]:
    shown = results.simulation
    mode = shown.scores["GOBF"].mode or (math.nan, math.nan)
    clean_std = float(np.std(shown.trial.fitted.output[:, 0]))
    return [
        _row(2, "samples", shown.trial.fitted.n_samples, paper="1000"),
        _row(2, "standard deviation of the noise", NOISE_STD, "m", "0.004"),
        _row(2, "signal-to-noise ratio asked for", SNR_DB, "dB", "30 dB"),
        _row(2, "standard deviation of the measured output", clean_std, "m"),
        _row(2, "frequency of the mode, true", shown.machine.mode[0], "rad/s"),
        _row(2, "damping of the mode, true", shown.machine.mode[1]),
        _row(2, "frequency of the mode, GOBF", mode[0], "rad/s"),
        _row(2, "damping of the mode, GOBF", mode[1]),
        *_method_rows(2, shown, METHODS[:1]),
        _row(2, f"{_ERROR}, DIRECT alone in the raw box", 100 * results.recipe_score.response_error, "%"),
    ]


_LOW, _HIGH = JUDGED_BAND_RAD_S
_ERROR = f"RMS error of the response, {_LOW:.0f} to {_HIGH:.0f} rad/s"


def _method_rows(figure: int, shown: Comparison, names: Sequence[str]) -> list[Row]:
    """Drawn record and medians of each method; the better starts belong to the figures of the peers."""
    rows = []
    listed = [*names, *(name for name in BETTER_STARTS if figure != 2)]
    for name in listed:
        own, many = shown.scores[name], shown.medians[name]
        trials = f"of {many['trials']:.0f} records"
        rows += [
            _row(figure, f"{_ERROR}, {name}", 100 * own.response_error, "%"),
            _row(figure, f"{_ERROR}, {name}, median {trials}", 100 * many["response_error"], "%"),
            _row(figure, f"mode found, {name}", many["mode_found"], trials),
            _row(figure, f"unstable model, {name}", many["unstable"], trials),
        ]
    return rows


def _run_rows(results: PaperResults) -> list[Row]:
    shown = results.experiment
    fresh = shown.trial.fresh.output[:, 0]
    rows = [
        _row(5, "lowest tip position, fresh data", fresh.min(), "m", "about -0.15"),
        _row(5, "highest tip position, fresh data", fresh.max(), "m", "about 0.2"),
        _row(5, "fit that the noise leaves to a perfect model", shown.ceiling_percent, "%"),
        _row(5, "fit that the noise leaves to a perfect model, median", shown.median_ceiling_percent, "%"),
    ]
    for name in (*METHODS, *BETTER_STARTS):
        figure = 5 if name == "GOBF" else 6
        many = shown.medians[name]
        words = f"median of {many['trials']:.0f} records"
        rows.append(_row(figure, f"fit on fresh data, {name}", shown.scores[name].fit_percent, "%"))
        rows.append(_row(figure, f"fit on fresh data, {name}, {words}", many["fit_percent"], "%"))
    return rows


def _bound_rows(results: PaperResults) -> list[Row]:
    study = results.bounds
    rows = []
    for name, (band, everywhere) in study.inside_percent.items():
        rows.append(_row(7, f"truth inside 2 sigma, {_LOW:.0f} to {_HIGH:.0f} rad/s, {name}", band, "%"))
        rows.append(_row(7, f"truth inside 2 sigma, all frequencies drawn, {name}", everywhere, "%"))
    for item in study.coverage:
        where = f"{item.recipe}, {item.machine}"
        rows.append(
            _row(
                7, f"truth inside 2 sigma, mean of {item.records} records, {where}", item.inside_percent, "%"
            )
        )
        rows.append(_row(7, f"median 2-sigma radius over |G|, {where}", item.radius_percent, "%"))
        rows.append(_row(7, f"offset of the mean model over |G|, {where}", item.offset_percent, "%"))
    return rows


def csv_text(rows: Sequence[Row]) -> str:
    """One header line; the paper's words are quoted where they hold commas."""
    return str(pd.DataFrame(rows).to_csv(index=False, float_format="%.9g", lineterminator="\n"))
