"""An effect that nobody has heard of, added by the recipe: every page has its words and is drawn whole."""

import json
import re
import tomllib
from functools import partial

import pytest
from pydantic import Field

from diagnosis.evidence.hypotheses import log_prior
from plant.effects import EFFECTS, Effect, EffectParameter, in_words, parse_effects
from plant.effects.base import NotNegative, register
from plant.machine import QUADRATIC, SmoothTorque
from tests.workflow.diagnosis_examples import FRICTION, KnownAnswer, write_case
from workflow.diagnose.case_files import load_case
from workflow.diagnose.outputs import files_of

WIND = {"name": "wind_drag", "coefficient_Nms2": 0.02}


class WindDrag(Effect):
    """Torque -c omega |omega| on the hub."""

    id = "wind_drag"
    words = "a sail at the hub"
    group = "joint"
    law = ("joint", "torques", partial(SmoothTorque, QUADRATIC, at="motor", of="speed"))
    sought = (EffectParameter("coefficient_Nms2", 1e-5, 1, unit="torque_Nm", spread=(3e-4, 0.6, 14)),)

    coefficient_Nms2: NotNegative = Field(description="coefficient c")


@pytest.fixture(
    params=["take the sail off and run again", pytest.param(None, marks=pytest.mark.long)],
    ids=["check", "no check"],
)
def check(request, monkeypatch):
    monkeypatch.setattr(WindDrag, "check", request.param)
    register(WindDrag)
    yield request.param
    del EFFECTS["wind_drag"]


def _page(folder, engine):
    files, _ = files_of(load_case(folder), {"options": {"controller": False}}, engine, lambda f, m: None)
    return files, re.sub("<[^>]*>", "", files["arm.html"].decode())


@pytest.mark.parametrize(
    ("engine", "model_error"),
    [
        (KnownAnswer((WIND,), ambiguous=("coulomb_friction",)), 0.05),
        pytest.param(
            KnownAnswer((FRICTION,), ambiguous=("wind_drag", "unknown")), 0.0, marks=pytest.mark.long
        ),
        pytest.param(KnownAnswer((WIND,), "unknown", "unknown"), 0.05, marks=pytest.mark.slow),
    ],
    ids=["named", "possible", "in part"],
)
def test_every_page_has_the_words_of_its_class(tmp_path, undrawn, check, engine, model_error):
    folder = write_case(tmp_path / "arm", WIND)
    case = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(f"model_error = {model_error}\n" * (model_error > 0) + case)
    files, words = _page(folder, engine)
    document = json.loads(files["arm.json"])
    assert "wind_drag" in document["probabilities"]
    assert in_words("wind_drag") == "a sail at the hub"
    assert "sail at the hub" in words
    asked = document["next_experiment"]["advice"] == "look"
    assert ("Check for a sail at the hub: take the sail off" in words) == (asked and check is not None)
    if engine.effects == (WIND,):
        assert parse_effects(tomllib.loads(files["arm.effects.toml"].decode())["effects"]) == parse_effects(
            [WIND]
        )


def test_prior_probabilities_are_shared_among_all_that_are_registered(check):
    # The set of one effect: the same odds divided by one more.
    count = len(EFFECTS)
    assert log_prior(["wind_drag"]) == log_prior(["wind_drag"], count)
    assert log_prior(["wind_drag"]) < log_prior(["wind_drag"], count - 1)


@pytest.mark.parametrize("missing", ["id", "words"])
def test_an_effect_without_its_words_is_refused_where_it_is_written(missing):
    stated = {name: value for name, value in {"id": "a", "words": "b"}.items() if name != missing}
    with pytest.raises(TypeError, match=f"state its {missing} in the class"):
        register(type("Nameless", (Effect,), {"__module__": __name__, "__doc__": "-", **stated}))
