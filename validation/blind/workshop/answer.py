"""The answer of a workshop case, as the answer files of the labelled ones have it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Literal

from validation.blind.rigs import Rig, rounded
from validation.blind.sizes import Table
from validation.blind.truth import Real
from validation.blind.workshop.machine import Workshop
from validation.blind.workshop.plans import Controller
from validation.blind.workshop.sizes import tolerances_away

Sort = Literal["none", "single", "pair", "unlisted"]
# Share of the motion that does not matter, as every case states it.
MODEL_ERROR = 0.05


def answer_of(
    sort: Sort,
    machine: Workshop,
    closed: bool,
    controller: Controller,
    effects: list[Table],
    designed: dict[str, float],
    sizes: dict[str, Any],
    left: Real,
) -> dict[str, Any]:
    """The label of a workshop case, as the answer files of labelled cases have it.

    Parameters
    ----------
    sort : {"none", "single", "pair", "unlisted"}
    machine : Workshop
    closed : bool
        Whether all records were made in closed loop.
    controller : str
        Which one.
    effects : list of tables
        That are hidden, with their sizes.
    designed : dict
        By effect: its gap over that of the background, as its size was chosen.
    sizes : dict
        Gaps as they came out (`bench.measured_sizes`).
    left : array
        Predicted rms of the background in held-out records, by output.
    """
    hidden = sort == "unlisted"
    noise = machine.noise
    background = asdict(machine.background)
    hub_offset_rad = background.pop("hub_offset_rad")
    del background["encoder_step_rad"]  # which is stated as counts
    entries = []
    for effect in effects if not hidden else ():
        entry: dict[str, Any] = {
            "name": effect["name"],
            "parameters": {k: v for k, v in effect.items() if k != "name"},
        }
        away = tolerances_away(effect, machine.true, machine.tolerances)
        entries.append(entry if away is None else {**entry, "tolerances_away": away})
    true_over_stated = _relative(machine.true, machine.stated, machine.tolerances)
    worst = max(abs(d) / machine.tolerances[key] for key, d in true_over_stated.items())
    verdict = "none"
    if sort != "none":
        verdict = "unknown" if hidden else "effect"
    answer: dict[str, Any] = {
        "verdict": verdict,
        "severity": "none" if sort == "none" else "clear",
        "effects": entries,
        "unlisted": effects if hidden else [],
        "sensor": machine.sensor,
        "closed_loop": closed,
        "controller": controller,
        "nominal": "uncertain",
        "model_error": MODEL_ERROR,
        "oracle_gap_after_major": sizes["pooled_gap"]["held_out_gap_after_oracle"],
        "nominal_worst_tolerances": rounded(worst, 3),
    }
    if effects:
        answer["major_over_background_realised"] = sizes["major_over_background_realised"]
        answer["major_over_background"] = {"unlisted": next(iter(designed.values()))} if hidden else designed
    answer["background"] = {
        **background,
        "transport_delay_s": machine.true["sampling"]["transport_delay_s"],
        "encoder_counts_per_turn": machine.counts,
        "hub_noise_true_over_stated": rounded(noise.hub / machine.stated["sensors"]["hub_angle_noise_rad"]),
        "hub_offset_rad": hub_offset_rad,
        "time_stamp_jitter": noise.jitter,
    }
    if machine.sensor != "none":
        answer["background"] |= {
            "tip_noise_true_over_stated": rounded(noise.tip / list(machine.stated["sensors"].values())[-1]),
            "tip_noise_ar1": noise.correlation,
            "hum_over_tip_noise": noise.hum,
            "hum_Hz": noise.hum_Hz,
        }
    answer["true_minus_nominal_relative"] = true_over_stated
    answer["rms_held_out"] = {
        key: {**numbers, "background_rms_predicted": rounded(float(left[k]))}
        for k, (key, numbers) in enumerate(sizes["rms_held_out"].items())
    }
    answer["pooled_gap"] = sizes["pooled_gap"]
    answer["true_rig"] = machine.true
    return answer


def _relative(true: Rig, stated: Rig, keys: dict[str, float]) -> dict[str, float]:
    """True over stated value, less one, of each key "section.name"."""
    relative = {}
    for key in keys:
        section, name = key.split(".")
        relative[key] = rounded(true[section][name] / stated[section][name] - 1)
    return relative
