"""What real machines have that their models lack, by the diagnosis of `diagnosis.machine.own_plant`.

Per machine: noise from repeats of one motion, and nothing else set (no model error is stated). Gaps are the
pooled RMS of (measured - model)/noise on held-out records. "closed" is relative to the model as
stated with its values moved.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks import emps_axis, ruler_robot, serial_link_stage
from benchmarks.harness import Print, data_folder, main
from diagnosis import Diagnosis, diagnose, pooled_rms


def tell(out: Print, found: Diagnosis) -> None:
    plant = found.case.plant
    noise = ", ".join(
        f"{name} {value:.3g}" for name, value in zip(plant.output_names, plant.noise, strict=True)
    )
    out(
        f"  noise {noise}; below {100 * found.case.model_error:.0f} % of the motion nothing is named. "
        f"Verdict {found.verdict} ({found.detail_verdict}): {_names(found.combination)}"
    )
    if found.prediction is not None:
        repair = found.prediction
        out(
            f"  repair: {_names(repair.effects)}; moved {', '.join(repair.values) or 'no value'}; error on "
            f"logs not used {repair.error_nominal:.2f} to {repair.error:.2f} (best set tried "
            f"{repair.error_best:.2f}), {repair.unexplained:.3f} of it explained by nothing listed"
        )
        denied = [
            effect.name
            for effect in found.effects
            if effect.name in repair.effects and effect.explains[0] > 0.3 and effect.presence < 0.2
        ]
        out(f"  denied above .8 though it explains more than .3: {', '.join(denied) or 'none'}")
    sets = sorted(found.sets.items(), key=lambda item: -item[1])[:4]
    out("  probable sets: " + "; ".join(f"{_names(names)} {p:.3f}" for names, p in sets))
    if found.ambiguous_with:
        out(f"  not ruled out beside it: {', '.join(found.ambiguous_with)}")
    for effect in found.effects[: max(len(found.combination), 1)]:
        for key, value in effect.parameters.items():
            low, high = effect.intervals[key]
            presence = f"(there with {effect.presence:.3f})"
            out(f"    {effect.name} {presence}: {key} {value:.5g}, 95 % {low:.4g} to {high:.4g}")
    values = [f"{key} {plant.parameters[key]:.4g} -> {v:.4g}" for key, v in found.rig.parameters.items()]
    out("  stated -> repaired: " + "; ".join(values))
    low, high = found.gap_closed_interval
    out(
        f"  held out: gap {found.gap_before:.2f} as stated, {found.gap_refit:.2f} values moved, "
        f"{found.gap_after:.2f} repaired; closed {found.gap_closed:.3f} ({low:.3f} to {high:.3f})"
    )


def _names(names: tuple[str, ...]) -> str:
    return " + ".join(names) if names else "nothing added"


def emps(out: Print, folder: Path) -> None:
    out("EMPS axis: mass with viscous friction refitted to the records, no dry friction, no offset")
    for simulated, refined in (("forces", False), ("forces", True), ("loop", False)):
        for held_out in ("passes", "fast"):
            listed = "; direction and speed dependence of viscous friction listed too" if refined else ""
            out("")
            out(f"{_SIMULATED[simulated]}; {_HELD_OUT[held_out]}{listed}")
            case = emps_axis.case(folder, held_out, simulated, refined=refined)
            diagnosis = diagnose(case)
            tell(out, diagnosis)
            if not refined:
                against_published(out, diagnosis)


_SIMULATED = {
    "forces": "Forces compared (measured motion in, force out)",
    "loop": "Loop simulated (reference in, force out)",
}
_HELD_OUT = {
    "passes": "fitted to passes 1 and 3, judged on 2 and 4 (the same motion again)",
    "fast": "fitted to strokes up to 0.083 m/s, judged on those up to 0.125 m/s (never seen)",
}


def fitted_values(found: Diagnosis) -> dict[str, float]:
    """Values under the published names, nan for what was not accepted."""
    effects = {e.name: e.parameters for e in found.effects if e.name in found.combination}
    return {
        **found.rig.parameters,
        "coulomb_N": effects.get("coulomb_friction", {}).get("force_N", np.nan),
        "offset_N": effects.get("constant_offset", {}).get("force_N", np.nan),
    }


def against_published(out: Print, found: Diagnosis) -> None:
    rows = [
        f"{key} {value:.4g} ({100 * (value / emps_axis.PUBLISHED[key] - 1):+.2f} %)"
        for key, value in fitted_values(found).items()
    ]
    out("  against the published values: " + "; ".join(rows))


def quanser(out: Print, folder: Path) -> None:
    out("")
    out("Quanser serial flexible link, LQR run: manufacturer's model of each stage in the closed loop;")
    out("first 10 s to fit, the same reference again to judge")
    for stage in (1, 2):
        errors = [
            f"{1e3 * serial_link_stage.law_error(folder, stage, w):.1f} mA at {w}"
            for w in (50, 100, 150, 200, 500)
        ]
        out(
            f"  stage {stage}, logged command minus control law, by speed filter [rad/s]: {', '.join(errors)}"
        )
    windows = {1: (150, 1400), 2: (1450, 2650)}
    for stage, window in windows.items():
        diagnosis = diagnose(serial_link_stage.case(folder, stage))
        out("")
        out(f"Stage {stage}")
        tell(out, diagnosis)
        e = diagnosis.case.experiments[0]
        part = slice(*window)
        alpha = e.output[part, 1]
        noise = diagnosis.case.noise[1]
        model = alpha - diagnosis.residuals_before[e.name][part, 1] * noise
        out(
            f"  while only the other stage's reference moves ({window[0] * 0.002:.1f} to "
            f"{window[1] * 0.002:.1f} s): deflection {1e3 * np.std(alpha):.2f} mrad RMS measured, "
            f"{1e3 * np.std(model):.2f} mrad in the stated model"
        )
        current = serial_link_stage.standing(folder, stage)
        out(
            f"  the joint stands (0.3 s within 0.1 mrad) {current.size} times, under commanded currents of "
            f"{current.min():.3f} to {current.max():.3f} A: dry friction; an offset alone would be "
            "one current"
        )


def slfr(out: Print, folder: Path) -> None:
    out("")
    out("SLFR, swept sines of amplitude 50 and 75: no physical nominal exists; stated is a linear fit of the")
    out("third repeat at amplitude 50, every value within 10 %")
    first = [ruler_robot.linear_fit(ruler_robot.record(folder, a, 1)) for a in (50, 75)]
    out("  linear fits of the first repeats, amplitude 50 -> 75:")
    out("    " + "; ".join(f"{k} {first[0][k]:.4g} -> {first[1][k]:.4g}" for k in first[0]))
    for a, fit in zip((50, 75), first, strict=True):
        for b in (50, 75):
            data = ruler_robot.record(folder, b, 2)
            error = ruler_robot.simulate(fit, {}, data[:, :1])[:, 0] - data[:, 1]
            out(f"    fitted at {a}, repeat 2 at {b}: RMS error {np.sqrt(np.mean(error**2)):.3f} counts")
    for fitted in ((50, 75), (50,)):
        diagnosis = diagnose(ruler_robot.case(folder, fitted))
        out("")
        out(f"Fitted at {' and '.join(map(str, fitted))}, judged at both (second repeats)")
        tell(out, diagnosis)
        for e in diagnosis.case.held_out:
            gaps = [pooled_rms(r[e.name]) for r in (diagnosis.residuals_refit, diagnosis.residuals_after)]
            out(f"    {e.name}: gap {gaps[0]:.2f} values moved, {gaps[1]:.2f} repaired")


def run(out: Print, *, only: str = "") -> None:
    folder = data_folder("emps", "quanser_2dsfl", "slfr_krauss_2009")
    for name, tell_of in (("emps", emps), ("quanser", quanser), ("slfr", slfr)):
        if only in ("", name):
            tell_of(out, folder)


if __name__ == "__main__":
    main(run)
