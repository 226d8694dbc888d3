"""How good answers are: every row of the accuracy table, with Wilson intervals, and the confusion matrix.

Predictions are documents of `flexlink diagnose` (verdict, effects with probabilities best first, combination,
gap_after), answers are those of the gap cases (verdict, effects with parameters, max_ratio, pooled_gap);
"nominal" in an answer says exact or uncertain and is optional. The ratio of a workshop case is that of the
major effects over what undocumented imperfections leave.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest, norm

from plant.effects import EFFECTS

Document = Mapping[str, Any]

# Family of each effect.
GROUPS: Mapping[str, str] = MappingProxyType({name: effect.group for name, effect in EFFECTS.items()})

# Gap over noise from which on a case counts as clear.
CLEAR = 3.0
# Gaps over noise of faint cases.
FAINT = (0.3, 1.5)
# Probability above which a first answer counts as confident.
CONFIDENT = 0.8
# Bins of probability of the calibration.
_BINS = 10
# Closure is a ratio of gaps: with less gap than this (in noise deviations) it says nothing.
_LEAST_GAP = 0.02


def _case(document: Document, true: Document, groups: Mapping[str, str]) -> dict[str, Any]:
    """One row: the answer to a case beside its label.

    kind: none, single, several or unknown. first: the answer in one word, none, unknown or the first effect.
    accepted: the effects that were; answer: these, or the verdict. probability: of the first answer; a
    document that gives none for it is taken to be sure. first_is_right: the word is; with several effects,
    any of them. all_right: verdict and exact set. top_1, top_2: the true effect is among the first answers.
    errors, covered, standard_errors: of every parameter of an effect that was rightly accepted, see `_off`.
    """
    # The label.
    names = [str(effect["name"]) for effect in true.get("effects", ())]
    kind = str(true["verdict"])
    if kind == "effect":
        kind = "single" if len(names) == 1 else "several"

    # The answer: its first word, what was accepted, and how sure it is.
    verdict = str(document["verdict"])
    effects = {str(e["name"]): e for e in document.get("effects", ())}
    first = verdict
    if verdict == "effect":
        first = next((name for name in effects if name not in ("none", "unknown")), "effect")
    accepted = frozenset[str]()
    if verdict == "effect":
        accepted = frozenset(document.get("combination") or (first,))
    probability = effects.get(first, {}).get("probability")
    if probability is None and verdict == "none" and effects:
        probability = 1.0 - sum(float(e.get("probability") or 0.0) for e in effects.values())
    ranking = list(dict.fromkeys([first, *effects]))
    family, *families = (groups.get(name, name) for name in (first, *names))
    hidden = ", ".join(str(e["name"]) for e in true.get("unlisted") or ())

    # Parameters of effects that were rightly accepted.
    errors = []
    covered = []
    standard_errors = []
    for effect in true.get("effects", ()):
        answered = effects.get(effect["name"])
        if effect["name"] not in accepted or answered is None:
            continue
        for key, number in effect["parameters"].items():
            value = float(number)
            estimate = (answered.get("parameters") or {}).get(key)
            if estimate is None:
                continue
            estimate = float(estimate)
            if key == "phase_rad" or value:
                errors.append(_error(key, value, estimate))
            interval = (answered.get("intervals") or {}).get(key)
            if interval is not None and None not in interval:
                covered.append(_inside(key, value, estimate, interval))
                standard_errors.append(_standard_error(key, value, estimate, interval))
    return {
        "case": true["case"],
        "nominal": str(true.get("nominal", "exact")),
        "ratio": float(true.get("max_ratio", true.get("major_over_background_realised", math.nan))),
        "kind": kind,
        "true": " + ".join(names) or hidden or kind,
        "verdict": verdict,
        "first": first,
        "answer": " + ".join(sorted(accepted)) or verdict,
        "probability": 1.0 if probability is None else float(probability),
        "first_is_right": first in names if kind in ("single", "several") else first == kind,
        "all_right": verdict == true["verdict"] and (verdict != "effect" or accepted == frozenset(names)),
        "top_1": first in names,
        "top_2": bool(set(ranking[:2]) & set(names)),
        "family": family in families,
        "common": len(accepted & set(names)) / max(len(names), 1),
        "errors": errors,
        "covered": covered,
        "standard_errors": standard_errors,
        "closed": _closed(document, true),
        "cpu_s": document.get("cpu_s"),
    }


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share, after Wilson (1927); (0, 1) without cases."""
    if count == 0:
        return 0.0, 1.0
    interval = binomtest(hits, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def scores(
    predictions: Sequence[Document], answers: Sequence[Document], groups: Mapping[str, str] = GROUPS
) -> dict[str, Any]:
    """Everything that can be said about these predictions.

    Parameters
    ----------
    predictions, answers : sequences of mappings
        Documents of diagnoses, and labels, of the same cases.
    groups : mapping of str to str
        Family of each effect.

    Returns
    -------
    dict
        With "table" (slice -> row -> numbers; slices all, exact, uncertain), "confusion" (rows true, columns
        said), "unlisted" (cause -> answers), "several" (cases with more than one effect), "calibration"
        (bins), "wrong" (every case whose first answer is wrong).

    Raises
    ------
    ValueError
        The two lists do not name the same cases, each once.
    """
    predicted = {str(p["case"]): p for p in predictions}
    true = {str(a["case"]): a for a in answers}
    if predicted.keys() != true.keys() or len(predicted) != len(predictions) or len(true) != len(answers):
        odd = sorted(predicted.keys() ^ true.keys())
        raise ValueError(
            f"predictions and answers must name the same cases, each once; differing: {', '.join(odd) or '-'}"
        )
    cases = pd.DataFrame([_case(predicted[name], true[name], groups) for name in sorted(true)])
    several = cases[cases.kind == "several"]
    unknown = cases[cases.kind == "unknown"]
    named = cases[cases.kind != "several"]
    columns = ["case", "true", "answer", "probability", "ratio", "nominal"]
    wrong = cases.loc[~cases.all_right, columns]
    return {
        "n_cases": len(cases),
        "table": {
            "all": _rows(cases),
            "exact": _rows(cases[cases.nominal == "exact"]),
            "uncertain": _rows(cases[cases.nominal == "uncertain"]),
        },
        "confusion": _counted(named.true.where(named.kind == "single", named.kind), named["first"]),
        "unlisted": _counted(unknown.true, unknown.answer),
        "several": dict(Counter(_set_found(case) for case in several.itertuples())),
        "calibration": _calibration(cases),
        "wrong": wrong.rename(columns={"answer": "said", "ratio": "max_ratio"}).to_dict("records"),
    }


def _rows(cases: pd.DataFrame) -> dict[str, Any]:
    """Rows of the accuracy table for these cases."""
    single = cases[cases.kind == "single"]
    several = cases[cases.kind == "several"]
    clear = single[single.ratio >= CLEAR]
    faint = single[single.ratio.between(*FAINT)]
    listed = pd.concat([single, several])
    unlisted = cases[cases.kind == "unknown"]
    nothing = cases[cases.kind == "none"]
    return {
        "top-1, ratio >= 3": _share(clear.top_1),
        "top-2, ratio >= 3": _share(clear.top_2),
        "family, ratio >= 3": _share(clear.family),
        "top-1, ratio 0.3 to 1.5": _share(faint.top_1),
        "top-1, every single effect": _share(single.top_1),
        "top-2, every single effect": _share(single.top_2),
        "family, every single effect": _share(single.family),
        "false alarms": _share(nothing.verdict != "none"),
        "missed effects": _share(listed.verdict == "none"),
        "unknown: recall": _share(unlisted.verdict == "unknown"),
        "unknown: precision": _share(cases.kind[cases.verdict == "unknown"] == "unknown"),
        "two effects, exact set": _share(several.all_right),
        "two effects, first is one of them": _share(several.first_is_right),
        "verdict and set right, every case": _share(cases.all_right),
        "95 % intervals cover": _share(chain(*listed.covered)),
        "95 % intervals, width over spread of errors": _width_over_spread(chain(*listed.standard_errors)),
        "confident and wrong (p > 0.8)": _share((cases.probability > CONFIDENT) & ~cases.first_is_right),
        "parameter error": _spread(chain(*listed.errors)),
        "parameter error, ratio >= 3": _spread(chain(*clear.errors)),
        "gap closed over oracle": _spread(listed.closed.dropna()),
        "Brier of the first answer": _mean((cases.probability - cases.first_is_right) ** 2),
        "expected calibration error": {"value": _calibration_error(cases), "count": len(cases)},
        "CPU per case [s]": _spread(cases.cpu_s.dropna()),
    }


def _share(hits: Iterable[bool]) -> dict[str, Any]:
    outcomes = list(hits)
    count = len(outcomes)
    right = sum(map(int, outcomes))
    share = right / count if count else math.nan
    return {"share": share, "hits": right, "count": count, "interval": list(wilson(right, count))}


def _spread(numbers: Iterable[float]) -> dict[str, Any]:
    values = [float(value) for value in numbers]
    if not values:
        return {"median": math.nan, "p10": math.nan, "p90": math.nan, "mean": math.nan, "count": 0}
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"median": middle, "p10": low, "p90": high, "mean": float(np.mean(values)), "count": len(values)}


def _mean(values: pd.Series) -> dict[str, Any]:
    value = float(np.mean(values.to_numpy(dtype=np.float64))) if len(values) else math.nan
    return {"value": value, "count": len(values)}


def _off(key: str, value: float, other: float) -> float:
    """Signed difference; of angles the short way round."""
    difference = other - value
    return math.remainder(difference, 2 * math.pi) if key == "phase_rad" else difference


def _error(key: str, value: float, estimate: float) -> float:
    """Relative to the true value; of a phase, to a full turn."""
    return abs(_off(key, value, estimate)) / (2 * math.pi if key == "phase_rad" else abs(value))


def _inside(key: str, value: float, estimate: float, interval: Sequence[float]) -> bool:
    low, high = (_off(key, estimate, float(end)) for end in interval)
    return low <= _off(key, estimate, value) <= high


def _standard_error(key: str, value: float, estimate: float, interval: Sequence[float]) -> float:
    """Error in standard deviations as a 95 % interval states them; infinite for an interval without width."""
    half_width = abs(_off(key, float(interval[0]), float(interval[1]))) / 2
    if not half_width:
        return math.inf
    return float(abs(_off(key, value, estimate)) / half_width * norm.ppf(0.975))


def _width_over_spread(standard_errors: Iterable[float]) -> dict[str, Any]:
    """How many times wider intervals are than errors spread: 1 for a normal error that is stated rightly.

    The spread is the median of the sizes, in that of a standard normal error (.674).
    """
    sizes = list(standard_errors)
    typical = float(np.median(sizes)) if sizes else math.nan
    return {"value": norm.ppf(0.75) / typical if typical else math.inf, "count": len(sizes)}


def _closed(document: Document, true: Document) -> float | None:
    """(before - after) / (before - oracle), held-out; before is the true rig without the effect."""
    sizes = true.get("pooled_gap", {})
    before = sizes.get("held_out_gap_before")
    oracle = sizes.get("held_out_gap_after_oracle")
    after = document.get("gap_after")
    if before is None or oracle is None or after is None or before - oracle < _LEAST_GAP:
        return None
    return float((before - after) / (before - oracle))


def _calibration(cases: pd.DataFrame) -> list[dict[str, Any]]:
    """Ten bins of the first answer's probability: how often it was right."""
    bins = []
    place = (cases.probability * _BINS).astype(int).clip(upper=_BINS - 1)
    for k in range(_BINS):
        inside = cases[place == k]
        probability = _mean(inside.probability)["value"]
        right = _share(inside.first_is_right)
        bins.append({"low": k / _BINS, "high": (k + 1) / _BINS, "probability": probability, **right})
    return bins


def _calibration_error(cases: pd.DataFrame) -> float:
    filled = [b for b in _calibration(cases) if b["count"]]
    gaps = [b["count"] * abs(b["share"] - b["probability"]) for b in filled]
    return float(sum(gaps) / len(cases)) if len(cases) else math.nan


def _counted(rows: pd.Series, columns: pd.Series) -> dict[str, dict[str, int]]:
    """Row -> column -> how often."""
    table: dict[str, dict[str, int]] = {}
    for (row, column), n in Counter(zip(rows, columns, strict=True)).items():
        table.setdefault(row, {})[column] = n
    return table


def _set_found(case: Any) -> str:
    """How much of several effects was named."""
    if case.verdict != "effect":
        return str(case.verdict)
    if case.all_right:
        return "exact set"
    if case.common == 1:
        return "all of them and more"
    return "some of them" if case.common else "none of them"
