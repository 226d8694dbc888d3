"""A spring to ground, which is not on the list, and gravity, which is; made by an independent simulator."""

import numpy as np
import pytest

from diagnosis import diagnose
from plant import Rig
from tests.diagnosis.recorded import simulated_case
from validation.blind.rigs import draw_rig


def _case(folder, effect, amplitude_V):
    records = [(role, [effect], 8, amplitude_V) for role in ("estimation", "estimation", "held_out")]
    table = draw_rig(np.random.default_rng(3))
    return simulated_case(folder, table, records, np.random.default_rng(4), samples=700)


def _as_gravity_would(folder, acceleration_m_s2):
    """The spring that holds the hub as gravity holds the hanging link."""
    rig = Rig.from_toml(folder / "rig.toml")
    link, r = rig.link, rig.hub.radius_m
    mass = link.density_kg_m3 * link.width_m * link.thickness_m * link.length_m
    moment = mass * (r + link.length_m / 2) + rig.payload.mass_kg * (r + link.length_m)
    return {"name": "ground_spring", "stiffness_Nm_rad": acceleration_m_s2 * moment}


def _found(folder, cause, acceleration_m_s2, amplitude_V):
    case = _case(folder, {"name": "gravity", "acceleration_m_s2": acceleration_m_s2}, amplitude_V)
    if cause == "spring":
        case = _case(folder, _as_gravity_would(folder, acceleration_m_s2), amplitude_V)
    return diagnose(case)


@pytest.mark.long
@pytest.mark.parametrize("cause", ["gravity", "spring"])
def test_what_the_records_cannot_tell_apart_is_gravity_or_unknown(tmp_path, cause):
    # 0.04 rad of motion, a gap of a tenth of the noise.
    found = _found(tmp_path, cause, 0.1, 0.05)
    assert found.combination == ("gravity",)
    assert found.detail_verdict == "ambiguous"
    assert "unknown" in found.ambiguous_with
    # An experiment that tells them apart can be asked for.
    assert {effect.id for hypothesis in found.competing for effect in hypothesis.effects} >= {
        "gravity",
        "ground_spring",
    }
    # Prior odds are 0.006 to 0.5/23.
    assert found.probabilities["gravity"] == pytest.approx(0.78, abs=0.06)


@pytest.mark.long
def test_gravity_that_also_bends_the_link_is_gravity(tmp_path):
    found = _found(tmp_path, "gravity", 0.4, 0.15)
    assert found.combination == ("gravity",)
    assert found.probabilities["gravity"] > 0.98


@pytest.mark.slow
def test_a_spring_to_ground_is_nothing_of_the_list(tmp_path):
    found = _found(tmp_path, "spring", 0.4, 0.15)
    assert found.verdict == "unknown"
    assert found.probabilities["unknown"] > 0.98
    # It is named all the same.
    (spring,) = found.unlisted
    true = _as_gravity_would(tmp_path, 0.4)
    assert spring.id == true["name"]
    assert spring.stiffness_Nm_rad == pytest.approx(true["stiffness_Nm_rad"], rel=0.02)
