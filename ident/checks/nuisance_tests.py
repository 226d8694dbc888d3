"""Whether the data ask for a nuisance: an unknown initial state, an offset.

Likelihood ratio Ne ln(J without / J with) against its chi-square quantile, one degree of freedom per column;
Ne is the number of independent samples the residual is worth (`effective_samples`), so that slow disturbances
do not pass for initial states.

J with the nuisance takes a descent of the poles. Where the statistic is far from its limit the first step of
that descent says enough (Rao's score test, which is the likelihood ratio to second order): J - g^T H^-1 g on
the linearisation with the nuisance columns, at the poles found without them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ident.basis.poles import Poles
from ident.finding import Finding, FindingKind, finding
from ident.fit.least_squares import Regression
from ident.fit.refinement import Bounds, Refined, free_optimality

# A nuisance left to the data stays if dropping it would be this improbable for records that do not need it.
NUISANCE_LEVEL = 0.99
# A score below this part of the limit, every sample counted as independent, leaves the descent out.
_CLEARLY_BELOW = 0.6


@dataclass(frozen=True)
class NuisanceTest:
    """Verdict of the data on one nuisance of so many columns."""

    name: str
    columns: int
    statistic: float

    @property
    def limit(self) -> float:
        return float(chdtri(self.columns, 1 - NUISANCE_LEVEL))

    @property
    def needed(self) -> bool:
        return self.statistic > self.limit

    @property
    def finding(self) -> Finding:
        return finding(
            FindingKind.NUISANCE,
            name=self.name,
            needed=self.needed,
            columns=self.columns,
            statistic=self.statistic,
            limit=self.limit,
            level=NUISANCE_LEVEL,
        )


def nuisance_test(
    name: str,
    without: tuple[Regression, Refined],
    with_it: tuple[Regression, Refined],
    worth: float | None = None,
) -> NuisanceTest:
    """Likelihood ratio of two optima; `worth` of the residual with the nuisance, if it is known."""
    data, end = with_it
    if worth is None:
        worth = data.colour(data.residual(end.poles)).effective_samples
    ratio = max(without[1].rss, 1e-300) / max(end.rss, 1e-300)
    return NuisanceTest(name, _columns(without, data), float(worth * np.log(ratio)))


def clearly_left_out(
    name: str,
    without: tuple[Regression, Refined],
    with_it: Regression,
    bounds: Bounds,
    fixed: Poles,
    worth: float,
) -> NuisanceTest | None:
    """The score test if it leaves no doubt that the nuisance is not needed, else None: descend and compare.

    No doubt: well below the limit even if each of the N samples counted; `worth` of the residual without the
    nuisance, for the statistic that is shown.
    """
    end = without[1]
    here = with_it.linearise(*end.poles.writable())
    share = free_optimality(here, end.poles, bounds, fixed)
    promised = here.rss * (1 - share**2)
    gain = float(np.log(max(end.rss, 1e-300) / max(promised, 1e-300)))
    test = NuisanceTest(name, _columns(without, with_it), worth * gain)
    return test if with_it.n_samples * gain < _CLEARLY_BELOW * test.limit else None


def _columns(without: tuple[Regression, Refined], with_it: Regression) -> int:
    order = without[1].poles.order
    return with_it.n_parameters(order) - without[0].n_parameters(order)
