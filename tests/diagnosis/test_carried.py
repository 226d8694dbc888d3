"""Shares of a validation error: there are none where it is noise, and none beyond all of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.judge.carried import closed_by

NOISE = np.array([0.01, 0.02])
ROWS = 400


def _search():
    rng = np.random.default_rng(0)
    records = [
        PlantExperiment(name, role, np.ones((ROWS, 1)), rng.standard_normal((ROWS, 2)))
        for name, role in (("a", "estimation"), ("b", "held_out"))
    ]
    effect = PlantEffect("gain", (EffectParameter("ratio", 0.1, 1.0),))
    plant = Plant(lambda p, e, u: np.zeros((len(u), 2)), {}, {}, ("a_m", "b_m"), NOISE, (effect,), 0.05, 0.01)
    return SimpleNamespace(case=PlantCase("made", plant, tuple(records)))


def _leaves(size, seed=1):
    """A model that leaves an error of this RMS over the noise beside the noise."""
    rng = np.random.default_rng(seed)
    wave = size * np.sqrt(2) * np.sin(0.3 * np.arange(ROWS))[:, None]
    return SimpleNamespace(held_out_residuals=[NOISE * (rng.standard_normal((ROWS, 2)) + wave)])


@pytest.mark.parametrize(
    ("after", "before", "share"),
    [
        (0.0, 3.0, 1.0),
        (1.5, 3.0, 0.75),
        (3.0, 3.0, 0.0),
        # Twice the error is four times its energy: nothing is closed, however much more is left.
        (6.0, 3.0, -1.0),
        (1e6, 3.0, -1.0),
    ],
)
def test_a_share_of_an_error_is_of_its_energy(after, before, share):
    assert closed_by(_search(), _leaves(after), _leaves(before)) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("after", [0.0, 2.0])
def test_nothing_is_closed_where_nothing_is_open(seed, after):
    """Energies of noise beyond noise are about zero, of either sign: their quotient is any number."""
    assert closed_by(_search(), _leaves(after, 9), _leaves(0.0, seed)) == 0.0
