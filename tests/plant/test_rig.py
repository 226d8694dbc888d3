import numpy as np
import pytest

from plant import Rig, paper_link, parameter_keys


def _edited(tmp_path, old, new):
    text = paper_link().to_toml()
    assert old in text
    path = tmp_path / "rig.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_rig_survives_its_own_file(tmp_path):
    rig = Rig.model_validate({**paper_link().model_dump(), "tolerances": {"hub.inertia_kg_m2": 0.05}})
    path = tmp_path / "rig.toml"
    path.write_text(rig.to_toml(), encoding="utf-8")
    assert Rig.from_toml(path) == rig


def test_the_recorded_rigs_are_read(gap_cases):
    folder = gap_cases / "labelled" / "none"
    rig = Rig.from_toml(folder / "rig.toml")
    assert (rig.link.length_m, rig.hub.inertia_kg_m2, rig.sampling.dt_s) == (1.0, 0.02, 0.005)
    assert rig.tolerances == {}
    uncertain = Rig.from_toml(folder / "rig_uncertain.toml")
    assert uncertain.tolerances["link.kelvin_voigt_s"] == 0.3
    assert set(uncertain.tolerances) <= set(parameter_keys())
    for path in gap_cases.glob("*/*/rig*.toml"):
        Rig.from_toml(path)


DT = "dt_s = 0.005"


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        ("length_m = 1.0", "length_m = nan", ("link.length_m", "nan")),
        ("length_m = 1.0", "length_m = inf", ("link.length_m", "inf")),
        ("length_m = 1.0", "length_m = 0.0", ("link.length_m", "greater than 0", "0.0")),
        ("length_m = 1.0", 'length_m = "1.0"', ("link.length_m", "'1.0'")),
        ("length_m = 1.0", "length_m = true", ("link.length_m", "True")),
        ("length_m = 1.0", "lenght_m = 1.0", ("link.lenght_m", "link.length_m")),
        ("length_m = 1.0", "", ("link.length_m",)),
        ("[payload]\nmass_kg = 0.0", "", ("payload",)),
        ("[payload]", "[payloads]", ("payloads",)),
        ("mass_kg = 0.0", "mass_kg = -0.1", ("payload.mass_kg", "0, ", "-0.1")),
        (DT, f"{DT}\n[tolerances]\n'hub.mass_kg' = 0.1", ("tolerances.hub.mass_kg",)),
        (DT, f"{DT}\n[tolerances]\n'hub.radius_m' = 0.0", ("hub.radius_m", "0.0")),
        (DT, "dt_s = 5000.0", ("sampling.dt_s", "10, ", "5000.0")),
        (DT, f"{DT}\ntransport_delay_s = 1e6", ("transport_delay_s", "60, ")),
        ("length_m = 1.0", "length_m = = 1.0", ("TOML", "line 4, column 12")),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_file_and_key(tmp_path, old, new, facts):
    path = _edited(tmp_path, old, new)
    with pytest.raises(ValueError) as caught:
        Rig.from_toml(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert all(fact in message for fact in facts)
    assert "\n" not in message


def test_bytes_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b"[link]\nlength_m = \xff")
    with pytest.raises(ValueError, match=r"rig\.toml.*UTF-8.*\b18\b"):
        Rig.from_toml(path)


def test_perturbed_and_scaled_change_what_they_name_and_nothing_else():
    rig = paper_link()
    other = rig.scaled({"hub.inertia_kg_m2": 1.5}).perturbed({"payload.mass_kg": 0.2})
    for key in parameter_keys():
        expected = {"hub.inertia_kg_m2": 0.045, "payload.mass_kg": 0.2}.get(key, rig.value(key))
        assert other.value(key) == pytest.approx(expected, rel=1e-15)
    with pytest.raises(ValueError, match=r"hub\.mass_kg"):
        rig.perturbed({"hub.mass_kg": 1.0})
    with pytest.raises(ValueError, match=r"link\.length_m.*-1\.0"):
        rig.perturbed({"link.length_m": -1.0})


def test_draws_have_the_spread_of_the_tolerances():
    rig = Rig.model_validate({**paper_link().model_dump(), "tolerances": {"hub.inertia_kg_m2": 0.05}})
    rng = np.random.default_rng(0)
    ratios = np.array([rig.drawn(rng).hub.inertia_kg_m2 for _ in range(2000)]) / rig.hub.inertia_kg_m2
    # Standard errors: 0.05 / sqrt(2000) = 1.1e-3 of the mean, 0.05 / sqrt(4000) = 8e-4 of the deviation; 4 of
    # each.
    assert abs(ratios.mean() - 1) < 4.5e-3
    assert abs(ratios.std() - 0.05) < 3.2e-3
    assert rig.drawn(rng).link == rig.link


def test_a_rig_cannot_be_changed():
    with pytest.raises(ValueError, match="frozen"):
        paper_link().link.length_m = 2.0
