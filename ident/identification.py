"""The result of an identification: model, residuals, order table, search, verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ident.basis.miso_model import MisoModel
from ident.basis.model import GobfModel
from ident.basis.structure import Structure
from ident.checks.prior_tests import PriorTest
from ident.data.arrays import RealArray, readonly_real
from ident.search.order_selection import OrderStep
from ident.search.search_trace import SearchTrace


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedRecords:
    """How well a model with poles fits the records it was made from.

    Attributes
    ----------
    structure : Structure
        What the fit assumed around the basis, after the data decided what was left to them.
    record_names : tuple of str
    residuals : tuple of (T - delay,) arrays
        Output minus fitted output (nuisances included) of each record, from sample `input_delay_samples` on.
    fit_percent : (K,) array
        100 (1 - |residual| / |y - mean y|) of each record.
    rss : float
        Residual sum of squares over all records.
    noise_std : float
        sqrt(rss / (N - number of unknowns)), in units of the output.
    tangent_optimality : float
        Share of the residual (0..1) in the tangent space of the poles that are free to move: 0 at an optimum.
    order_table : tuple of OrderStep
        Every structure that was tried, by order.
    n_fixed : (int, int)
        Numbers of real poles and pairs that were given (integrators counted); they come first of each type.
    verdicts : tuple of str
        One sentence for each question that was left to the data, and for each prior that they judged.
    prior_tests : tuple of PriorTest
        The same verdicts on priors with their numbers.
    search : SearchTrace
        Its warnings are those known when the search ended; `warnings` has them all.
    advise : callable
        Gives further warnings when they are first asked for: looking for them takes a good part of the time
        of a fit of low order.
    """

    structure: Structure
    record_names: tuple[str, ...]
    residuals: tuple[RealArray, ...]
    fit_percent: RealArray
    rss: float
    noise_std: float
    tangent_optimality: float
    order_table: tuple[OrderStep, ...]
    verdicts: tuple[str, ...]
    search: SearchTrace
    n_fixed: tuple[int, int] = (0, 0)
    prior_tests: tuple[PriorTest, ...] = ()
    advise: Callable[[], Sequence[str]] = field(default=tuple)

    def __post_init__(self) -> None:
        object.__setattr__(self, "residuals", tuple(readonly_real(item) for item in self.residuals))
        object.__setattr__(self, "fit_percent", readonly_real(self.fit_percent))
        if not len(self.residuals) == len(self.record_names) == self.fit_percent.size:
            raise ValueError("residuals, record_names and fit_percent must have one entry per record")
        if not (self.rss >= 0 and self.noise_std >= 0 and self.tangent_optimality >= 0):
            raise ValueError(
                "rss, noise_std and tangent_optimality must not be negative; got "
                f"{self.rss}, {self.noise_std}, {self.tangent_optimality}"
            )

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What to look at before trusting the model, one sentence each."""
        return tuple(dict.fromkeys((*self.search.warnings, *self.advise())))

    def to_arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Plain arrays, exact round trip through `from_arrays`."""
        structure = self.structure
        arrays: dict[str, np.ndarray[Any, Any]] = {
            "structure": np.array(
                [
                    structure.integrators,
                    structure.input_delay_samples,
                    structure.feedthrough,
                    structure.estimate_offset,
                    structure.estimate_initial_state,
                    structure.relative_degree,
                ],
                dtype=np.int64,
            ),
            "record_names": np.array(self.record_names, dtype=np.str_),
            "fit_percent": self.fit_percent,
            "rss": np.array(self.rss),
            "noise_std": np.array(self.noise_std),
            "tangent_optimality": np.array(self.tangent_optimality),
            "order_counts": np.array(
                [(s.n_real, s.n_pairs) for s in self.order_table], dtype=np.int64
            ).reshape(-1, 2),
            "order_values": np.array([(s.rss, s.criterion) for s in self.order_table]).reshape(-1, 2),
            "n_fixed": np.array(self.n_fixed, dtype=np.int64),
            "verdicts": np.array(self.verdicts, dtype=np.str_),
            "prior_texts": np.array([(t.prior, t.verdict) for t in self.prior_tests], dtype=np.str_).reshape(
                -1, 2
            ),
            "prior_values": np.array(
                [
                    (t.refused, t.imposed, t.statistic, t.limit, t.degrees_of_freedom)
                    for t in self.prior_tests
                ],
                dtype=np.float64,
            ).reshape(-1, 5),
        }
        arrays |= {f"residual{i}": residual for i, residual in enumerate(self.residuals)}
        search = replace(self.search, warnings=self.warnings)
        return arrays | {f"search_{key}": value for key, value in search.to_arrays().items()}

    @classmethod
    def _fields(cls, arrays: Mapping[str, np.ndarray[Any, Any]]) -> dict[str, Any]:
        """The fields of `to_arrays`, for the constructor."""
        integrators, delay, feedthrough, offset, initial_state, relative_degree = (
            int(item) for item in arrays["structure"]
        )
        names = tuple(str(item) for item in arrays["record_names"])
        steps = zip(arrays["order_counts"], arrays["order_values"], strict=True)
        priors = zip(arrays["prior_texts"], arrays["prior_values"], strict=True)
        return {
            "structure": Structure(
                integrators, delay, bool(feedthrough), bool(offset), bool(initial_state), relative_degree
            ),
            "record_names": names,
            "residuals": tuple(arrays[f"residual{i}"] for i in range(len(names))),
            "fit_percent": arrays["fit_percent"],
            **{name: float(arrays[name]) for name in ("rss", "noise_std", "tangent_optimality")},
            "order_table": tuple(
                OrderStep(int(n_real), int(n_pairs), float(rss), float(criterion))
                for (n_real, n_pairs), (rss, criterion) in steps
            ),
            "n_fixed": (int(arrays["n_fixed"][0]), int(arrays["n_fixed"][1])),
            "verdicts": tuple(str(item) for item in arrays["verdicts"]),
            "search": SearchTrace.from_arrays(_under("search_", arrays)),
            "prior_tests": tuple(
                PriorTest(
                    str(prior),
                    bool(refused),
                    bool(imposed),
                    float(value),
                    float(bound),
                    int(degrees),
                    str(verdict),
                )
                for (prior, verdict), (refused, imposed, value, bound, degrees) in priors
            ),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Identification(FittedRecords):
    """A fitted model of one input, and how well it fits."""

    model: GobfModel

    def to_arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Plain arrays, exact round trip through `from_arrays`."""
        return super().to_arrays() | {f"model_{key}": value for key, value in self.model.to_arrays().items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Self:
        """Inverse of `to_arrays`."""
        return cls(model=GobfModel.from_arrays(_under("model_", arrays)), **cls._fields(arrays))


@dataclass(frozen=True, eq=False, kw_only=True)
class MisoIdentification(FittedRecords):
    """A fitted model of several inputs with shared poles, and how well it fits; the criterion of its order
    table counts 1 + U numbers per pole."""

    model: MisoModel

    def to_arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Plain arrays, exact round trip through `from_arrays`."""
        return super().to_arrays() | {f"model_{key}": value for key, value in self.model.to_arrays().items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Self:
        """Inverse of `to_arrays`."""
        return cls(model=MisoModel.from_arrays(_under("model_", arrays)), **cls._fields(arrays))


def _under(prefix: str, arrays: Mapping[str, np.ndarray[Any, Any]]) -> dict[str, np.ndarray[Any, Any]]:
    return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
