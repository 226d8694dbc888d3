"""What the prediction of logs that were not fitted says about a name, where evidence says "unknown".

Evidence asks whether a set of effects is all that is missing. Where simulation and sensors are exact and
something beyond the list is missing too, no set is, and all probability goes to "unknown", also that of an
effect which plainly makes the simulation better. Such an effect is there, or a cause acts like it.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from diagnosis.evidence.hypotheses import PRIORS

# Ratio of the RMS that an effect explains to what is left beside it at which it is as probably a stand-in for
# that as not: the best stand-in of five unlisted causes of labelled cases had .7, documented effects of
# measured and of made machines had .85 and more.
_STANDS_IN = 0.9
# Width of that, in natural logarithms: from .85 to .7 the probability falls from .45 to .30. Chosen.
_STANDS_IN_WIDTH = 0.3
# Prior probability that what acts like an effect of the list is one, not a cause beyond it.
_LISTED = PRIORS[0] / (PRIORS[0] + PRIORS[2])
# Share of an energy that is nothing.
_NOTHING = 1e-8


def presence_by_prediction(in_repairs: float, share: float, left: float) -> float:
    """Probability that an effect of the repair is there, from prediction alone.

    Parameters
    ----------
    in_repairs : float
        Share of the repairs that hold it, when logs are drawn anew (`repair.stability`).
    share : float
        Of the energy of the error, what the effect explains.
    left : float
        Of the energy of the error, what nothing explains.

    Returns
    -------
    float
        No more than the prior probability that what acts like an effect of the list is one: prediction cannot
        tell it from a cause beyond the list that acts alike.
    """
    ratio = float(np.sqrt(share / max(left, _NOTHING)))
    genuine = float(expit(np.log(max(ratio, _NOTHING) / _STANDS_IN) / _STANDS_IN_WIDTH))
    return in_repairs * min(genuine, _LISTED)
