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
# Sets of effects less probable than this are left out, and no runner-up competes.
LEAST_SHOWN = 1e-4


def completeness_of(diagnosis: Diagnosis, remains: Where) -> dict[str, Any]:
    """Whether the effects are all, what remains, and between which frequencies most of it lies."""
    mostly_Hz = None
    if remains.is_gap:
        band = remains.concentration()
        if band is not None:
            mostly_Hz = (band.low_Hz, band.high_Hz)
    return {**codec.plain(diagnosis.completeness), "mostly_Hz": mostly_Hz}


def document_of(
    loaded: LoadedCase | SimulatorCase, diagnosis: Diagnosis, beside: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The answer as plain values: what the JSON file of a case holds, in its order.

    `effects` are all possible answers, best first, "none" and "unknown" among them: `probability` of being
    the main cause (they sum to one), `presence` of being there at all. `presence` has that of every
    candidate, with its size and the share of the validation error that it explains (interval in `explains`);
    `completeness` says whether that is all. gap_* are the pooled root mean square
    of (measured - model)/noise over the held-out experiments. `repair` comes first: values and effects of the
    repaired model, and in `prediction` what it is worth in logs that nothing was fitted to
    (`diagnosis.answer.Prediction`). partial_model: its effects where the answer is none or unknown.
    beside: what else was looked at.
    """
    nominal = loaded.case.machine.description
    repaired_values = {}
    for key in diagnosis.deviations:
        repaired_values[key] = {"stated": nominal.value(key), "repaired": diagnosis.rig.value(key)}

    presence = {}
    for effect in diagnosis.effects:
        if effect.name not in ("none", "unknown"):
            presence[effect.name] = {
                "probability": effect.presence,
                "parameters": effect.parameters,
                "intervals": effect.intervals,
                "remarks": effect.remarks,
                "explains": effect.explains,
                "needs": effect.untried,
            }

    by_probability = sorted(diagnosis.sets.items(), key=lambda item: -item[1])
    sets = [{"effects": names, "probability": p} for names, p in by_probability if p >= LEAST_SHOWN]

    # Keys stand in the order of their importance, for whoever opens the file.
    document = {
        "format": FORMAT,
        "case": loaded.case.name,
        "repair": {
            "values": repaired_values,
            "effects": [effect.to_dict() for effect in diagnosis.repair],
            "prediction": diagnosis.prediction,
        },
        "verdict": diagnosis.verdict,
        "detail_verdict": diagnosis.detail_verdict,
        "effects": diagnosis.effects,
        "combination": diagnosis.combination,
        "presence": presence,
        "completeness": diagnosis.completeness,
        "partial_model": diagnosis.partial_model,
        "ambiguous_with": diagnosis.ambiguous_with,
        "instead": diagnosis.instead,
        "perhaps": diagnosis.perhaps,
        "probability": diagnosis.probability,
        "probabilities": diagnosis.probabilities,
        "sets": sets,
        "gap_before": diagnosis.gap_before,
        "gap_refit": diagnosis.gap_refit,
        "gap_after": diagnosis.gap_after,
        "noise_floor": diagnosis.noise_floor,
        "noise_below_stated": diagnosis.noise_below_stated,
        "doubts": diagnosis.doubts,
        "held_out_decided": diagnosis.held_out_decided,
        "unlisted": [effect.to_dict() for effect in diagnosis.unlisted],
        "replayed": diagnosis.replayed,
        "units": diagnosis.case.units,
        "model_error": getattr(loaded, "model_error", 0.0),
        "validation": [e.name for e in diagnosis.case.held_out],
        "gap_closed": diagnosis.gap_closed,
        "gap_closed_interval": diagnosis.gap_closed_interval,
        "gap_by_experiment": diagnosis.gap_by_experiment,
    }
    # Further keys stand where readers of earlier answers have them.
    document |= beside or {}
    if diagnosis.shares is not None:
        document["shares"] = diagnosis.shares
    document |= {
        "deviations": diagnosis.deviations,
        "suspected": {name: diagnosis.presence(name) for name in loaded.suspected},
        "rig_file": loaded.rig_file,
        "simulations": diagnosis.simulations,
    }
    plain: dict[str, Any] = codec.plain(document)
    return plain
