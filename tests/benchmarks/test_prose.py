"""The words of README, documents and pages stay short."""

import pytest

from benchmarks import prose

# Of its sentences at most this share is long.
LIMITS = {"README.md": 0.02, "CHANGELOG.md": 0.05, "CONTRIBUTING.md": 0.05}
DOCUMENTS, PAGES = 0.05, 0.01


@pytest.mark.parametrize("name", [*LIMITS, "docs", "templates"])
def test_few_sentences_are_long(name):
    paths = [path for path in prose.files() if name in path.relative_to(prose.ROOT).parts]
    found = [sentence for path in paths for sentence in prose.sentences(path)]
    long = [sentence for sentence in found if len(prose._WORD.findall(sentence)) > prose.LONG]
    assert len(found) > 20
    assert len(long) <= LIMITS.get(name, PAGES if name == "templates" else DOCUMENTS) * len(found), long


def test_no_words_of_our_own():
    found = [sentence for path in prose.files() for sentence in prose.sentences(path)]
    assert not [sentence for sentence in found if prose.OWN.search(sentence)]
    assert prose.OWN.search("Nothing is promised of the arm behind its friction")


def test_a_document_without_full_stops_is_long(tmp_path):
    path = tmp_path / "page.md"
    path.write_text(
        "# A title of four words\n\n" + "word " * 40 + "ends. A short one is here.\n\n| no | prose |\n"
    )
    lengths = [len(prose._WORD.findall(sentence)) for sentence in prose.sentences(path)]
    assert sorted(lengths) == [5, 5, 41]
