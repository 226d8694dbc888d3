"""Noise alone raises a finding as often as its level says, for every axis of `where`."""

import numpy as np
import pytest
from scipy.stats import binom

from diagnosis.where.where import where
from tests.diagnosis.synthetic_residuals import made, white

LEVEL = 0.1
SEEDS = 100


def _alarms(found):
    return {
        "sensors": any(s.gap.found for s in found.sensors),
        "experiments": any(g.found for x in found.experiments for g in (x.gap, *x.sensors)),
        "bands": any(b.gap.found for b in found.bands),
        "regimes": any(r.found for r in found.regimes),
        "drift": any(d.found for d in found.drift),
        "common": any(c.found for c in found.common),
        "curves": any(c.found for c in found.curves),
        "periodic": any(v.found for p in found.periodic for v in (*p.bands, *p.groups)),
    }


# Axes whose tests cover their level; curves and periodic ask for more than chance and stay below.
REACHED = ("sensors", "experiments", "bands", "regimes", "drift")


@pytest.mark.long
def test_every_axis_keeps_its_level():
    count: dict[str, int] = {}
    for seed in range(SEEDS):
        rng = np.random.default_rng(1000 + seed)
        residuals = white(rng)
        for axis, alarm in _alarms(where(made(residuals), residuals, level=LEVEL, rng=rng)).items():
            count[axis] = count.get(axis, 0) + alarm
    # One in ten thousand for each axis and side; overlapping tests may use up half of their level.
    assert max(count.values()) <= binom.ppf(1 - 1e-4, SEEDS, LEVEL), count
    assert min(count[axis] for axis in REACHED) >= binom.ppf(1e-4, SEEDS, LEVEL / 2), count
