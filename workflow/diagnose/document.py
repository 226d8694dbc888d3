"""A diagnosis as JSON: the contract other programs read, and what a resumed run is held to."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from diagnosis.diagnosis import Diagnosis
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.findings import answer_probability, presence_of
from workflow.engine import storage

Real = npt.NDArray[np.float64]

FORMAT = "flexlink-diagnosis-1"
LEAST_SHOWN = 1e-4  # sets of effects less probable than this are left out


def document_of(
    loaded: LoadedCase,
    found: Diagnosis,
    *,
    where: Mapping[str, Any],
    next_experiment: Mapping[str, Any],
    controller: Mapping[str, Any],
) -> dict[str, Any]:
    """The answer as plain values.

    `effects` are all possible answers, best first, "none" and "unknown" among them: `probability` of being
    the main cause (they sum to one), `presence` of being there at all. gap_* are the pooled root mean square
    of (measured - model)/noise over the held-out experiments.
    """
    return {
        "format": FORMAT,
        "case": loaded.case.name,
        "verdict": found.verdict,
        "detail_verdict": found.detail_verdict,
        "effects": [
            {
                "name": effect.name,
                "probability": effect.probability,
                "presence": effect.presence,
                "parameters": dict(effect.parameters),
                "intervals": {key: list(pair) for key, pair in effect.intervals.items()},
                "gap_after": effect.gap_after,
            }
            for effect in found.effects
        ],
        "combination": list(found.combination),
        "ambiguous_with": list(found.ambiguous_with),
        "probability": answer_probability(found),
        "probabilities": dict(found.probabilities),
        "sets": [
            {"effects": list(names), "probability": p}
            for names, p in sorted(found.sets.items(), key=lambda item: -item[1])
            if p >= LEAST_SHOWN
        ],
        "gap_before": found.gap_before,
        "gap_refit": found.gap_refit,
        "gap_after": found.gap_after,
        "noise_floor": found.noise_floor,
        "held_out_decided": found.held_out_decided,
        "unlisted": [effect.to_dict() for effect in found.unlisted],
        "gap_closed": found.gap_closed,
        "gap_closed_interval": list(found.gap_closed_interval),
        "gap_by_experiment": gaps_by_experiment(found),
        "where": dict(where),
        "next_experiment": dict(next_experiment),
        "controller": dict(controller),
        "deviations": dict(found.deviations),
        "repair": {
            "values": {
                key: {"stated": loaded.case.rig.value(key), "repaired": found.rig.value(key)}
                for key in found.deviations
            },
            "effects": [effect.to_dict() for effect in found.repair],
        },
        "suspected": {name: presence_of(found, name) for name in loaded.suspected},
        "rig_file": loaded.rig_file,
        "simulations": found.simulations,
    }


def gaps_by_experiment(found: Diagnosis) -> dict[str, dict[str, float]]:
    """RMS of the residuals over noise of every experiment, both sensors together, for the three models."""
    models = residuals_by_model(found).items()
    return {
        name: {model: float(np.sqrt(np.mean(residuals[name] ** 2))) for model, residuals in models}
        for name in found.residuals_before
    }


def residuals_by_model(found: Diagnosis) -> dict[str, dict[str, Real]]:
    """Residuals (T, 2) over noise of every experiment: rig as stated, values moved, effects added."""
    return {
        "stated": found.residuals_before,
        "refit": found.residuals_refit,
        "repaired": found.residuals_after,
    }


def json_text(document: Mapping[str, Any]) -> str:
    """Strict JSON (nan and infinity as null); equal documents give equal bytes."""
    plain = storage.strict_json(json.loads(json.dumps(document, default=_number)))
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no place in a JSON document")
