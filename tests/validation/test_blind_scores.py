"""Scores of answers whose quality is known by construction."""

import numpy as np
import pytest

from validation.blind.generate import answer_toml
from validation.blind.report import confusion_figure, text
from validation.blind.scores import GROUPS, scores, wilson
from validation.blind.workshop.score import score_folders
from workflow.diagnose.document import FORMAT
from workflow.engine.storage import write_json


def _said(case, verdict, ranked=(), *, combination=None, parameters=None, gap_after=1.0):
    return {
        "case": case,
        "verdict": verdict,
        "effects": [
            {
                "name": name,
                "probability": p,
                "parameters": (parameters or {}).get(name, {}),
                "intervals": {k: [0.9 * v, 1.1 * v] for k, v in (parameters or {}).get(name, {}).items()},
            }
            for name, p in ranked
        ],
        "combination": list(combination if combination is not None else [n for n, _ in ranked[:1]])
        if verdict == "effect"
        else [],
        "gap_after": gap_after,
    }


def _true(case, verdict, effects=(), *, ratio=5.0, before=2.0, oracle=1.0, nominal="exact", unlisted=()):
    return {
        "case": case,
        "verdict": verdict,
        "max_ratio": ratio,
        "nominal": nominal,
        "effects": [{"name": name, "parameters": parameters} for name, parameters in effects],
        "unlisted": [{"name": name} for name in unlisted],
        "pooled_gap": {"held_out_gap_before": before, "held_out_gap_after_oracle": oracle},
    }


GRAVITY = ("gravity", {"acceleration_m_s2": 1.0})
DELAY = ("input_delay", {"delay_s": 0.01})


def test_wilson_against_published_values():
    # Newcombe (1998), Statistics in Medicine 17, table I, method 3: 81 of 263, 15 of 148, 0 of 20.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)


def test_perfect_answers_have_perfect_scores():
    said = [
        _said("a", "effect", [("gravity", 1.0)], parameters={"gravity": {"acceleration_m_s2": 1.0}}),
        _said("b", "none", [("none", 1.0)]),
        _said("c", "unknown", [("unknown", 1.0)]),
        _said(
            "d", "effect", [("gravity", 1.0), ("input_delay", 0.0)], combination=["input_delay", "gravity"]
        ),
    ]
    true = [
        _true("a", "effect", [GRAVITY]),
        _true("b", "none"),
        _true("c", "unknown", unlisted=["cogging"]),
        _true("d", "effect", [GRAVITY, DELAY]),
    ]
    found = scores(said, true)
    rows = found["table"]["all"]
    for name in (
        "top-1, ratio >= 3",
        "top-2, ratio >= 3",
        "family, ratio >= 3",
        "unknown: recall",
        "unknown: precision",
        "two effects, exact set",
        "verdict and set right, every case",
        "95 % intervals cover",
    ):
        assert rows[name]["share"] == 1.0, name  # fmt: skip
    for name in ("false alarms", "missed effects", "confident and wrong (p > 0.8)"):
        assert rows[name]["share"] == 0.0, name
    assert rows["Brier of the first answer"]["value"] == 0.0
    assert rows["expected calibration error"]["value"] == 0.0
    assert rows["parameter error"]["median"] == 0.0
    assert rows["gap closed over oracle"]["median"] == 1.0
    assert found["wrong"] == []


def test_every_kind_of_mistake_is_counted_where_it_belongs():
    said = [
        _said("a", "effect", [("hub_inertia", 0.9), ("torque_ripple", 0.1)]),  # false alarm, confident
        _said("b", "none", [("none", 0.6), ("gravity", 0.4)]),  # missed, but second
        _said("c", "effect", [("actuator_lag", 0.7), ("input_delay", 0.3)]),  # family right
        _said("d", "unknown", [("unknown", 0.5)]),  # a listed effect called unknown
        _said("e", "effect", [("gravity", 0.8)]),  # half of two effects
        _said("f", "effect", [("gravity", 0.55)]),  # beyond the list, named all the same
    ]
    true = [
        _true("a", "none"),
        _true("b", "effect", [GRAVITY]),
        _true("c", "effect", [DELAY]),
        _true("d", "effect", [GRAVITY]),
        _true("e", "effect", [GRAVITY, DELAY]),
        _true("f", "unknown", unlisted=["air_drag"]),
    ]
    found = scores(said, true)
    rows = found["table"]["all"]
    assert rows["false alarms"]["hits"] == 1
    assert (rows["missed effects"]["hits"], rows["missed effects"]["count"]) == (1, 4)
    assert (rows["top-1, ratio >= 3"]["hits"], rows["top-1, ratio >= 3"]["count"]) == (0, 3)
    assert rows["top-2, ratio >= 3"]["hits"] == 2
    assert rows["family, ratio >= 3"]["hits"] == 1
    assert rows["unknown: recall"]["hits"] == 0
    assert (rows["unknown: precision"]["hits"], rows["unknown: precision"]["count"]) == (0, 1)
    assert rows["two effects, exact set"]["hits"] == 0
    assert rows["two effects, first is one of them"]["hits"] == 1
    assert rows["confident and wrong (p > 0.8)"]["hits"] == 1
    # (0.9 - 0)^2 + (0.6 - 0)^2 + (0.7 - 0)^2 + (0.5 - 0)^2 + (0.8 - 1)^2 + (0.55 - 0)^2, by hand.
    assert rows["Brier of the first answer"]["value"] == pytest.approx(2.2525 / 6)
    assert found["several"] == {"some of them": 1}
    assert found["unlisted"] == {"air_drag": {"gravity": 1}}
    assert found["confusion"]["none"] == {"hub_inertia": 1}
    assert {w["case"] for w in found["wrong"]} == set("abcdef")


def test_slices_and_sizes():
    said = [_said(c, "effect", [("gravity", 1.0)]) for c in "abc"]
    true = [
        _true("a", "effect", [GRAVITY], ratio=0.5),
        _true("b", "effect", [GRAVITY], ratio=2.0, nominal="uncertain"),
        _true("c", "effect", [GRAVITY], ratio=4.0, nominal="uncertain"),
    ]
    table = scores(said, true)["table"]
    assert table["all"]["top-1, ratio 0.3 to 1.5"]["count"] == 1
    assert table["uncertain"]["top-1, ratio 0.3 to 1.5"]["count"] == 0
    assert table["uncertain"]["top-1, ratio >= 3"]["count"] == 1
    assert table["uncertain"]["top-1, every single effect"]["count"] == 2


def test_phases_are_compared_the_short_way_round():
    parameters = {"amplitude_Nm": 0.1, "cycles_per_rev": 8.0, "phase_rad": 6.2}
    said = _said("a", "effect", [("torque_ripple", 1.0)], parameters={"torque_ripple": dict(parameters)})
    said["effects"][0]["parameters"]["phase_rad"] = 0.0
    said["effects"][0]["intervals"]["phase_rad"] = [-0.1, 0.1]
    rows = scores([said], [_true("a", "effect", [("torque_ripple", parameters)])])["table"]["all"]
    assert rows["95 % intervals cover"]["hits"] == 3
    assert rows["parameter error"]["p90"] < 0.05


def test_intervals_of_normal_errors_are_as_wide_as_the_errors_spread():
    rng = np.random.default_rng(6)
    for stated_over_true in (1.0, 3.0):
        said, true = [], []
        for k in range(400):
            deviation = rng.uniform(0.01, 0.2)
            estimate = 1.0 + deviation * rng.normal()
            answer = _said(str(k), "effect", [("gravity", 0.9)])
            half_width = 1.96 * stated_over_true * deviation
            answer["effects"][0]["parameters"] = {"acceleration_m_s2": estimate}
            answer["effects"][0]["intervals"] = {
                "acceleration_m_s2": [estimate - half_width, estimate + half_width]
            }
            said.append(answer)
            true.append(_true(str(k), "effect", [GRAVITY]))
        rows = scores(said, true)["table"]["all"]
        ratio = rows["95 % intervals, width over spread of errors"]["value"]
        # A median of 400 normal sizes is uncertain by 6 %.
        assert ratio == pytest.approx(stated_over_true, rel=0.18)


def test_a_calibrated_answer_has_little_calibration_error():
    rng = np.random.default_rng(5)
    said, true = [], []
    for k in range(3000):
        p = rng.uniform(0.3, 1.0)
        right = rng.random() < p
        said.append(_said(str(k), "effect", [("gravity" if right else "input_delay", p)]))
        true.append(_true(str(k), "effect", [GRAVITY]))
    # About 400 answers in a bin: 0.4/sqrt(400) = 0.02 is expected of a perfect one.
    assert scores(said, true)["table"]["all"]["expected calibration error"]["value"] < 0.04


def test_lists_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="same cases"):
        scores([_said("a", "none")], [_true("b", "none")])
    with pytest.raises(ValueError, match="each once"):
        scores([_said("a", "none")] * 2, [_true("a", "none")])


def test_text_and_picture_stand_without_any_right_answer():
    found = scores([_said("a", "failed")], [_true("a", "effect", [GRAVITY])])
    document = {
        "diagnosis": found,
        "baselines": {"parameters only": found},
        "failed": {"a": "exit code 1: out of memory"},
        "commitment": "0" * 64,
        "settings": {"cases": 1, "seed": 0},
    }
    words = text(found, document)
    assert "out of memory" in words
    assert "baseline: parameters only" in words
    assert confusion_figure(found).startswith(b"\x89PNG")


def test_open_cases_are_scored_by_the_rig_file_that_was_read(tmp_path):
    cases, diagnosis = tmp_path / "cases", tmp_path / "diagnosis"
    diagnosis.mkdir()
    for case, tolerance in (("a", False), ("b", True)):
        (cases / case).mkdir(parents=True)
        answer = _true(case, "effect", [GRAVITY])
        answer |= {"severity": "clear", "sort": "clear", "nominal": "-", "experiments": {}, "unlisted": []}
        (cases / case / "answer.toml").write_text(answer_toml(answer))
        text = '[tolerances]\n"hub.inertia_kg_m2" = 0.05\n' if tolerance else ""
        (cases / case / "rig.toml").write_text(text)
    for case in "ab":
        said = {"format": FORMAT, **_said(case, "effect", [("gravity", 1.0)])}
        write_json(diagnosis / f"{case}.json", said)
    write_json(diagnosis / "timings.json", {"a": {"cpu_s": 7.0}})
    found = score_folders(cases, diagnosis, GROUPS)
    assert found["table"]["uncertain"]["top-1, ratio >= 3"]["count"] == 1
    assert found["table"]["exact"]["CPU per case [s]"]["median"] == 7.0
    (diagnosis / "b.json").unlink()
    assert score_folders(cases, diagnosis, GROUPS)["wrong"][0]["case"] == "b"
