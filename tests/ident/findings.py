"""What tests ask of findings; their sentences are those of tests/workflow/test_findings.py."""

from collections.abc import Iterable, Mapping

from ident.data.finding import Finding, FindingKind, Value


def kinds(found: Iterable[Finding]) -> set[FindingKind]:
    return {item.kind for item in found}


def only(found: Iterable[Finding], kind: FindingKind) -> Mapping[str, Value]:
    """The values of the one finding of this kind."""
    (item,) = [item for item in found if item.kind is kind]
    return item.values
