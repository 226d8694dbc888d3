"""Logs taken in closed loop with a known reference: two-stage identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.one_input import identify
from ident.uncertainty.embedding import tangent

# A first stage that explains less of the input than this has gone wrong.
_EXPLAINED_PERCENT = 50.0


@dataclass(frozen=True, eq=False)
class TwoStage:
    """Open-loop records made from closed-loop ones, and how good the first stage is.

    records: as given, but with the noise-free input u_hat = S_hat r (the reference dropped: it has done its
    work); sensitivities: posterior of S, r -> u, one per record; fit_percent (per record) of u by u_hat.
    """

    records: tuple[Record, ...]
    sensitivities: tuple[ResponsePosterior, ...]
    fit_percent: tuple[float, ...]

    @property
    def finding(self) -> Finding:
        return finding(
            FindingKind.TWO_STAGE, least_percent=min(self.fit_percent), most_percent=max(self.fit_percent)
        )

    def warnings(self, omega_rad_s: RealArray) -> tuple[Finding, ...]:
        """What the ellipses of a second stage do not hold, in the median over omega (F,)."""
        explained = min(self.fit_percent)
        lost = finding(FindingKind.UNEXPLAINED_INPUT, explained_percent=explained)
        error = float(np.median(self.relative_error(omega_rad_s)))
        return (
            *([lost] if explained < _EXPLAINED_PERCENT else []),
            finding(FindingKind.FIRST_STAGE_ERROR, relative_std=error),
        )

    def relative_error(self, omega_rad_s: RealArray) -> RealArray:
        """(F,) standard deviation of S_hat over |S_hat|, RMS over the records.

        The bounds of a second stage do not see it: to first order the same relative error is in G.
        """
        total = np.zeros(np.shape(omega_rad_s))
        for sensitivity in self.sensitivities:
            estimate = sensitivity.at(omega_rad_s)
            variance = estimate.covariance[:, 0, 0] + estimate.covariance[:, 1, 1]
            total += variance / np.abs(estimate.centre) ** 2
        return np.asarray(np.sqrt(total / len(self.sensitivities)))


def two_stage(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    embedding: EmbeddingOptions | None = None,
) -> TwoStage:
    """Van den Hof and Schrama (Automatica 29(6), 1993): turn r -> u -> y into an open-loop problem.

    The sensitivity r -> u is identified first (direct term on, no integrators or delay, whatever `options`
    say about the plant), the records' inputs are replaced by its simulation from rest, which the noise does
    not touch. Each record gets its own sensitivity on common poles: the error of S_hat then differs between
    records and shows in their scatter, so `combine_posteriors` over the records accounts for it; no bound of
    a single second stage does (`relative_error`). Raises ValueError when a record has not exactly one
    reference and input.
    """
    plant_options = options or IdentOptions()
    stage = plant_options.model_copy(
        update={"feedthrough": True, "integrators": 0, "input_delay_samples": 0, "fixed_poles": ()}
    )
    closed = [_reference_to_input(record) for record in records]
    first = identify(closed, stage)
    sensitivities = [tangent([record], first.model, embedding) for record in closed]
    opened, fits = [], []
    for record, sensitivity in zip(records, sensitivities, strict=True):
        u, u_hat = record.input[:, 0], sensitivity.simulate(_reference(record))
        spread = float(np.linalg.norm(u - u.mean()))
        fits.append(100 * (1 - float(np.linalg.norm(u - u_hat)) / spread))
        opened.append(replace(record, input=u_hat[:, None], reference=None, reference_names=()))
    return TwoStage(tuple(opened), tuple(sensitivities), tuple(fits))


def _reference(record: Record) -> RealArray:
    if record.reference is None or record.reference.shape[1] != 1:
        raise ValueError(f"{record.label}: closed-loop identification needs exactly one reference column")
    if record.input.shape[1] != 1:
        raise ValueError(f"{record.label}: need one input; got {list(record.input_names)}")
    return record.reference[:, 0]


def _reference_to_input(record: Record) -> Record:
    reference = _reference(record)
    return Record(
        name=record.name,
        input=reference[:, None],
        output=record.input,
        dt_s=record.dt_s,
        input_names=record.reference_names,
        output_names=record.input_names,
        source=record.source,
    )
