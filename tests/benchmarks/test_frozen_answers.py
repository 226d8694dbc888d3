"""Frozen answers: what counts as moved, what a file keeps, what ends with exit code 1."""

import math

import pytest

from benchmarks import frozen_answers, harness
from benchmarks.frozen_answers import KINDS, Stored, asked, moved, plain
from benchmarks.frozen_questions import QUESTIONS, Question

ANSWER = {
    "said": {"verdict": "effect", "effects": ["backlash"], "order": 6},
    "lines": {"refused": "at 12.3 rad/s its speed is 143 degrees off"},
    "margins": {"gamma": 0.9491, "gain": math.inf},
    "probabilities": {"backlash": 0.97},
}


def off(kind, name, value):
    """Shares of tolerances that are taken when one value of the answer is another one."""
    return [one.share for one in moved(ANSWER, {**ANSWER, kind: {**ANSWER[kind], name: value}})]


def test_an_answer_has_not_moved_from_itself():
    assert moved(ANSWER, ANSWER) == []


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("said", "lines")])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_number_may_move_by_its_tolerance_and_no_further(kind, sign):
    allowed = max(KINDS[kind].relative * 3.0, KINDS[kind].absolute)
    for share in (0.3, 0.99, 1.01, 5.0):
        (one,) = moved({kind: {"x": 3.0}}, {kind: {"x": 3.0 + sign * share * allowed}})
        assert one.share == pytest.approx(share)
        assert one.kind == kind


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("said", "verdict", "none"),
        ("said", "order", 7),
        ("said", "order", 6.0001),
        ("said", "effects", ["backlash", "gravity"]),
        ("margins", "gain", 1e9),
        ("margins", "gamma", math.nan),
        ("margins", "gamma", "0.9491"),
        ("lines", "refused", "at 12.3 rad/s its speed is 143 degrees on"),
        ("lines", "refused", "at 12.3 rad/s its speed is 155 degrees off"),
        ("lines", "refused", "at 12.3 rad/s its speed is -143 degrees off"),
        ("lines", "raises", "ValueError: at 12.3 rad/s"),
    ],
)
def test_what_flips_appears_or_is_said_otherwise_fails(kind, name, value):
    assert max(off(kind, name, value)) > 1


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("lines", "refused", "at 12.4 rad/s its speed is 143 degrees off"),
        ("lines", "refused", "at 12.3 rad/s its speed is 144 degrees off"),
        ("probabilities", "backlash", 0.96),
        ("probabilities", "gravity", 0.03),
    ],
)
def test_what_rounding_moves_does_not(kind, name, value):
    assert 0 < max(off(kind, name, value)) <= 1


def test_what_vanishes_moved():
    (one,) = moved(ANSWER, {**ANSWER, "lines": {}})
    assert one.share == math.inf
    assert str(one).endswith("-> (nothing)")


def test_a_file_gives_back_what_it_was_given(tmp_path):
    stored = Stored(tmp_path / "some.txt")
    stored.put("b | c", ANSWER, 12.34)
    stored.put("a", {"said": {"x": None}}, 0.5)
    stored.put("gone", {"said": {"x": 1}}, 0.5)
    stored.write(["a", "b | c"])
    again = Stored.read(stored.path)
    assert again.answers == {"a": {"said": {"x": None}}, "b | c": ANSWER}
    assert again.cpu_s == {"a": 0.5, "b | c": 12.3}
    # Storing the same again at another pace changes no line.
    text = stored.path.read_text()
    again.put("a", {"said": {"x": None}}, 0.6)
    again.write(["a", "b | c"])
    assert stored.path.read_text() == text


def test_an_error_is_an_answer_and_is_told_where():
    def refuses():
        raise ValueError("two\nlines")

    answer, place = asked(Question(refuses))
    assert answer == {"lines": {"raises": "ValueError: two lines"}}
    assert place.startswith("test_frozen_answers.py:")
    assert max(one.share for one in moved(ANSWER, answer)) > 1
    assert not moved(answer, answer)


@pytest.fixture
def asking(monkeypatch, tmp_path, capsys):
    """Call the benchmark with these answers instead of any question; exit code and lines."""
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    monkeypatch.setattr(frozen_answers, "RESULTS", tmp_path)

    def call(given, *words, needs=()):
        questions = {name: Question(dict, needs) for name in given}
        monkeypatch.setattr(frozen_answers, "QUESTIONS", questions)
        monkeypatch.setattr(
            frozen_answers, "answers", lambda names, *_: ((name, (given[name], "", 1.0)) for name in names)
        )
        code = 0
        try:
            harness.main(frozen_answers.run, list(words), writes=False)
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr().out

    return call


def test_stored_then_asked_again_then_moved(asking, tmp_path):
    code, said = asking({"one": ANSWER})
    assert code == 1
    assert "    it is stored by: python -m benchmarks.frozen_answers --store --only '^one$'\n" in said
    assert asking({"one": ANSWER}, "--store")[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["frozen_answers.txt"]
    assert asking({"one": ANSWER})[0] == 0
    near = {**ANSWER, "margins": {"gamma": 0.9492, "gain": math.inf}}
    code, said = asking({"one": near})
    assert code == 0
    assert "1 values moved within their tolerance" in said
    far = {**ANSWER, "margins": {"gamma": 0.96, "gain": math.inf}}
    code, said = asking({"one": far})
    assert code == 1
    assert "    margins: gamma: 0.9491 -> 0.96\n" in said
    assert "make frozen STORE=1" in said


def test_what_needs_absent_data_is_skipped_and_counted(asking, tmp_path):
    code, said = asking({"one": ANSWER}, needs=(tmp_path / "nowhere",))
    assert code == 0
    assert f"skipped, {tmp_path / 'nowhere'} is not here: one" in said
    assert "0 of 0 questions" in said
    assert "skipped 1;" in said


@pytest.mark.long
def test_questions_are_answered_in_processes_and_one_that_takes_too_long_is_given_up():
    change = "benchmarks.frozen_answers:LONGEST_S=0.3"
    (found,) = frozen_answers.answers(["flexible link A"], 2, change, "")
    assert found[0] == "flexible link A"
    assert found[1][0] == {"lines": {"raises": "no answer after 180 s of CPU"}}
    names = ["forty logs, txt tsv dat gz", "forty logs, npz mat"]
    found = dict(frozen_answers.answers(names, 1, "", ""))
    assert found.keys() == set(names)
    here = {name: plain(QUESTIONS[name].ask()) for name in names}
    assert {name: answer for name, (answer, _, _) in found.items()} == here


def test_every_question_that_needs_what_is_shared_says_so():
    """All others are asked wherever the repository is."""
    assert len(QUESTIONS) >= 80
    shared = [name for name, one in QUESTIONS.items() if one.needs]
    assert 20 <= len(shared) <= len(QUESTIONS) / 2
