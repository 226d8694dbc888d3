"""A diagnosis as JSON: the contract other programs read, and what a resumed run is held to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnosis.answer import Diagnosis
from diagnosis.where.findings import Where
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.simulator_case import SimulatorCase
from workflow.engine import codec

FORMAT = "flexlink-diagnosis-1"
LEAST_SHOWN = 1e-4  # sets of effects less probable than this are left out, and no runner-up competes


def completeness_of(found: Diagnosis, remains: Where) -> dict[str, Any]:
    """Whether the effects are all, what remains, and between which frequencies most of it lies."""
    run = remains.concentration() if remains.is_gap else None
    mostly = None if run is None else (run.low_Hz, run.high_Hz)
    return {**codec.plain(found.completeness), "mostly_Hz": mostly}


def document_of(
    loaded: LoadedCase | SimulatorCase, found: Diagnosis, beside: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The answer as plain values.

    `effects` are all possible answers, best first, "none" and "unknown" among them: `probability` of being
    the main cause (they sum to one), `presence` of being there at all. `presence` has that of every
    candidate, with its size and the share of the validation error that it explains (interval in `explains`);
    `completeness` says whether that is all. gap_* are the pooled root mean square
    of (measured - model)/noise over the held-out experiments. `repair` comes first: values and effects of the
    repaired model, and in `prediction` what it is worth in logs that nothing was fitted to
    (`diagnosis.answer.Prediction`). partial_model: its effects where the answer is none or unknown.
    beside: what else was looked at.
    """
    document = {
        "format": FORMAT,
        "case": loaded.case.name,
        "repair": {
            "values": {
                key: {"stated": loaded.case.machine.description.value(key), "repaired": found.rig.value(key)}
                for key in found.deviations
            },
            "effects": [effect.to_dict() for effect in found.repair],
            "prediction": found.prediction,
        },
        "verdict": found.verdict,
        "detail_verdict": found.detail_verdict,
        "effects": found.effects,
        "combination": found.combination,
        "presence": {
            effect.name: {
                "probability": effect.presence,
                "parameters": effect.parameters,
                "intervals": effect.intervals,
                "remarks": effect.remarks,
                "explains": effect.explains,
                "needs": effect.untried,
            }
            for effect in found.effects
            if effect.name not in ("none", "unknown")
        },
        "completeness": found.completeness,
        "partial_model": found.partial_model,
        "ambiguous_with": found.ambiguous_with,
        "instead": found.instead,
        "perhaps": found.perhaps,
        "probability": found.probability,
        "probabilities": found.probabilities,
        "sets": [
            {"effects": names, "probability": p}
            for names, p in sorted(found.sets.items(), key=lambda item: -item[1])
            if p >= LEAST_SHOWN
        ],
        "gap_before": found.gap_before,
        "gap_refit": found.gap_refit,
        "gap_after": found.gap_after,
        "noise_floor": found.noise_floor,
        "noise_below_stated": found.noise_below_stated,
        "doubts": found.doubts,
        "held_out_decided": found.held_out_decided,
        "unlisted": [effect.to_dict() for effect in found.unlisted],
        "replayed": found.replayed,
        "units": found.case.units,
        "model_error": getattr(loaded, "model_error", 0.0),
        "validation": [e.name for e in found.case.held_out],
        "gap_closed": found.gap_closed,
        "gap_closed_interval": found.gap_closed_interval,
        "gap_by_experiment": found.gap_by_experiment,
        **(beside or {}),
        **({} if found.shares is None else {"shares": found.shares}),
        "deviations": found.deviations,
        "suspected": {name: found.presence(name) for name in loaded.suspected},
        "rig_file": loaded.rig_file,
        "simulations": found.simulations,
    }
    plain: dict[str, Any] = codec.plain(document)
    return plain
