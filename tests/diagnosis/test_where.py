"""Where the gap lies: places made on purpose are found, noise alone is not, recorded gaps are located."""

from __future__ import annotations

import json

import numpy as np
import pytest

from diagnosis import ResidualModel
from diagnosis.where import subsystem_mass, where
from plant import EFFECTS
from tests.diagnosis.recorded import recorded_case
from tests.diagnosis.synthetic_residuals import DT, made, white


def _sum(a, b):
    return {name: a[name] + b[name] for name in a}


def _gap(shape):
    """A gap made by shape(name, T) -> (T, 2), on top of white noise of one seed."""
    residuals = white(np.random.default_rng(5))
    return _sum(residuals, {name: shape(name, e.shape[0]) for name, e in residuals.items()})


def test_noise_alone_is_said_to_be_noise():
    residuals = white(np.random.default_rng(2))
    found = where(made(residuals), residuals)
    assert not found.gap.found
    assert found.sentences == {}
    assert found.headline.startswith("Nothing lies beyond sensor noise")


def test_a_band_is_found_in_the_sensor_it_was_put_in():
    frequency = 5.0

    def tone(name, T):
        signal = 2.0 * np.sqrt(2) * np.sin(2 * np.pi * frequency * DT * np.arange(T) + len(name))
        return np.column_stack([np.zeros(T), signal])

    residuals = _gap(tone)
    found = where(made(residuals), residuals)
    band = max(found.bands, key=lambda b: b.gap.share)
    assert band.sensor == "tip"
    assert band.low_Hz < frequency < band.high_Hz
    # The tone's energy is 4 T in the band it lies in, less what the ends of a record leak out of it.
    assert band.gap.share > 0.95
    assert "tip sensor" in found.sentences["sensors"]
    assert f"between {band.low_Hz:g} and {band.high_Hz:g} Hz" in found.sentences["frequency"]
    tip = next(s.gap for s in found.sensors if s.sensor == "tip")
    assert tip.interval[0] <= 2.0 <= tip.interval[1]


def test_a_result_is_json():
    residuals = white(np.random.default_rng(2))
    found = where(made(residuals), residuals, {"coulomb_friction": 0.7, "none": 0.3})
    back = json.loads(json.dumps(found.to_dict()))
    assert back["subsystem"]["joint"] == pytest.approx(0.7)
    assert {"bands", "regimes", "experiments", "sensors", "subsystem", "headline", "sentences"} <= set(back)
    assert len(back["bands"]) == len(found.bands)


def test_subsystem_mass_keeps_the_whole_probability():
    names = [*EFFECTS, "none", "unknown"]
    rng = np.random.default_rng(0)
    probabilities = dict(zip(names, rng.dirichlet(np.ones(len(names))), strict=True))
    mass = subsystem_mass(probabilities)
    assert sum(mass.values()) == pytest.approx(1.0)
    assert mass["environment"] == pytest.approx(
        probabilities["periodic_disturbance"] + probabilities["gravity"]
    )
    with pytest.raises(ValueError, match="magnetism: no such effect"):
        subsystem_mass({"magnetism": 1.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("fresh"), "no residuals of experiment fresh"),
        (lambda r: r.update(fresh=r["fresh"][:, :1]), "residuals of fresh must be finite and"),
        (lambda r: r["fresh"].__setitem__((3, 1), np.nan), "residuals of fresh must be finite"),
    ],
)
def test_residuals_that_do_not_fit_the_case_are_refused(change, message):
    residuals = white(np.random.default_rng(2))
    case = made(residuals)
    change(residuals)
    with pytest.raises(ValueError, match=message):
        where(case, residuals)


def test_level_must_be_a_chance():
    residuals = white(np.random.default_rng(2))
    with pytest.raises(ValueError, match="level must lie between 0 and 1"):
        where(made(residuals), residuals, level=1.5)


def _recorded(gap_cases, name):
    case = recorded_case(gap_cases / "labelled" / name)
    return where(case, ResidualModel(case).by_experiment(np.zeros(0), ()))


def test_recorded_sensor_drift_is_a_drift_of_the_tip_sensor(gap_cases):
    found = _recorded(gap_cases, "sensor_drift")
    (tip,) = (d for d in found.drift if d.found)
    assert tip.sensor == "tip"
    # answer.toml: rate_m_s
    assert tip.interval[0] <= -0.002875 <= tip.interval[1]
    assert "tip sensor" in found.sentences["sensors"]
    assert "grows steadily with time" in found.headline


def test_recorded_case_without_effect_has_no_place(gap_cases):
    found = _recorded(gap_cases, "none")
    assert found.sentences == {}


def test_recorded_saturation_shows_in_the_one_experiment_that_saturates(gap_cases):
    found = _recorded(gap_cases, "actuator_saturation")
    assert [x.experiment for x in found.experiments if x.gap.found] == ["experiments/03_multisine.csv"]
