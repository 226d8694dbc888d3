"""The result of an identification: model, residuals, order table, search, verdicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ident.basis.mimo_model import MimoModel
from ident.basis.model import GobfModel
from ident.basis.structure import Structure
from ident.data.arrays import RealArray, lock, readonly
from ident.data.finding import Finding, PriorTest, distinct
from ident.data.record import Record
from ident.data.shown import NOT_STORED, Shown
from ident.search.order_selection import OrderStep
from ident.search.pole_search import SearchTrace


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FittedRecords(Shown):
    """How well a model with poles fits the K records it was made from.

    structure: around the basis, after the data decided what was left to them. residuals: (T - delay,) each,
    nuisances taken off. fit_percent (K,): 100 (1 - |residual| / |y - mean y|). rss; noise_std: sqrt(rss / (N
    - unknowns)), output units. tangent_optimality: share of the residual (0..1) in the tangent space of the
    free poles, 0 at an optimum. order_table: every structure tried. n_fixed: real poles and pairs that were
    given (integrators counted), first of each type. verdicts: on each question left to the data and each
    prior. noise_filter: A(q) behind which everything was fitted, [1.0] for white noise. advise: further
    warnings, looked for when they are first asked for. records: what it was made from; order_given: nobody
    left it to the data; neither is stored.
    """

    table_in_notebook = True

    structure: Structure
    record_names: tuple[str, ...]
    residuals: tuple[RealArray, ...]
    fit_percent: RealArray
    rss: float
    noise_std: float
    tangent_optimality: float
    order_table: tuple[OrderStep, ...]
    verdicts: tuple[Finding, ...]
    search: SearchTrace
    n_fixed: tuple[int, int] = (0, 0)
    prior_tests: tuple[PriorTest, ...] = ()
    noise_filter: RealArray = field(default_factory=lambda: np.ones(1))
    advise: Callable[[], Sequence[Finding]] = field(default=tuple)
    records: tuple[Record, ...] = field(default=(), compare=False, metadata=NOT_STORED)
    order_given: bool = field(default=False, compare=False, metadata=NOT_STORED)

    def __post_init__(self) -> None:
        object.__setattr__(self, "residuals", tuple(readonly(item) for item in self.residuals))
        lock(self, "fit_percent", "noise_filter")
        if not len(self.residuals) == len(self.record_names) == self.fit_percent.size:
            raise ValueError("residuals, record_names and fit_percent must have one entry per record")
        if not (self.rss >= 0 and self.noise_std >= 0 and self.tangent_optimality >= 0):
            raise ValueError(
                "rss, noise_std and tangent_optimality must not be negative; got "
                f"{self.rss}, {self.noise_std}, {self.tangent_optimality}"
            )

    @cached_property
    def warnings(self) -> tuple[Finding, ...]:
        """What to look at before trusting the model."""
        return distinct((*self.search.warnings, *self.advise()))


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Identification(FittedRecords):
    """A fitted model of one input, and how well it fits.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> found.model.poles.omega_rad_s(found.model.dt_s).round(1)
    array([20.])
    """

    model: GobfModel

    def to_control(self) -> Any:
        """The model as `control.StateSpace`."""
        return self.model.to_control()

    def save(self, path: str | Path) -> None:
        """Write the model as `GobfModel.save`."""
        self.model.save(path)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MimoIdentification(FittedRecords):
    """A fitted model of several inputs and outputs with shared poles, and how well it fits.

    Residuals (T - delay, Y), in units of the outputs. rss, noise_std and the order table are those of outputs
    made white, of noise one; noise_covariance (Y, Y) is that of the outputs' noise, output_fit_percent (K, Y)
    is `fit_percent` by output. rank_one: the modes (of `MimoModel.residues`) that the records let have one
    shape; rank_one_test: the chance that noise alone makes free residues fit so much better.
    """

    model: MimoModel
    noise_covariance: RealArray
    output_fit_percent: RealArray
    rank_one: tuple[bool, ...] = ()
    rank_one_test: float = 1.0

    def to_control(self) -> Any:
        """The model as `control.StateSpace`."""
        return self.model.to_control()
