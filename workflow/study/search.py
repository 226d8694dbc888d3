"""Which points are computed, batch by batch: the whole grid, or a search that learns from what it finds."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, Protocol

from workflow.engine.errors import InputError
from workflow.study.columns import COLUMNS
from workflow.study.points import Contradiction, Point, PointMaker
from workflow.study.rows import PointRow
from workflow.study.settings import Axis, StudyConfig, tidy


class Strategy(Protocol):
    """Batches of points; `learn` is told what became of a batch before the next is asked for."""

    @property
    def count(self) -> int:
        """Points in all."""

    def batches(self) -> Iterator[list[Point | Contradiction]]:
        """The points, in an order that does not depend on who computes them."""

    def learn(self, rows: Sequence[PointRow]) -> None:
        """Results of the last batch, in its order."""


class Grid:
    """All combinations, in one batch."""

    def __init__(self, maker: PointMaker) -> None:
        self._points = maker.grid()

    @property
    def count(self) -> int:
        return len(self._points)

    def batches(self) -> Iterator[list[Point | Contradiction]]:
        yield self._points

    def learn(self, rows: Sequence[PointRow]) -> None:
        pass


class ParzenSearch:
    """Optuna's tree-structured Parzen estimator over the axes, asked `batch` points at a time.

    A batch is asked for before any of its results is known, and told in the order it was asked: the points
    depend on seed and batch only. Points without a certificate count as infeasible; those without a
    controller teach nothing. A resumed search asks the same questions again and finds the answers there.

    Raises InputError when Optuna is not installed.
    """

    def __init__(self, study: StudyConfig, maker: PointMaker, seed: int) -> None:
        try:
            optuna: Any = import_module("optuna")
        except ImportError as error:
            raise InputError(
                "search.method = 'optuna' needs the extra 'optuna': pip install 'flexlink[optuna]'"
            ) from error
        self._optuna = optuna
        self._study, self._maker = study, maker
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        words = hashlib.sha256(f"search\0{seed}".encode()).digest()
        with warnings.catch_warnings(action="ignore"):  # Optuna announces which of its options are new
            sampler = optuna.samplers.TPESampler(
                seed=int.from_bytes(words[:4], "little"),
                n_startup_trials=study.search.startup_trials,
                multivariate=True,
                constant_liar=True,
                constraints_func=_violation,
            )
            self._search: Any = optuna.create_study(
                directions=[
                    "maximize" if COLUMNS[name].better == "larger" else "minimize"
                    for name in study.search.objectives
                ],
                sampler=sampler,
            )
        self._asked: list[Any] = []

    @property
    def count(self) -> int:
        return self._study.search.trials

    def batches(self) -> Iterator[list[Point | Contradiction]]:
        left = self.count
        while left > 0:
            size = min(left, self._study.search.batch)
            with warnings.catch_warnings(action="ignore"):
                self._asked = [self._search.ask() for _ in range(size)]
                values = [
                    {axis.key: _suggest(trial, axis) for axis in self._study.axes} for trial in self._asked
                ]
            yield [self._maker.make(one) for one in values]
            left -= size

    def learn(self, rows: Sequence[PointRow]) -> None:
        for trial, row in zip(self._asked, rows, strict=True):
            goals = [row.numbers.get(name) for name in self._study.search.objectives]
            trial.set_user_attr("violation", 0.0 if row.good else _excess(row.numbers))
            with warnings.catch_warnings(action="ignore"):
                if None in goals:
                    self._search.tell(trial, state=self._optuna.trial.TrialState.FAIL)
                else:
                    self._search.tell(trial, goals)


def _violation(trial: Any) -> tuple[float]:
    return (float(trial.user_attrs.get("violation", 1.0)),)


def _excess(numbers: Mapping[str, float | int | None]) -> float:
    """How far from certified, by the worst-case gamma where there is one; always above 0."""
    gamma = numbers.get("worst_gamma")
    return 1.0 if gamma is None else max(float(gamma) - 1.0, 1e-3)


def _suggest(trial: Any, axis: Axis) -> Any:
    if axis.values is not None:
        return axis.values[trial.suggest_categorical(axis.key, list(range(len(axis.values))))]
    if axis.whole:
        return trial.suggest_int(axis.key, axis.from_, axis.to, log=axis.log)
    return tidy(trial.suggest_float(axis.key, axis.from_, axis.to, log=axis.log))
