"""Peak of the sensitivity on the nonlinear default arm against what was predicted and certified.

The default arm end to end: records with friction, encoder steps, noise, delay and voltage limit; model and
ellipses from them; controller and certificate. Then S is measured on the arm in closed loop: random-phase
multisines as reference (0.5 to 120 rad/s, lines 0.31 rad/s apart, four phase draws of two periods each
after one period of lead-in), error over reference. The lines keep their noise: the largest of many is biased
upwards by about two of the standard deviations stated beside it.

The search of poles is bounded to modes above 30 rad/s and real poles faster than 1/s, as one knows of an arm
whose first mode is near 50 rad/s: with the wider bounds of the shipped configuration the records of some
seeds (2007, 2008) spend a pole on dry friction, and the design then says that it is not certified.

Three peaks are compared: nominal (identified model with the controller), certified (worst case over the 95 %
ellipses), measured. What should agree is measured with nominal, for the arm is one plant of the set, and
measured should not exceed certified by more than its own scatter. What dry friction does at other sizes is
predicted in `benchmarks.friction_in_the_loop`.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Print, main
from control_design.analysis.certificate import Certificate, certify
from control_design.analysis.closed_loop import MeasuredSensitivity, measure_sensitivity
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.synthesis.synthesis import synthesise
from workflow.config.run_config import RunConfig, SimulatedSource, built_in_config
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults
from workflow.tasks.simulated_rig import OUTPUT_NAMES, encoded_arm
from workflow.tasks.stage import StageInput
from workflow.tasks.stages import STAGES
from workflow.text.sentences.certificate import requirement

REACH_PERCENT = 5.0
BAND_RAD_S = (0.5, 120.0)
PERIOD_SAMPLES = 4000
BOUNDS = {"omega_min_rad_s": 30.0, "decay_min_per_s": 1.0}
DRAWS = 4
# Large excitation, rad rms; the records of the fit have 0.5.
LARGE = 0.2
# Small excitation, rad rms.
SMALL = 0.02
PAYLOADS_KG = (0.0, 0.02, 0.04)
BETWEEN_KG = (0.0, 0.01, 0.02, 0.03, 0.04)


def altered(config: RunConfig, *, seed: int | None = None, **effects: dict[str, Any]) -> RunConfig:
    """The configuration with another seed, or with effects of the source added or exchanged by name."""
    document = config.to_document()
    for channel in document["channels"]:
        channel["identification"] = {**channel.get("identification", {}), **BOUNDS}
    if seed is not None:
        document["run"] = {**document.get("run", {}), "seed": seed}
    stated = document["source"].get("effects", [])
    unchanged = [effect for effect in stated if effect["name"] not in effects]
    document["source"]["effects"] = [
        *unchanged,
        *({"name": name, **values} for name, values in effects.items()),
    ]
    return RunConfig.from_document(document, source="default arm")


def identified(config: RunConfig, folder: Path) -> UncertainPlant:
    """The uncertain plant, from records to ellipses."""
    run = RunDirectory(folder).begin_run(
        config_text="", config=config.to_document(), seed=config.run.seed, inputs={}
    )
    results = RunResults(run)
    for stage in STAGES[:3]:
        run.save_stage(stage.name, stage.run(StageInput(config, results, Progress())), "benchmark")
    return results.uncertainty.plant(config)


def designed(plants: list[UncertainPlant], config: RunConfig) -> tuple[Controller, Certificate]:
    """Controller for all plants with the specification of the default arm."""
    design = synthesise(
        plants, config.specification, config.synthesis, rng=np.random.default_rng(config.run.seed)
    )
    return design.controller, certify(design.controller, plants, config.specification)


def nominal_peak(controller: Controller, plant: UncertainPlant) -> float:
    """Largest |S| of the identified nominal on a dense grid."""
    omega = np.geomspace(0.05, plant.nyquist_rad_s, 20_000)
    return float(np.max(1 / np.abs(1 + controller.response(omega) * plant.channel.nominal_response(omega))))


def measured(
    controller: Controller, config: RunConfig, *, rms: float, seed: int, **effects: dict[str, Any]
) -> MeasuredSensitivity:
    """S on the arm of the configuration with further effects."""
    assert isinstance(config.source, SimulatedSource)
    extra = [{"name": name, **values} for name, values in effects.items()]
    arm = encoded_arm(config.source, extra, np.random.default_rng([seed, 1]))
    return measure_sensitivity(
        controller,
        arm,
        np.random.default_rng([seed, 2]),
        rms=rms,
        band_rad_s=BAND_RAD_S,
        period_samples=PERIOD_SAMPLES,
        draws=DRAWS,
        measured_index=OUTPUT_NAMES.index(config.control_channel.output),
    )


def same_plant(out: Print, config: RunConfig, seeds: int, folder: Path) -> None:
    """The arm that was identified: several seeds of records, noise and phases, two sizes of excitation."""
    out("1. The arm that was identified, dry friction 0.02 N m; one design per seed of records and noise")
    out("   off: measured against the nominal prediction, %")
    out("   seed  met?  nominal  certified  measured, 0.2 rad rms       off  measured, 0.02 rad rms      off")
    deviations = []
    for seed in range(2006, 2006 + seeds):
        now = altered(config, seed=seed)
        plant = identified(now, folder / str(seed))
        controller, certificate = designed([plant], now)
        nominal = nominal_peak(controller, plant)
        bound = certificate.plants[0].worst_peak_sensitivity
        large, small = (measured(controller, now, rms=rms, seed=seed) for rms in (LARGE, SMALL))
        off = [100 * (measurement.peak[0] / nominal - 1) for measurement in (large, small)]
        deviations.append(off[0])
        out(
            f"   {seed}  {'yes' if certificate.certified else 'NO':>4}  {nominal:7.4f}  {bound:9.4f}  "
            f"{words(large)}  {off[0]:+6.2f}  {words(small)}  {off[1]:+6.2f}"
        )
    worst = max(deviations, key=abs)
    out(f"   measured against nominal at 0.2 rad rms: worst {worst:+.2f} % (reach: {REACH_PERCENT:g} %)")
    out()


def without_integrator(config: RunConfig) -> RunConfig:
    """The arm under a loop without integral action, in which dry friction leaves errors to predict."""
    asked = {"bandwidth_rad_s": 4.0, "integrator": False, "effort_limit": 60.0, "effort_rolloff_rad_s": 60.0}
    asked |= {"mode_peak_ratio": 0.9, "mode_damping": 0.15, "controller_order": 4}
    specification = config.specification.model_copy(update=asked)
    return config.model_copy(update={"specification": specification})


def several_payloads(out: Print, config: RunConfig, folder: Path) -> None:
    """One controller for three identified payloads, measured on these and between."""
    plants = []
    for mass in PAYLOADS_KG:
        now = altered(config, tip_payload={"mass_kg": mass})
        plant = identified(now, folder / f"payload {mass}")
        plants.append(replace(plant, name=f"{1000 * mass:g} g"))
    # The damping of the modes is checked by a certificate and not designed for: one item less to miss here.
    free = config.specification.model_copy(update={"mode_damping": None})
    controller, certificate = designed(plants, config.model_copy(update={"specification": free}))
    bounds = {verdict.plant: verdict.worst_peak_sensitivity for verdict in certificate.plants}
    out("2. One controller for payloads 0, 20, 40 g (arms identified one by one), measured there and between")
    missed = "; ".join(requirement(item) for item in certificate.items if not item.met)
    verdict = "yes" if certificate.certified else f"NO ({missed or 'not proved between grid points'})"
    out(f"   certified: {verdict}, gamma {certificate.gamma:.4f}")
    out("   payload  certified  measured, 0.2 rad rms     off %")
    worst = 0.0
    for mass in BETWEEN_KG:
        name = f"{1000 * mass:g} g"
        measurement = measured(controller, config, rms=LARGE, seed=7, tip_payload={"mass_kg": mass})
        worst = max(worst, measurement.peak[0])
        bound = bounds.get(name)
        beside = "        -" if bound is None else f"{bound:9.4f}"
        off = "" if bound is None else f"{100 * (measurement.peak[0] / bound - 1):+8.2f}"
        out(f"   {name:>7}  {beside}  {words(measurement)}  {off}")
    largest = max(bounds.values())
    off = 100 * (worst / largest - 1)
    out(f"   worst case: certified {largest:.4f}, achieved {worst:.4f}: {off:+.2f} % (reach: within 5 %)")
    out()


def words(found: MeasuredSensitivity) -> str:
    """Peak, its standard deviation and place."""
    value, std, omega = found.peak
    return f"{value:.4f} +- {std:.4f} at {omega:5.2f}"


def run(out: Print, *, seeds: int = 5) -> None:
    """The two tables."""
    config = without_integrator(built_in_config()[0])
    with tempfile.TemporaryDirectory() as folder:
        same_plant(out, config, seeds, Path(folder))
        several_payloads(out, config, Path(folder))


if __name__ == "__main__":
    main(run, seeds="{seeds} records from 2006, payloads 7")
