"""Results of an identification: a model, and everything needed to judge it.

`FittedRecords` holds what all fits to records have; `Identification` adds a model of one input and one
output, `MimoIdentification` one of several. They are made by `ident.one_input` and `ident.several_outputs`,
stored in files, and shown in tables by `ident.data.shown`; nothing is computed here but the list of warnings.

Types of other files: `Structure`, integrators, delay, direct term and nuisances of a fit; `OrderStep`,
numbers of poles with their residual sum of squares; `SearchTrace`, what a search did; `Finding`, a kind and
its values; `PriorTest`, a verdict on one thing that was stated as known; `Record`, one experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ident.basis.autoregressive_noise import AutoregressiveNoise
from ident.basis.mimo_model import MimoModel
from ident.basis.model import GobfModel
from ident.basis.structure import Structure
from ident.data.arrays import RealArray, lock, readonly
from ident.data.finding import Finding, PriorTest, distinct
from ident.data.keywords import clear_constructor
from ident.data.record import Record
from ident.data.shown import NOT_STORED, Shown
from ident.search.order_selection import OrderStep
from ident.search.pole_search import SearchTrace


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FittedRecords(Shown):
    """How well a model with poles fits the K records it was made from.

    Attributes
    ----------
    structure : Structure
        Around the basis, after the data decided what was left to them.
    record_names : tuple of str
        K names.
    residuals : tuple of ndarray, shape (T - delay,) each
        Measured minus fitted output of each record, nuisances (offset, initial state) taken off.
    fit_percent : ndarray, shape (K,)
        100 (1 - |residual| / |y - mean y|).
    rss : float
        Residual sum of squares over all records.
    noise_std : float
        sqrt(rss / (N - unknowns)), output units.
    tangent_optimality : float
        Share of the residual (0 .. 1) in the tangent space of the free poles, 0 at an optimum.
    order_table : tuple of OrderStep
        Every structure tried.
    verdicts : tuple of Finding
        On each question that was left to the data and each prior.
    search : SearchTrace
        Global searches and descents.
    n_fixed : tuple of int
        Real poles and pairs that were given (integrators counted), first of each type.
    prior_tests : tuple of PriorTest
        Tests behind the verdicts on priors.
    noise_filter
        A(q) behind which everything was fitted; of white noise 1.
    advise : callable
        Further warnings, looked for when they are first asked for.
    records : tuple of Record
        What it was made from; not stored.
    order_given : bool
        Nobody left the order to the data; not stored.
    fit_s : float
        Seconds that the fit took, nan where nobody measured; not stored.

    Raises
    ------
    ValueError
        Not one residual, name and fit per record, or a sum is negative or nan; shapes of the residuals and
        lengths of the other fields are not checked.
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
    fit_s: float = field(default=np.nan, compare=False, metadata=NOT_STORED)

    def __post_init__(self) -> None:
        """Make arrays read-only; raise ValueError where numbers of records differ or sums are negative."""
        object.__setattr__(self, "residuals", tuple(readonly(item) for item in self.residuals))
        lock(self, "fit_percent", "noise_filter")
        n_records = len(self.record_names)
        if not len(self.residuals) == n_records == self.fit_percent.size:
            raise ValueError("residuals, record_names and fit_percent must have one entry per record")
        if not (self.rss >= 0 and self.noise_std >= 0 and self.tangent_optimality >= 0):
            raise ValueError(
                "rss, noise_std and tangent_optimality must not be negative; got "
                f"{self.rss}, {self.noise_std}, {self.tangent_optimality}"
            )

    @property
    def noise(self) -> AutoregressiveNoise:
        """Model of the noise behind which everything was fitted, of `noise_filter`.

        Raises ValueError where that is no vector of finite numbers that begins with 1.
        """
        return AutoregressiveNoise(self.noise_filter)

    @cached_property
    def warnings(self) -> tuple[Finding, ...]:
        """What to look at before trusting the model: warnings of the search, then advice; each once.

        Computed when first asked for: `advise` may raise what its checks of the records raise.
        """
        return distinct((*self.search.warnings, *self.advise()))


@clear_constructor
@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Identification(FittedRecords):
    """A fitted model of one input and one output, and how well it fits.

    Attributes
    ----------
    model : GobfModel
        The model: poles, coefficients, sampling time, integrators and delay.
    fit_percent : ndarray, shape (K,)
        Of each of the K records: 100 (1 - |residual| / |y - mean y|).
    residuals : tuple of ndarray, shape (T - delay,) each
        Measured minus fitted output of each record, offset and initial state taken off, in its unit.
    noise_std : float
        Standard deviation of the residuals, output units.
    rss : float
        Residual sum of squares over all records.
    structure : Structure
        Integrators, delay, direct term, offset and initial state, after the data decided what was left open.
    order_table : tuple of OrderStep
        Every structure that was tried, with its residual sum of squares.
    verdicts, prior_tests : tuple of Finding, tuple of PriorTest
        What the data say on each question that was left to them and on each thing that was stated as known.
    search, tangent_optimality : SearchTrace, float
        What the search for the poles did, and the share of the residual (0 to 1) that moving the poles could
        still take off to first order: 0 at an optimum.
    records, record_names : tuple of Record, tuple of str
        What it was made from; records are not stored in files.
    n_fixed : tuple of int
        Real poles and pairs that were given (integrators counted).
    noise_filter : ndarray
        A(q) of the noise model behind which everything was fitted; 1 for white noise.
    order_given : bool
        The order was stated, not chosen from the data.
    fit_s : float
        Seconds that the fit took, nan where nobody measured.
    advise : callable
        Further warnings, looked for when they are first asked for; `warnings` has them.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> found.model.poles.omega_rad_s(found.model.dt_s).round(1)
    array([20.])
    """

    model: GobfModel

    def to_control(self) -> Any:
        """The model as `control.StateSpace`; ImportError without python-control."""
        return self.model.to_control()

    def save(self, path: str | Path) -> None:
        """Write the model to a file (`GobfModel.save`); OSError where it cannot be written."""
        self.model.save(path)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MimoIdentification(FittedRecords):
    """A fitted model of several inputs and outputs with shared poles, and how well it fits.

    Residuals are (T - delay, Y), in units of the outputs. rss, noise_std and the order table are those of
    outputs that were whitened to noise of one.

    Attributes
    ----------
    model : MimoModel
        One `MisoModel` for each output, with poles in common.
    noise_covariance : ndarray, shape (Y, Y)
        Of the outputs' noise, in their units.
    output_fit_percent : ndarray, shape (K, Y)
        `fit_percent` by output.
    rank_one : tuple of bool
        Of each mode (of `MimoModel.residues`): the records let it have one shape; empty where every residue
        was left free.
    rank_one_test : float
        Probability that noise alone makes free residues fit so much better than the shapes.
    """

    model: MimoModel
    noise_covariance: RealArray
    output_fit_percent: RealArray
    rank_one: tuple[bool, ...] = ()
    rank_one_test: float = 1.0

    def to_control(self) -> Any:
        """The model as `control.StateSpace`; ImportError without python-control."""
        return self.model.to_control()
