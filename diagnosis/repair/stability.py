"""How surely an effect belongs to the repair, had the logs been others of the same kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from diagnosis.fit.coordinates import MONTE_CARLO_DRAWS
from diagnosis.repair.repair import Trial


def share_of_repairs(trials: Sequence[Trial[Any]]) -> dict[str, float]:
    """For every effect the share of the repairs that hold it, when blocks of the logs are drawn anew.

    0 to 1: an effect without which the logs are predicted notably worse has 1 whatever is drawn; two that
    take each other's place share it.

    Parameters
    ----------
    trials : sequence of Trial
        At least one set of effects, each with its errors in the same blocks (`PredictionError.energy`, (B,)
        with B of two or more).
    """
    shares = dict.fromkeys((name for trial in trials for name in trial.names), 0.0)
    for names, share in shares_of_sets(trials).items():
        for name in names:
            shares[name] += share
    return shares


def shares_of_sets(trials: Sequence[Trial[Any]]) -> dict[tuple[str, ...], float]:
    """For every set of effects the share of the repairs that are this set, when blocks of the logs are drawn
    anew.

    Parameters
    ----------
    trials : sequence of Trial
        Sets of effects with their errors in the same blocks.

    Returns
    -------
    dict
        Sorted names -> 0 to 1, summing to one.

    Notes
    -----
    Bayesian bootstrap (Rubin, Ann. Statist. 9, 1981) over blocks. In every draw the smallest set is taken
    that is within one standard error of the best, the better one of two that are equally small. The repair
    itself (`Repairs.best`) prefers named effects besides, and none where it predicts worse than the nominal
    model: these shares do not, since the names are made from them.
    """
    energies = np.array([trial.error.energy for trial in trials])
    blocks = energies.shape[1]
    weights = blocks * np.random.default_rng(0).dirichlet(np.ones(blocks), MONTE_CARLO_DRAWS)
    totals = energies @ weights.T
    sizes = np.array([len(trial.names) for trial in trials])
    shares = {trial.explanation.sorted_names: 0.0 for trial in trials}
    for total in totals.T:
        best = int(np.argmin(total))
        differences = energies - energies[best]
        standard_errors = np.sqrt(blocks) * np.std(differences, axis=1, ddof=1)
        as_good = [int(k) for k in np.flatnonzero(total - total[best] <= standard_errors)]
        chosen = min(as_good, key=lambda k: (sizes[k], total[k]))
        shares[trials[chosen].explanation.sorted_names] += 1 / MONTE_CARLO_DRAWS
    return shares
