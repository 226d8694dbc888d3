"""A finding in words: its sentence, found by its kind in one dictionary."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

from ident.data.finding import Finding, FindingKind
from workflow.text.findings import distortion, poles, priors, records, residuals

# The function of every kind; its parameters are the values that the sentence is made with.
SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    **poles.SENTENCES,
    **records.SENTENCES,
    **priors.SENTENCES,
    **residuals.SENTENCES,
    **distortion.SENTENCES,
}


def words(finding: Finding) -> str:
    """Return the sentence that says what ident found, on one line.

    Values that the sentence does not name are left out; TypeError where one is missing that it needs.
    """
    sentence = SENTENCES[finding.kind]
    needed = inspect.signature(sentence).parameters
    values = {name: value for name, value in finding.values.items() if name in needed}
    return " ".join(sentence(**values).split())
