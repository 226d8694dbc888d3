"""The numbers of a run as rows: what the paper prints, where, and what we find; as CSV.

Which rows there are stands in `validation/templates/paper_rows.j2`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
from markupsafe import Markup

from validation.paper.experiments import PaperResults
from validation.paper.machines import NOISE_STD, SNR_DB
from validation.paper.methods import BETTER_STARTS, JUDGED_BAND_RAD_S, METHODS
from validation.paper.quotes import REPORTED
from workflow.text.templates import environment


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
    """Rows of the table, figure by figure."""
    rows: list[Row] = []

    def row(figure: int, quantity: str, value: float, unit: str = "", paper: str = "not printed") -> str:
        plain_text = Markup(quantity).unescape()
        rows.append(Row(figure, plain_text, paper, REPORTED[figure - 1].place, float(value), unit))
        return ""

    environment(package="validation").get_template("paper_rows.j2").render(
        results=results,
        row=row,
        methods=METHODS,
        better=BETTER_STARTS,
        band=JUDGED_BAND_RAD_S,
        noise_std=NOISE_STD,
        snr_db=SNR_DB,
        unknown=(math.nan, math.nan),
    )
    return tuple(rows)


def csv_text(rows: Sequence[Row]) -> str:
    """One header line; the paper's words are quoted where they hold commas."""
    return str(pd.DataFrame(rows).to_csv(index=False, float_format="%.9g", lineterminator="\n"))
