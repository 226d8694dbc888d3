"""Every answer that a diagnosis can have is drawn: JSON, page and terminal, from answers made by hand.

Of every verdict and every proposal of a next experiment, for a rig, a rig beside a model error, and one's own
simulation, with all that an answer may hold beside and without it. Nothing is searched.
"""

import json
import re
from dataclasses import replace
from html import escape
from itertools import product
from typing import get_args, get_type_hints

import numpy as np
import pytest
from jinja2 import StrictUndefined

from diagnosis.answer import (
    Completeness,
    DetailVerdict,
    Diagnosis,
    NamedEffect,
    Prediction,
    Shares,
    share_closed,
)
from diagnosis.machine.own_plant import Plant, PlantCase, PlantExperiment
from diagnosis.machine.plant_effect import Change, EffectParameter, PlantEffect
from diagnosis.next_experiment.discrimination import CompetingHypothesis
from diagnosis.next_experiment.next_experiment import Considered, NextExperiment, Separation
from diagnosis.next_experiment.repeat import Change as Changed, Repeat
from diagnosis.where.findings import Where
from flexlink import shown
from plant.effects.joint import GroundSpring
from tests.workflow.command import build_nothing
from tests.workflow.diagnosis_examples import FRICTION, KnownAnswer, write_case
from workflow.describe.diagnosis import far_off, headline, is_noise, numbers, unexplained_words
from workflow.describe.diagnosis_view import DiagnosisView
from workflow.describe.facts import Section, answer, by_key
from workflow.describe.summary import RunSummary
from workflow.diagnose import command, outputs, pages
from workflow.diagnose.advice import advice_words
from workflow.diagnose.case_files import load_case
from workflow.diagnose.document import document_of
from workflow.diagnose.fleet import FleetMachine, overview_page
from workflow.diagnose.following import Following, following
from workflow.diagnose.outputs import files_of
from workflow.diagnose.simulator_case import SimulatorCase
from workflow.report.rendering import render_described
from workflow.text.templates import environment

TWO = ("dry friction", "backlash")
APART, ALIKE = Separation(TWO, 5.0, 12.5), Separation(TWO, 0.4, 0.08)
REPEATS = [
    Repeat("a", change, (pair,), (ALIKE,), pair.separated)
    for change in get_args(Changed)
    for pair in (APART, ALIKE)
]
ADVICES = get_args(get_type_hints(Following)["advice"])


def proposed(pair: Separation, decided: bool) -> NextExperiment:
    looked_at = (Considered("chirp", {"from_Hz": 1.0}, 2.0, True, 3.0, None),)
    return NextExperiment(
        "chirp", {"from_Hz": 1.0, "shape": "up"}, 2.0, 3.0, 0.01, np.ones(300), (pair,), 2.0,
        (-0.1, 0.2), (-1e-3, 2e-3), pair.separated, decided, looked_at,
    )  # fmt: skip


def followings(kind: str, competing: tuple[CompetingHypothesis, ...]) -> list[Following]:
    """Every advice, with every experiment that may stand beside it: repeats are of one's own machine."""
    named = tuple(replace(one, name=name) for one, name in zip(competing, TWO, strict=True))
    found = [Following(advice, competing=named) for advice in ADVICES if advice != "separate"]
    if kind == "own":
        return [*found, *(Following("look", competing=named, repeat=one) for one in REPEATS)]
    choices = product((APART, ALIKE), (True, False))
    return [*found, *(Following("separate", proposed(*choice), named) for choice in choices)]


def simulate(parameters, effects, inputs):
    drag = effects.get("drag", {"force_N": 0.0})["force_N"]
    return np.column_stack([parameters["gain"] * inputs[:, 0] - drag, inputs[:, 0] ** 2])


def own_case() -> PlantCase:
    """Two outputs, one effect of its own and one that nobody could try."""
    plant = Plant(
        simulate, {"gain": 2.0}, {"gain": 0.1}, ("x_m", "second"), np.array([0.1, 0.1]),
        (PlantEffect("drag", (EffectParameter("force_N", 0.1, 1.0),)),), 0.05, 0.01,
        inactive={"kv": "its name in candidates"}, units={"second": "N"},
    )  # fmt: skip
    rng, records = np.random.default_rng(0), []
    for name, role in (("a", "estimation"), ("b", "held_out")):
        u = rng.standard_normal((200, 1))
        output = simulate(plant.parameters, {}, u) + 0.1 * rng.standard_normal((200, 2))
        records.append(PlantExperiment(name, role, u, output))
    return PlantCase("own", plant, tuple(records))


def own_answer(case: PlantCase) -> Diagnosis:
    rng = np.random.default_rng(1)
    left = {e.name: rng.standard_normal(e.output.shape) for e in case.experiments}
    drag = NamedEffect("drag", 0.9, 0.9, {"force_N": 0.3}, {"force_N": (0.2, 0.4)}, 1.0, (0.9, 0.8, 0.95))
    others = (
        replace(drag, name=name, probability=p, presence=p, parameters={}, intervals={}, untried=why)
        for name, p, why in (
            ("wrong_gain", 0.06, ""),
            ("kv", 0.0, "its name in candidates"),
            ("none", 0.0, ""),
            ("unknown", 0.04, ""),
        )
    )
    return Diagnosis(
        case=case, verdict="effect", detail_verdict="effect",
        probabilities={"drag": 0.9, "wrong_gain": 0.06, "kv": 0.0, "none": 0.0, "unknown": 0.04},
        sets={("drag",): 0.9, ("wrong_gain",): 0.06, ("unknown",): 0.04}, effects=(drag, *others),
        combination=("drag",), ambiguous_with=("wrong_gain",), gap_before=9.0, gap_refit=8.0, gap_after=1.0,
        noise_floor=1.0, gap_closed=0.99, gap_closed_interval=(0.98, 1.0), deviations={"gain": 1.5},
        deviations_refit={"gain": -2.5}, rig=case.plant.scaled({"gain": 1.1}),
        repair=(Change("drag", {"force_N": 0.3}),),
        residuals_before={name: 9 * e for name, e in left.items()},
        residuals_refit={name: 8 * e for name, e in left.items()}, residuals_after=left, simulations=7,
        completeness=Completeness(0.97, 0.05, {"x_m": 0.01, "second": 0.0}, {"x_m": 0.1, "second": 0.0}),
        shares=Shares(case.outputs, (0.3, 0.3), (0.1, 0.1), 0.05, {"drag": (0.9, 0.8, 0.95)}, (),
                      ((("drag",), 0.9), (("wrong_gain",), 0.3)), ()),
    )  # fmt: skip


def beside(found: Diagnosis) -> Diagnosis:
    """With all that an answer may hold."""
    first, *others = found.effects
    key = next(iter(first.parameters))
    first = replace(first, remarks={key: "anywhere in its range"}, widened_by=next(iter(found.deviations)))
    name = first.name
    shares = found.shares and replace(
        found.shares, small=("gravity",), silent=(name,), not_tried=("backlash",), horizon_samples=50,
        horizon_before=(0.3,) * len(found.shares.names), horizon_after=(0.1,) * len(found.shares.names),
        horizon_closed=0.89, carried={**found.shares.carried, "gravity": (0.02, 0.01, 0.03)},
    )  # fmt: skip
    second = replace(others[0], name="gravity", presence=0.3, probability=0.0)
    return replace(
        found, effects=(first, second, *(e for e in others if e.name != "gravity")), shares=shares,
        doubts=("the simulation ignores its gain", "is that the right log?"), held_out_decided=True,
        noise_below_stated=((found.case.outputs[0], 0.01, 0.1),),
        unlisted=(GroundSpring(stiffness_Nm_rad=0.2),),
        sets={**found.sets, tuple(sorted((name, "gravity"))): 0.0},
    )  # fmt: skip


def as_judged(found: Diagnosis, verdict: str, detail: str) -> Diagnosis:
    """The same with another verdict."""
    if verdict == "effect":
        return replace(found, detail_verdict=detail)
    partial = tuple(found.combination) if found.unlisted and verdict == "unknown" else ()
    return replace(
        found, verdict=verdict, detail_verdict=detail, combination=(), partial_model=partial,
        probabilities={**found.probabilities, verdict: 0.9},
    )  # fmt: skip


VERDICTS = [
    (verdict, detail)
    for detail in get_args(DetailVerdict)
    for verdict in (
        ("none", "effect", "unknown")
        if detail == "not_converged"
        else ({"parametric": "none", "ambiguous": "effect"}.get(detail, detail),)
    )
]


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """Kind of case -> it, its answer; a rig's answer may be beside a model error."""
    folder = write_case(tmp_path_factory.mktemp("answers") / "arm", FRICTION, records=2)
    exact = load_case(folder, "rig_uncertain.toml")
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text("model_error = 0.05\n" + text)
    rough, own = load_case(folder, "rig_uncertain.toml"), own_case()
    engine = KnownAnswer((FRICTION,), ambiguous=("viscous_friction",))
    mine = SimulatorCase(
        own, "arm.xml", "", lambda found, folder: "<mujoco/>", model_error=0.1,
        units={"drag": {"force_N": "force_kN"}}, doubts=("columns that never change are left out: u",),
    )  # fmt: skip
    return {
        "exact": (exact, engine(exact.case)),
        "rough": (rough, engine(rough.case)),
        "own": (mine, own_answer(own)),
    }


@pytest.fixture
def quick(loaded, monkeypatch, undrawn):
    """What is computed of the records is computed once; figures are built by the tests of single pages."""
    build_nothing(monkeypatch)
    once = {kind: pages.remains_of(found) for kind, (_, found) in loaded.items()}
    kinds = {id(one.case): kind for kind, (one, _) in loaded.items()}
    for module in (outputs, pages):
        for name in ("where", "where_in_records", "remains_of"):
            monkeypatch.setattr(
                module, name, lambda case, *_: once[kinds[id(getattr(case, "case", case))]], raising=False
            )
    monkeypatch.setattr(outputs, "answer_text", json.dumps)  # of plain values; the other one hashes itself
    monkeypatch.setattr(outputs, "telling", lambda *_: None)
    told = RunSummary("own", (), {"alike": []})
    monkeypatch.setattr(outputs, "of_case", lambda *_: told)


def drawn(loaded, found, coming, monkeypatch):
    """JSON answer, words of the page, rows of the terminal."""
    monkeypatch.setattr(outputs, "following", lambda _: coming)
    made_from = {"options": {"controller": False}}
    files, _ = files_of(loaded, made_from, lambda case, progress: found, lambda f, m: None)
    document = json.loads(files[f"{loaded.case.name}.json"])
    page = re.sub(r"<script.*?</script>|<[^>]*>", " ", files[f"{loaded.case.name}.html"].decode(), flags=re.S)
    one, several = (
        command._summary(
            [document] * count, [FleetMachine.of(document)] * count, [], outputs.Path("found/a.html")
        )
        for count in (1, 2)
    )
    assert several.sections
    render_described(overview_page([FleetMachine.of(document)] * 2, {"other": "no such luck"}))
    # A row with a key says what the answer has there.
    for key, row in by_key(one.sections).items():
        value = document
        for level in key.split("."):
            value = value[level]
        assert row.value.plain == value
    rows = [(row.name, row.text) for section in one.sections for row in section.rows]
    assert shown.describe(found)
    return document, " ".join(page.split()), rows


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("kind", ["exact", "rough", "own"])
def test_every_verdict_is_drawn_with_every_proposal(loaded, monkeypatch, kind):
    """Each with all that an answer may hold, and without, in turns."""
    assert environment().undefined is StrictUndefined
    case, answer = loaded[kind]
    competing = tuple(CompetingHypothesis(0.5, answer.rig, noise=np.ones(2)) for _ in TWO)
    # What a page says of an experiment does not depend on a model error.
    comings = followings(kind, competing)[:: 3 if kind == "rough" else 1]
    for i, j in product(range(len(VERDICTS)), range(len(comings))):
        (verdict, detail), coming = VERDICTS[i], comings[j]
        found = beside(answer) if (i + j) % 2 else answer
        if (i + j) % 4 == 1 and found.shares:
            # A time limit left no time to share the error out among the effects.
            found = replace(found, shares=replace(found.shares, carried={}))
        document, page, rows = drawn(case, as_judged(found, verdict, detail), coming, monkeypatch)
        assert (document["verdict"], document["detail_verdict"]) == (verdict, detail)
        assert document["next_experiment"]["advice"] == coming.advice
        values = dict(rows)
        # One advice, the same words everywhere.
        words = document["next_experiment"]["words"]
        assert values["next"] == words[0]
        assert all(escape(sentence) in page for sentence in words)
        assert (
            len(re.findall("No further experiment is needed|before you record again", " ".join(words))) <= 1
        )
        if coming.repeat and coming.repeat.separates:
            assert words[0].startswith(f"Repeat {coming.repeat.record} ")
        written = bool(coming.proposal and coming.proposal.separates)
        assert written == (f"run {case.case.name}.next.csv, a chirp" in words[0].lower())
        for text in (page, *values.values()):
            assert not re.search(r"\bUndefined\b|\bNone\b(?! of)|\bnan\b|object at 0x", text)
        assert all(
            doubt in page and doubt in [v for k, v in rows if k == "doubtful"] for doubt in found.doubts
        )


SURE = {"ambiguous_with": ()}
OPEN = {"ambiguous_with": ("unknown",), "detail_verdict": "ambiguous"}
NONE = {"verdict": "none", "combination": ()}


@pytest.mark.parametrize(
    ("answer", "complete", "advice", "first"),
    [
        (SURE, 0.97, "none", "These candidates that were tried need no further experiment"),
        # More is left than the threshold: something is to be found out, whether effects are named or not.
        (SURE, 0.1, "repeat_worst", "Repeat a, the worst record,"),
        ({**NONE, **OPEN}, 0.1, "repeat_worst", "Repeat a, the worst record,"),
        ({**NONE, **OPEN}, 0.9, "repeat_all", "No other candidate effect is left."),
        (OPEN, 0.97, "look", "Check the machine before you record again. These records leave"),
        ({"detail_verdict": "not_converged"}, 0.97, "time", "Check units, columns and nominal values"),
        ({**OPEN, "detail_verdict": "not_converged"}, 0.1, "time", "Check units, columns"),
    ],
)
def test_one_advice_follows_from_an_answer(loaded, answer, complete, advice, first):
    _, found = loaded["own"]
    completeness = replace(
        found.completeness, probability=complete, in_record="a", remains_in_record={"x_m": 0.3}
    )
    found = replace(found, **answer, completeness=completeness)
    coming = following(found)
    words = advice_words(found, coming)
    assert coming.advice == advice
    assert words[0].startswith(first)


def test_nobody_calls_a_candidate_ruled_out_that_was_not_tried(loaded):
    _, found = loaded["own"]
    (last,) = found.effects[-1:]
    untried = replace(found, effects=(*found.effects, replace(last, name="kv", untried="more time")))
    tried = replace(found, effects=tuple(replace(effect, untried="") for effect in found.effects))
    (all_of_them,), (some,) = (advice_words(one, Following("none")) for one in (tried, untried))
    assert "every other candidate" in all_of_them
    assert "others were not tried" in some


@pytest.mark.parametrize(
    ("separations", "same", "first", "without"),
    [
        (
            [7.0],
            4.0,
            "separate dry friction from backlash by 7 times the threshold, as it was by 4 at",
            "No record",
        ),
        # How small the noise is says nothing about how different answers are.
        ([4.5e13], 4.4e13, "by more than 20 times the threshold, as it was by more than 20 at most", "e+13"),
        ([0.3], 0.2, "No record repeated, as it was or changed, separates them: by 0.3 times", "at another"),
        ([2.9, 2.0], 0.2, "separates them: by 2.9 times the threshold at most", "Repeat"),
    ],
)
def test_a_record_to_repeat_is_advised_or_said_to_tell_nothing(loaded, separations, same, first, without):
    _, found = loaded["own"]
    pairs = tuple(Separation(TWO, size, size**2 / 2) for size in separations)
    parts = any(pair.separated for pair in pairs)
    repeat = Repeat("a", "third", pairs, (Separation(TWO, same, same**2 / 2),), parts)
    words = advice_words(replace(found, ambiguous_with=("unknown",)), Following("look", repeat=repeat))
    assert first in words[0]
    assert without not in words[0]
    assert words[0].startswith("Repeat a at a third of its size" if parts else "Check the machine")


@pytest.mark.parametrize(
    ("sets", "instead", "perhaps"),
    [
        # Of another output: in no set without the answer.
        ({("drag",): 0.8, ("drag", "second_offset"): 0.15, ("unknown",): 0.05}, (), ("second_offset",)),
        ({("drag",): 0.8, ("second_offset",): 0.15, ("unknown",): 0.05}, ("second_offset",), ()),
        ({("drag",): 0.7, ("second_offset",): 0.1, ("drag", "second_offset"): 0.2}, ("second_offset",), ()),
        ({("drag",): 0.7, ("second_offset",): 0.01, ("drag", "second_offset"): 0.29}, (), ("second_offset",)),
    ],
)
@pytest.mark.usefixtures("quick")
def test_what_can_only_stand_beside_the_answer_takes_no_place(loaded, monkeypatch, sets, instead, perhaps):
    case, answer = loaded["own"]
    p = sum(share for names, share in sets.items() if "second_offset" in names)
    other = replace(answer.effects[1], name="second_offset", presence=p)
    found = replace(
        answer, sets=sets, ambiguous_with=("second_offset",), detail_verdict="ambiguous",
        effects=(answer.effects[0], other, *answer.effects[2:]),
    )  # fmt: skip
    assert (found.instead, found.perhaps) == (instead, perhaps)
    document, page, rows = drawn(case, found, Following("look"), monkeypatch)
    assert (document["instead"], document["perhaps"]) == ([*instead], [*perhaps])
    assert ("or instead" in dict(rows), "perhaps also" in dict(rows)) == (bool(instead), bool(perhaps))
    assert ("; or instead second offset" in page, "; perhaps also second offset" in page) == (
        bool(instead),
        bool(perhaps),
    )


def test_no_more_than_all_is_explained(loaded):
    """A model that leaves less than noise does, by chance, explains 100 % and no more."""
    (_, answer), rng = loaded["own"], np.random.default_rng(2)
    before, after = ({e.name: size * np.ones((200, 2)) for e in answer.case.experiments} for size in (9, 0.9))
    assert share_closed(answer.case, before, after, rng, 1.0) == (1.0, (1.0, 1.0))
    assert share_closed(answer.case, before, before, rng, 1.0) == (0.0, (0.0, 0.0))


def view_of(found: Diagnosis, where: Where) -> DiagnosisView:
    return DiagnosisView(found, where, where)


@pytest.fixture(scope="module")
def somewhere(loaded):
    _, found = loaded["exact"]
    return pages.remains_of(found)


def test_numbers_of_the_first_screen_are_those_of_the_answer(loaded, somewhere):
    """A row with a key says what the JSON answer has there; sizes in per cent of the motion have none."""
    for kind in ("exact", "rough", "own"):
        case, found = loaded[kind]
        rows = numbers(view_of(found, somewhere))
        assert len(rows) == 5
        document = document_of(case, found)
        told = answer([Section("numbers", rows)])
        assert told["probability"] == document["probability"] == found.probability
        assert told["completeness"]["probability"] == document["completeness"]["probability"]
        assert told["gap_closed"] == document["gap_closed"]
        if kind == "exact":
            assert (told["gap_before"], told["gap_after"]) == (document["gap_before"], document["gap_after"])
        else:
            assert "gap_before" not in told
            assert all(row.value.unit == "% of the motion" for row in rows[:2])


def test_no_number_stands_for_an_answer_that_is_none(loaded, somewhere):
    _, found = loaded["exact"]
    for changes in (
        {"detail_verdict": "not_converged"},
        {"verdict": "unknown", "effects": tuple(replace(e, untried="time") for e in found.effects[:-2])},
    ):
        without = replace(found, **changes)
        if changes.get("effects"):
            without = replace(without, effects=(*without.effects, *found.effects[-2:]))
        keys = [row.key for row in numbers(view_of(without, somewhere))]
        assert "probability" not in keys
        assert "completeness.probability" not in keys


@pytest.mark.parametrize(("off", "said"), [(1.99, False), (2.0, True), (-2.4, True)])
def test_a_nominal_value_is_named_from_two_tolerances_on(off, said):
    words = far_off({"hub.inertia_kg_m2": off, "motor.resistance_ohm": 0.1})
    assert words == (f"inertia (hub) by {off:+.2f} tolerances" if said else "")


@pytest.mark.parametrize(("size", "noise"), [(1.03, True), (1.031, False)])
def test_a_size_within_three_per_cent_of_the_floor_is_no_more_than_it(size, noise):
    assert is_noise(size, 1.0) == noise


@pytest.mark.parametrize(("share", "said"), [(float("nan"), ""), (0.049, ""), (0.05, "5 %"), (0.3, "30 %")])
def test_what_nothing_explains_is_said_where_it_is_much(loaded, share, said):
    _, found = loaded["own"]
    prediction = Prediction(("drag",), (), 9.0, 1.0, 1.0, 0.1, share, ())
    words = unexplained_words(replace(found, prediction=prediction))
    assert words.startswith(said)
    assert bool(words) == bool(said)
    assert unexplained_words(replace(found, prediction=prediction, verdict="none")) == ""


@pytest.mark.parametrize(
    ("gap_after", "complete", "said"),
    [(0.5, 0.9, "below your"), (5.5, 0.6, "close to your"), (9.0, 0.1, "above your")],
)
def test_what_remains_is_set_against_the_threshold(loaded, somewhere, gap_after, complete, said):
    _, found = loaded["rough"]
    quiet = replace(
        as_judged(found, "none", "none"), combination=(), effects=found.effects[-1:],
        completeness=replace(found.completeness, probability=complete, remains={"hub_angle_rad": 0.2}),
    )  # fmt: skip
    view = view_of(quiet, somewhere)
    view.__dict__["shown"] = replace(view.shown, gap_after=gap_after)
    assert said in headline(view)
    assert ("significant" in headline(view)) == (complete >= 0.5)


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "a & b"])
def test_names_of_a_user_are_text_on_a_page(loaded, somewhere, name):
    _, found = loaded["own"]
    drag = replace(found.effects[0], name=name)
    hostile = replace(
        found, case=replace(found.case, name=name), effects=(drag, *found.effects[1:]), combination=(name,),
        probabilities={**found.probabilities, name: 0.9}, repair=(Change(name, {"force_N": 0.3}),),
        doubts=(f"column {name} never changes",),
    )  # fmt: skip
    page = pages.plant_page(hostile, (f"Look at {name}.",), repaired=f"{name}.xml", places=(somewhere,) * 2)
    assert name not in page
    assert escape(name) in page
