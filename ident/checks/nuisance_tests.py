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

from ident.data.finding import Finding, FindingKind, finding
from ident.fit.least_squares import Regression
from ident.fit.refinement import free_optimality
from ident.search.pole_search import Fitted

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


def nuisance_test(name: str, without: Fitted, with_it: Fitted) -> NuisanceTest:
    """Likelihood ratio of two optima."""
    ratio = max(without.end.rss, 1e-300) / max(with_it.end.rss, 1e-300)
    return NuisanceTest(name, _columns(without, with_it.data), float(with_it.worth() * np.log(ratio)))


def clearly_left_out(name: str, without: Fitted, with_it: Regression) -> NuisanceTest | None:
    """The score test if it leaves no doubt that the nuisance is not needed, else None: descend and compare.

    No doubt: well below the limit even if each of the N samples counted. The statistic that is shown counts
    what the residual without the nuisance is worth.
    """
    poles, search = without.poles, without.search
    here = with_it.linearise(*poles.writable())
    share = free_optimality(here, poles, search.bounds, search.fixed)
    promised = here.rss * (1 - share**2)
    gain = float(np.log(max(without.end.rss, 1e-300) / max(promised, 1e-300)))
    test = NuisanceTest(name, _columns(without, with_it), without.worth() * gain)
    return test if with_it.n_samples * gain < _CLEARLY_BELOW * test.limit else None


def _columns(without: Fitted, with_it: Regression) -> int:
    order = without.poles.order
    return with_it.n_parameters(order) - without.data.n_parameters(order)
