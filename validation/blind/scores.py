"""How good answers are: every row of the accuracy table, with Wilson intervals, and the confusion matrix.

Predictions are documents of `flexlink diagnose` (verdict, effects with probabilities best first, combination,
gap_after), answers are those of the gap cases (verdict, effects with parameters, max_ratio, pooled_gap);
"nominal" in an answer says exact or uncertain and is optional.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from plant.effects import EFFECTS

Document = Mapping[str, Any]

CLEAR, FAINT = 3.0, (0.3, 1.5)
CONFIDENT = 0.8
_BINS = 10
# Closure is a ratio of gaps: with less gap than this (in noise deviations) it says nothing.
_LEAST_GAP = 0.02


@dataclass(frozen=True, eq=False)
class Pair:
    """One case: what was said and what is true."""

    said: Document
    true: Document

    @property
    def kind(self) -> str:
        """none, single, several or unknown."""
        if self.true["verdict"] != "effect":
            return str(self.true["verdict"])
        return "single" if len(self.names) == 1 else "several"

    @property
    def names(self) -> tuple[str, ...]:
        """True effects."""
        return tuple(str(effect["name"]) for effect in self.true.get("effects", ()))

    @property
    def ratio(self) -> float:
        return float(self.true.get("max_ratio", math.nan))

    @property
    def nominal(self) -> str:
        return str(self.true.get("nominal", "exact"))

    @property
    def verdict(self) -> str:
        return str(self.said["verdict"])

    @property
    def first(self) -> str:
        """The answer in one word: none, unknown, or the first effect."""
        if self.verdict != "effect":
            return self.verdict
        named = [e["name"] for e in self.said.get("effects", ()) if e["name"] not in ("none", "unknown")]
        return str(named[0]) if named else "effect"

    @property
    def ranking(self) -> list[str]:
        """Answers, the given one first."""
        order = [self.first, *(str(e["name"]) for e in self.said.get("effects", ()))]
        return list(dict.fromkeys(order))

    @property
    def accepted(self) -> frozenset[str]:
        if self.verdict != "effect":
            return frozenset()
        return frozenset(self.said.get("combination") or (self.first,))

    @property
    def answer(self) -> str:
        """All that was accepted, or the verdict."""
        return " + ".join(sorted(self.accepted)) or self.verdict

    @property
    def probability(self) -> float:
        """Of the first answer; a document that gives none for it is taken to be sure."""
        listed = {str(e["name"]): e.get("probability") for e in self.said.get("effects", ())}
        value = listed.get(self.first)
        if value is None and self.verdict == "none" and listed:
            value = 1.0 - sum(float(p or 0.0) for p in listed.values())
        return 1.0 if value is None else float(value)

    @property
    def first_is_right(self) -> bool:
        """The word is right; with several effects, any of them."""
        if self.kind in ("single", "several"):
            return self.first in self.names
        return self.first == self.kind

    @property
    def all_right(self) -> bool:
        """Verdict and exact set."""
        return self.verdict == self.true["verdict"] and (
            self.verdict != "effect" or self.accepted == frozenset(self.names)
        )


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share, after Wilson (1927); (0, 1) without cases."""
    if count == 0:
        return 0.0, 1.0
    found = binomtest(hits, count).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def scores(predictions: Sequence[Document], answers: Sequence[Document]) -> dict[str, Any]:
    """Everything that can be said about these predictions.

    Returns
    -------
    dict with "table" (slice -> row -> numbers; slices all, exact, uncertain), "confusion" (rows true, columns
    said), "unlisted" (cause -> answers), "several" (cases with more than one effect), "calibration" (bins),
    "wrong" (every case whose first answer is wrong).

    Raises
    ------
    ValueError
        If the two lists do not name the same cases.
    """
    said = {str(p["case"]): p for p in predictions}
    true = {str(a["case"]): a for a in answers}
    if said.keys() != true.keys() or len(said) != len(predictions) or len(true) != len(answers):
        odd = sorted(said.keys() ^ true.keys())
        raise ValueError(
            f"predictions and answers must name the same cases, each once; differing: {', '.join(odd) or '-'}"
        )
    pairs = [Pair(said[name], true[name]) for name in sorted(true)]
    slices = {
        "all": pairs,
        "exact": [p for p in pairs if p.nominal == "exact"],
        "uncertain": [p for p in pairs if p.nominal == "uncertain"],
    }
    return {
        "n_cases": len(pairs),
        "table": {name: _rows(part) for name, part in slices.items()},
        "confusion": _counted(
            (p.names[0] if p.kind == "single" else p.kind, p.first) for p in pairs if p.kind != "several"
        ),
        "unlisted": _counted((_cause(p), p.answer) for p in pairs if p.kind == "unknown"),
        "several": dict(Counter(_set_found(p) for p in pairs if p.kind == "several")),
        "calibration": _calibration(pairs),
        "wrong": [
            {
                "case": p.true["case"],
                "true": " + ".join(p.names) or _cause(p),
                "said": p.answer,
                "probability": p.probability,
                "max_ratio": p.ratio,
                "nominal": p.nominal,
            }
            for p in pairs
            if not p.all_right
        ],
    }


def _rows(pairs: Sequence[Pair]) -> dict[str, Any]:
    single = [p for p in pairs if p.kind == "single"]
    clear = [p for p in single if p.ratio >= CLEAR]
    faint = [p for p in single if FAINT[0] <= p.ratio <= FAINT[1]]
    several = [p for p in pairs if p.kind == "several"]
    listed = single + several
    unlisted = [p for p in pairs if p.kind == "unknown"]
    nothing = [p for p in pairs if p.kind == "none"]
    return {
        "top-1, ratio >= 3": _share([_top(p, 1) for p in clear]),
        "top-2, ratio >= 3": _share([_top(p, 2) for p in clear]),
        "family, ratio >= 3": _share([_family(p) for p in clear]),
        "top-1, ratio 0.3 to 1.5": _share([_top(p, 1) for p in faint]),
        "top-1, every single effect": _share([_top(p, 1) for p in single]),
        "top-2, every single effect": _share([_top(p, 2) for p in single]),
        "family, every single effect": _share([_family(p) for p in single]),
        "false alarms": _share([p.verdict != "none" for p in nothing]),
        "missed effects": _share([p.verdict == "none" for p in listed]),
        "unknown: recall": _share([p.verdict == "unknown" for p in unlisted]),
        "unknown: precision": _share([p.kind == "unknown" for p in pairs if p.verdict == "unknown"]),
        "two effects, exact set": _share([p.all_right for p in several]),
        "two effects, first is one of them": _share([p.first_is_right for p in several]),
        "verdict and set right, every case": _share([p.all_right for p in pairs]),
        "95 % intervals cover": _share([hit for p in listed for hit in _covered(p)]),
        "confident and wrong (p > 0.8)": _share(
            [p.probability > CONFIDENT and not p.first_is_right for p in pairs]
        ),
        "parameter error": _spread([e for p in listed for e in _parameter_errors(p)]),
        "parameter error, ratio >= 3": _spread([e for p in clear for e in _parameter_errors(p)]),
        "gap closed over oracle": _spread([c for p in listed if (c := _closed(p)) is not None]),
        "Brier of the first answer": _mean([(p.probability - p.first_is_right) ** 2 for p in pairs]),
        "expected calibration error": {"value": _calibration_error(pairs), "count": len(pairs)},
        "CPU per case [s]": _spread([float(p.said["cpu_s"]) for p in pairs if "cpu_s" in p.said]),
    }


def _share(hits: Sequence[bool]) -> dict[str, Any]:
    count, right = len(hits), sum(map(bool, hits))
    share = right / count if count else math.nan
    return {"share": share, "hits": right, "count": count, "interval": list(wilson(right, count))}


def _spread(values: Sequence[float]) -> dict[str, Any]:
    if not values:
        return {"median": math.nan, "p10": math.nan, "p90": math.nan, "mean": math.nan, "count": 0}
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return {"median": middle, "p10": low, "p90": high, "mean": float(np.mean(values)), "count": len(values)}


def _mean(values: Sequence[float]) -> dict[str, Any]:
    return {"value": float(np.mean(values)) if values else math.nan, "count": len(values)}


def _top(pair: Pair, depth: int) -> bool:
    """The true effect is among the first answers, and the verdict is that there is one (depth 1)."""
    return bool(set(pair.ranking[:depth]) & set(pair.names))


def _family(pair: Pair) -> bool:
    said, *true = (EFFECTS[name].group if name in EFFECTS else name for name in (pair.first, *pair.names))
    return said in true


def _matches(pair: Pair) -> list[tuple[str, float, float, Any]]:
    """(parameter, true value, estimate, interval) of every effect that was rightly accepted."""
    found = []
    said = {str(e["name"]): e for e in pair.said.get("effects", ())}
    for effect in pair.true.get("effects", ()):
        name = str(effect["name"])
        if name not in pair.accepted or name not in said:
            continue
        for key, value in effect["parameters"].items():
            estimate = (said[name].get("parameters") or {}).get(key)
            if estimate is not None:
                interval = (said[name].get("intervals") or {}).get(key)
                found.append((key, float(value), float(estimate), interval))
    return found


def _off(key: str, value: float, other: float) -> float:
    """Signed difference; of angles the short way round."""
    difference = other - value
    return math.remainder(difference, 2 * math.pi) if key == "phase_rad" else difference


def _parameter_errors(pair: Pair) -> list[float]:
    """Relative to the true value; of a phase, to a full turn."""
    return [
        abs(_off(key, value, estimate)) / (2 * math.pi if key == "phase_rad" else abs(value))
        for key, value, estimate, _ in _matches(pair)
        if key == "phase_rad" or value != 0
    ]


def _covered(pair: Pair) -> list[bool]:
    hits = []
    for key, value, estimate, interval in _matches(pair):
        if interval is not None and all(end is not None for end in interval):
            low, high = (_off(key, estimate, float(end)) for end in interval)
            hits.append(low <= _off(key, estimate, value) <= high)
    return hits


def _closed(pair: Pair) -> float | None:
    """(before - after) / (before - oracle), held-out; before is the true rig without the effect."""
    sizes = pair.true.get("pooled_gap", {})
    before, oracle = sizes.get("held_out_gap_before"), sizes.get("held_out_gap_after_oracle")
    after = pair.said.get("gap_after")
    if before is None or oracle is None or after is None or before - oracle < _LEAST_GAP:
        return None
    return float((before - after) / (before - oracle))


def _calibration(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Ten bins of the first answer's probability: how often it was right."""
    bins = []
    for k in range(_BINS):
        inside = [p for p in pairs if min(int(p.probability * _BINS), _BINS - 1) == k]
        right = _share([p.first_is_right for p in inside])
        said = _mean([p.probability for p in inside])["value"]
        bins.append({"low": k / _BINS, "high": (k + 1) / _BINS, "probability": said, **right})
    return bins


def _calibration_error(pairs: Sequence[Pair]) -> float:
    filled = [b for b in _calibration(pairs) if b["count"]]
    return (
        float(sum(b["count"] * abs(b["share"] - b["probability"]) for b in filled) / len(pairs))
        if pairs
        else math.nan
    )


def _counted(cells: Iterable[tuple[str, str]]) -> dict[str, dict[str, int]]:
    """Row -> column -> how often."""
    table: dict[str, dict[str, int]] = {}
    for (row, column), n in Counter(cells).items():
        table.setdefault(row, {})[column] = n
    return table


def _cause(pair: Pair) -> str:
    hidden = pair.true.get("unlisted") or ()
    return ", ".join(str(e["name"]) for e in hidden) or pair.kind


def _set_found(pair: Pair) -> str:
    """How much of several effects was named."""
    if pair.verdict != "effect":
        return pair.verdict
    if pair.all_right:
        return "exact set"
    common = len(pair.accepted & set(pair.names))
    if common == len(pair.names):
        return "all of them and more"
    return "some of them" if common else "none of them"
