"""True modes beside simulated logs, and pole pairs that are no modes by name."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from plant import linear_arm
from workflow.config.run_config import built_in_config
from workflow.describe.identification import pair_kind, true_mode
from workflow.engine.errors import InputError
from workflow.tasks import simulated_rig as truth
from workflow.tasks.results import IdentifiedChannel, ModelMode
from workflow.tasks.simulated_rig import rig_of


def found_in(pairs, longest_s=8.0):
    modes = tuple(ModelMode(2 * np.pi * hertz, zeta) for hertz, zeta in pairs)
    found = SimpleNamespace(modes=modes, longest_s=longest_s)
    found.is_mode = lambda mode: IdentifiedChannel.is_mode(found, mode)
    return found


def test_truth_is_that_of_the_linear_arm_with_its_viscous_friction():
    source = built_in_config()[0].source
    added = sum(
        effect["coefficient_Nms"] for effect in source.effects if effect["name"] == "viscous_friction"
    )
    rig = rig_of(source)
    hub = rig.hub.model_copy(update={"viscous_friction_Nms": rig.hub.viscous_friction_Nms + added})
    poles = linear_arm(rig.model_copy(update={"hub": hub})).poles()
    expected = np.sort(np.abs(poles[(poles.imag > 0) & (-poles.real < 0.6 * np.abs(poles))])) / (2 * np.pi)
    modes = truth.truth_of(source).modes["tip_m"]
    assert len(modes) >= 2
    assert [mode.frequency_Hz for mode in modes] == pytest.approx(expected[: len(modes)].tolist(), rel=1e-9)


def test_a_pair_that_is_no_mode_says_so_and_has_no_truth():
    found = found_in([(0.1, 0.05), (7.5, 0.02), (8.5, 0.02), (30.0, 0.9)])
    true = [truth.TrueMode(frequency_Hz=hertz, damping=0.01) for hertz in (7.6, 33.0)]
    matched = truth.beside(found, true)
    assert matched == (None, true[0], None, None)
    none = "slow or overdamped pair"
    assert [pair_kind(found, mode) for mode in found.modes] == [none, "mode", "mode", none]
    assert true_mode(matched[1]) == "7.6 Hz, damping 0.01"
    assert true_mode(matched[2]) == ""


def test_truth_is_read_beside_the_logs_of_one_folder_only(tmp_path):
    (tmp_path / "other").mkdir()
    written = truth.Truth(modes={"y": (truth.TrueMode(frequency_Hz=2.0, damping=0.1),)})
    place = tmp_path / truth.TRUTH_FILE
    place.write_text(written.model_dump_json())
    assert truth.truth_beside([tmp_path / "a.csv", tmp_path / "b.csv"], "y") == written.modes["y"]
    assert truth.truth_beside([tmp_path / "a.csv"], "z") == ()
    assert truth.truth_beside([tmp_path / "a.csv", tmp_path / "other" / "b.csv"], "y") == ()
    place.write_text(json.dumps({"format": "flexlink truth 1"}))
    with pytest.raises(InputError, match=r"truth\.json"):
        truth.truth_beside([tmp_path / "a.csv"], "y")
    place.write_text(json.dumps({"truth": 42}))  # somebody else's
    assert truth.truth_beside([tmp_path / "a.csv"], "y") == ()
