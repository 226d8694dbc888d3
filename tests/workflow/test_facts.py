"""A fact is worded once: the same row for a terminal, a page, the JSON answer and a study."""

import pytest

from workflow.describe.facts import Bound, Quantity, Row, Section, answer, by_key


def test_a_bound_is_rounded_to_its_safe_side():
    assert Quantity.of(0.54999, bound=Bound.AT_LEAST).text == "at least 0.549"
    assert Quantity.of(3.1201, "V", bound=Bound.AT_MOST).text == "at most 3.13 V"


def test_what_is_not_there_is_said_in_words_and_is_none_for_programs():
    never = Quantity.of(None, "s")
    assert (never.text, never.plain) == ("never", None)
    # JSON knows no infinity.
    assert Quantity.of(float("inf"), "dB").plain is None


def test_the_answer_nests_rows_of_all_parts_at_the_dots_of_their_keys():
    margin = Row("certificate.modulus_margin", "modulus margin", Quantity.of(0.55))
    settled = Row("closed_loop.settled", "settles", Quantity.words("20 of 20"))
    unkeyed = Row("", "covers", Quantity.words("the linear dynamics"))
    part = Section("all", rows=(settled,))
    sections = [Section("certificate", rows=(margin, unkeyed), parts=(part,))]
    assert answer(sections) == {
        "certificate": {"modulus_margin": 0.55},
        "closed_loop": {"settled": "20 of 20"},
    }
    assert by_key(sections)["closed_loop.settled"] is settled


@pytest.mark.parametrize("second", ["design.gamma", "design.gamma.worst"])
def test_no_row_hides_another(second):
    rows = tuple(Row(key, "worst case", Quantity.of(0.9)) for key in ("design.gamma", second))
    with pytest.raises(ValueError, match="key"):
        answer([Section("design", rows=rows)])
