"""Cases and nominal parameters: what is refused, and what a deviation means."""

import numpy as np
import pytest

from diagnosis import Case, Experiment
from diagnosis.fit.nominal import NominalParameters
from plant import EFFECTS, paper_link

RNG = np.random.default_rng(5)


def _experiment(name="a", role="estimation", **changes):
    values = {"voltage_V": RNG.standard_normal(50), "output": RNG.standard_normal((50, 2))}
    return Experiment(name, role, **{**values, **changes})


def _case(*experiments, rig=None):
    return Case("arm", paper_link() if rig is None else rig, experiments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"output": np.zeros((50, 2))}, "dead"),
        ({"output": np.ones((49, 2))}, r"\(T, U\)"),
        ({"voltage_V": np.ones((50, 1))}, r"\(T,\)"),
        (
            {"reference_rad": np.zeros(49)},
            r"reference_rad must be finite and \(50,\) like voltage_V; got \(49,\)",
        ),
        ({"reference_rad": np.full(50, np.nan)}, "reference_rad must be finite"),
        ({"beside": {"load_kg": np.zeros(51)}}, r"load_kg must be finite and \(50,\)"),
        ({"beside": {"load_kg": np.full(50, np.inf)}}, "load_kg must be finite"),
        ({"missing": (3, 50)}, "row 50 is missing, but rows are 0 to 49"),
    ],
)
def test_experiments_that_cannot_be_used_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        _experiment(**changes)


def test_sensors_need_noise():
    silent = paper_link().perturbed({"sensors.tip_noise_m": 0.0})
    with pytest.raises(ValueError, match="noise"):
        _case(_experiment(), _experiment("b", "held_out"), rig=silent)


def test_a_stated_value_one_tolerance_too_high_means_a_lower_true_one():
    rig = paper_link().model_copy(update={"tolerances": {"hub.inertia_kg_m2": 0.05}})
    nominal = NominalParameters(rig)
    true = nominal.at(np.array([1.0])).value("hub.inertia_kg_m2")
    assert true * 1.05 == pytest.approx(rig.value("hub.inertia_kg_m2"))


def test_every_effect_is_a_candidate_whose_starts_make_an_effect():
    case = _case(_experiment(), _experiment("b", "held_out"))
    found = case.machine.candidates(case.experiments)
    # Quantisation is read off the values (tests/diagnosis/test_quantisation_grid.py), not fitted.
    assert {candidate.effect for candidate in found} == set(EFFECTS) - {"quantisation"}
    for candidate in found:
        low, high = candidate.box
        assert np.all(low < high), candidate.effect
        for start in candidate.starts:
            effect = candidate.effect_at(np.array(start))
            assert effect.id == candidate.effect
            assert np.all((np.array(start) >= low) & (np.array(start) <= high)), candidate.effect


def test_records_are_cut_to_lengths_without_large_prime_factors():
    def record(name, role, n):
        output = RNG.standard_normal((n, 2))
        return _experiment(name, role, voltage_V=output[:, 0].copy(), output=output, missing=(5, n - 1))

    case = _case(record("a", "estimation", 2690), record("b", "held_out", 2011))
    for whole, cut in zip(case.experiments, case.at_fast_lengths().experiments, strict=True):
        kept = len(cut.output)
        assert 0.98 * len(whole.output) <= kept <= len(whole.output)
        rest = kept
        for factor in (2, 3, 5, 7, 11):
            while rest % factor == 0:
                rest //= factor
        assert rest == 1
        assert (cut.name, cut.role) == (whole.name, whole.role)
        np.testing.assert_array_equal(cut.output, whole.output[:kept])
        np.testing.assert_array_equal(cut.voltage_V, whole.voltage_V[:kept])
        assert cut.missing == tuple(row for row in (5, len(whole.output) - 1) if row < kept)
