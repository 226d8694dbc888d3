"""What is the same in all experiments, whatever the input: drifts, offsets, disturbances tied to the start.

Inputs that resemble each other would leave alike residuals as well, so only experiments with different inputs
count. For a gap that comes from the input the mean over n such experiments holds about 1/n of the energy;
for one that comes with the clock it holds all.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from scipy.stats import chi2

from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import SENSORS, CommonFinding

_LEAST_EXPERIMENTS, _MOST_EXPERIMENTS = 4, 8
_LARGEST_CORRELATION = 0.5
_LEAST_SHARE = 0.5


def common_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[CommonFinding, ...]:
    """One per sensor; empty with fewer than four experiments whose inputs differ.

    Found asks for more energy in the mean than noise leaves there (chi-square, exact), for half of the gap,
    and that no other choice of signs of the experiments gives as much.
    """
    chosen = _different(case)
    if len(chosen) < _LEAST_EXPERIMENTS:
        return ()
    length = min(x.voltage_V.size for x in chosen)
    e = np.stack([residuals[x.name][:length] for x in chosen])  # (n, T, 2)
    n, dt = len(chosen), case.rig.sampling.dt_s
    # The first sign is fixed: turning all of them changes nothing.
    signs = np.array([(1.0, *rest) for rest in product((1.0, -1.0), repeat=n - 1)])
    found = []
    for s, sensor in enumerate(SENSORS):
        # Energy of the mean, over all choices of signs, from the products of the experiments.
        products = e[:, :, s] @ e[:, :, s].T
        energy = np.einsum("ki,ij,kj->k", signs, products, signs) / n
        gap = float(np.trace(products)) - n * length
        p_value = float(chi2.sf(energy[0], length))
        beyond_noise = gap > 3 * np.sqrt(2.0 * n * length)
        share = (energy - length) / gap if beyond_noise else np.zeros(energy.size)
        chance = float(np.max(share[1:]))
        yes = bool(
            p_value < level / len(SENSORS) and share[0] >= _LEAST_SHARE and share[0] > max(chance, 0.0)
        )
        peak_Hz, peak_share = _peak(e[:, :, s].mean(axis=0), dt)
        found.append(
            CommonFinding(sensor, n, float(share[0]), max(chance, 0.0), peak_Hz, peak_share, p_value, yes)
        )
    return tuple(found)


def _different(case: Case) -> list[Experiment]:
    """Experiments whose voltages hardly resemble each other, longest first."""
    chosen: list[Experiment] = []
    for x in sorted(case.experiments, key=lambda x: -x.voltage_V.size):
        alike = (_correlation(x.voltage_V, other.voltage_V) for other in chosen)
        if all(abs(c) < _LARGEST_CORRELATION for c in alike):
            chosen.append(x)
    return chosen[:_MOST_EXPERIMENTS]


def _correlation(a: Real, b: Real) -> float:
    """Cosine of two voltages over their common length; resting inputs resemble each other."""
    length = min(a.size, b.size)
    a, b = a[:length], b[:length]
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else 1.0


def _peak(mean: Real, dt_s: float) -> tuple[float, float]:
    """Frequency of the strongest line and the share of the whole energy within one line of it.

    Offset and the two slowest lines are left out: drifts lie there, and the swing into a disturbance.
    """
    power = np.abs(np.fft.rfft(mean)) ** 2
    power[1:] *= 2.0  # both signs of a frequency; an offset has one
    top = int(np.argmax(power[3:])) + 3
    return float(top / (mean.size * dt_s)), float(power[top - 1 : top + 2].sum() / power.sum())
