"""Points chosen batch by batch, by a search that learns from what it finds."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from workflow.engine.errors import InputError
from workflow.study.columns import COLUMNS
from workflow.study.page import PointRow
from workflow.study.points import Contradiction, Point, PointMaker
from workflow.study.settings import Axis, StudyConfig, tidy

# Points of a batch -> their rows, in the same order.
Compute = Callable[[Sequence[Point | Contradiction]], list[PointRow]]


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

    def run(self, compute: Compute) -> list[PointRow]:
        """The rows of all points, in the order they were asked for."""
        options, rows = self._study.search, list[PointRow]()
        while len(rows) < options.trials:
            with warnings.catch_warnings(action="ignore"):
                asked = [self._search.ask() for _ in range(min(options.trials - len(rows), options.batch))]
                values = [{axis.key: _suggest(trial, axis) for axis in self._study.axes} for trial in asked]
            found = compute([self._maker.make(one) for one in values])
            for trial, row in zip(asked, found, strict=True):
                goals = [row.numbers.get(name) for name in options.objectives]
                trial.set_user_attr("violation", 0.0 if row.good else _excess(row.numbers))
                with warnings.catch_warnings(action="ignore"):
                    if None in goals:
                        self._search.tell(trial, state=self._optuna.trial.TrialState.FAIL)
                    else:
                        self._search.tell(trial, goals)
            rows += found
        return rows


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
