"""Sentences on what was stated as known, and on questions that were left to the data.

Each function takes the values of its kind by name. `prior` is what was stated, as "integrators = 1";
`refused` whether the data refuse it, `imposed` whether the model keeps to it all the same; `statistic`,
`limit` and `level` (a probability) are of the test that decided.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ident.data.finding import FindingKind
from workflow.text import formats
from workflow.text.options import prior_name, setting_name


def _test(statistic: float, limit: float, level: float) -> str:
    """The test that decided, in brackets."""
    return f"(test statistic {statistic:.1f} against {limit:.1f} at {formats.share(level)})"


def _verdict(prior: str, refused: bool, imposed: bool, alternative: str, test: str, advice: str) -> str:
    """What the data say of a prior.

    alternative: what they were offered in its place; advice: what to do about one that is refused and kept.
    """
    stated = prior_name(prior)
    if not refused:
        return f"{stated} accepted: {alternative} fits no better {test}"
    consequence = f"kept as specified, but {advice}" if imposed else "not imposed"
    return f"{stated} refused by the data: {alternative} fits significantly better {test}; {consequence}"


def nuisance(name: str, needed: bool, columns: int, statistic: float, limit: float, level: float) -> str:
    """name: of what is estimated beside the model, as an offset; columns: its unknowns."""
    verdict = "estimated, as it improves the fit" if needed else "not estimated: no better fit"
    test = _test(statistic, limit, level).removeprefix("(")
    return f"{name} {verdict} ({columns} unknowns, {test}"


def integrators(
    prior: str, refused: bool, imposed: bool, statistic: float, limit: float, level: float, accepted: int
) -> str:
    """accepted: how many the data accept. A motor shaft integrates by its mechanics, and dry friction still
    makes it look like a slow pole."""
    accept = ", which the data accept" if accepted else ""
    return _verdict(
        prior,
        refused,
        imposed,
        "a slow pole in place of each",
        _test(statistic, limit, level),
        "a wrong one spoils all that is slow and can lose a mode: set "
        f"{setting_name('integrators', accepted)}{accept}; or keep it if the mechanics say so, dry friction "
        "looks "
        "the same, and fit in a band above it",
    )


def spare_integrators(prior: str, statistic: float, limit: float, enough: int) -> str:
    """enough: integrators with which the fit is as good."""
    return (
        f"{prior_name(prior)} not supported by the data: the fit is as good with {enough} (test statistic "
        f"{statistic:.1f} against {limit:.1f}, the price of a pole). Zeros of the model cancel the rest; "
        f"kept as specified, but set {setting_name('integrators', enough)}"
    )


def fixed_poles(
    prior: str, refused: bool, imposed: bool, statistic: float, limit: float, level: float, free_poles: str
) -> str:
    """free_poles: where they go when they are left free."""
    return _verdict(
        prior,
        refused,
        imposed,
        f"leaving them free (poles at {free_poles})",
        _test(statistic, limit, level),
        "leave them to the search, or check sampling time and units; a basis of your own (Laguerre, Kautz) "
        "is "
        "meant to differ from the plant, and more of its poles bring the fit nearer",
    )


def delay(
    prior: str, refused: bool, imposed: bool, statistic: float, limit: float, level: float, other_delay: int
) -> str:
    """other_delay: samples, with which the data were compared."""
    samples = "sample" if other_delay == 1 else "samples"
    return _verdict(
        prior,
        refused,
        imposed,
        f"a delay of {other_delay} {samples}",
        _test(statistic, limit, level),
        f"set {setting_name('input_delay_samples', other_delay)}, and look for the sample of delay in the "
        "time "
        "stamps",
    )


def dead_time(
    delay: int,
    delay_ms: float,
    partial: bool,
    low: int,
    high: int,
    order: int,
    order_without: int,
    gain: float,
) -> str:
    """delay, low, high: samples, found and those that fit alike; partial: the true one lies between two;
    order, order_without: poles with and without it; gain: by which the criterion is worse without."""
    if partial:
        certainty = f"the true delay lies between {delay} and {delay + 1} samples"
    elif low == high:
        certainty = "one sample more or less fits worse than chance allows"
    else:
        certainty = f"{low} to {high} samples fit alike"
    return (
        f"delay {formats.count(delay, 'sample')} ({formats.number(delay_ms, 4)} ms), found in the data: "
        f"{certainty}; without a delay {formats.count(order_without, 'pole')} would be needed in place of "
        f"{order}, and the criterion is {gain:.3g} worse"
    )


def deadbeat(poles: int, delay: int) -> str:
    """poles: how many decay within a sample; delay: samples to compare with."""
    return (
        f"{formats.count(poles, 'pole')} of the model decay within a sample: they stand for dead time or a "
        f"fast filter; compare with {setting_name('input_delay_samples', delay)}"
    )


def answers_at_once(statistic: float, limit: float, level: float) -> str:
    return (
        "the output answers in the same sample as the input, the model does not "
        f"{_test(statistic, limit, level)}. Fit a direct term with {setting_name('feedthrough', 'true')}, or "
        "look for a sample by which the input is logged late"
    )


def direct_term(
    prior: str, refused: bool, imposed: bool, statistic: float, limit: float, level: float
) -> str:
    return _verdict(
        prior,
        refused,
        imposed,
        "a model with a direct term",
        _test(statistic, limit, level),
        f"set {setting_name('feedthrough', 'true')} and leave out {setting_name('relative_degree')}, or "
        "check "
        "whether the input runs late",
    )


def relative_degree(
    prior: str, refused: bool, imposed: bool, statistic: float, limit: float, level: float, one_less: int
) -> str:
    return _verdict(
        prior,
        refused,
        imposed,
        "a numerator without that limit",
        _test(statistic, limit, level),
        f"set {setting_name('relative_degree', one_less)} or leave it out (a sample of delay, a filter in "
        "the "
        "sensor or an input that is not held constant between samples blurs it)",
    )


def too_few_poles(prior: str, order: int) -> str:
    return (
        f"{prior_name(prior)} not imposed: the model has only {order} poles, integrators counted; state "
        f"{setting_name('n_real')} and {setting_name('n_pairs')}, or record more"
    )


SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    FindingKind.NUISANCE: nuisance,
    FindingKind.INTEGRATORS: integrators,
    FindingKind.SPARE_INTEGRATORS: spare_integrators,
    FindingKind.FIXED_POLES: fixed_poles,
    FindingKind.DELAY: delay,
    FindingKind.DEAD_TIME: dead_time,
    FindingKind.DEADBEAT: deadbeat,
    FindingKind.ANSWERS_AT_ONCE: answers_at_once,
    FindingKind.DIRECT_TERM: direct_term,
    FindingKind.RELATIVE_DEGREE: relative_degree,
    FindingKind.TOO_FEW_POLES: too_few_poles,
}
