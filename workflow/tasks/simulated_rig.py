"""The simulated arm as a configuration describes it: rig file or preset, effects by name, experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ident.data.record import Record
from plant.effects import parse_effects
from plant.rig import Rig
from plant.simulation import SampledArm, simulate
from workflow.config.rig_settings import PRESETS, read_rig
from workflow.config.run_config import ClosedLoopOptions, RunConfig, SimulatedRecord, SimulatedSource
from workflow.engine.randomness import stage_rng
from workflow.tasks.sampled_plant import FINITE, ClippedMachine

INPUT_NAME = "voltage_V"
OUTPUT_NAMES = SampledArm.output_names
UNITS = {"voltage_V": "V", "hub_angle_rad": "rad", "tip_m": "m"}


def rig_of(source: SimulatedSource) -> Rig:
    """The nominal rig. Raises ValueError (one line) or OSError for a rig file that cannot be read."""
    if isinstance(source.rig, str) and source.rig in PRESETS:
        return PRESETS[source.rig]()
    return read_rig(Path(source.rig))


def simulate_record(source: SimulatedSource, entry: SimulatedRecord, seed: int) -> Record:
    """Run one experiment on the rig with the effects of the source.

    The record has the commanded voltage, and hub angle (in encoder steps) and tip position as measured, from
    rest. Excitation and sensor noise have random streams of their own, keyed by the record's name: a record
    stays as it is when others come or go.
    """
    rig = rig_of(source)
    voltage = entry.excitation.signal(rig.sampling.dt_s, stage_rng(seed, "records", entry.name, "excitation"))
    trajectory = simulate(
        rig,
        voltage,
        parse_effects(source.effects),
        rng=stage_rng(seed, "records", entry.name, "noise"),
        n_modes=source.modes,
    )
    return Record(
        name=entry.name,
        input=trajectory.voltage_V[:, None],
        output=quantised(trajectory.output, source.encoder_step_rad),
        dt_s=rig.sampling.dt_s,
        input_names=(INPUT_NAME,),
        output_names=OUTPUT_NAMES,
        input_units=(UNITS[INPUT_NAME],),
        output_units=tuple(UNITS[name] for name in OUTPUT_NAMES),
    )


def quantised(output: npt.NDArray[np.float64], encoder_step_rad: float) -> npt.NDArray[np.float64]:
    """(..., 2) measured outputs with the hub angle rounded to encoder steps (0 = no encoder)."""
    if encoder_step_rad == 0:
        return output
    result = output.copy()
    result[..., 0] = encoder_step_rad * np.rint(output[..., 0] / encoder_step_rad)
    return result


class EncodedArm(SampledArm):
    """The simulated arm behind its encoder: the measured hub angle comes in encoder steps.

    extra_effects: take the place of those of the source that have their names. tip_force_N (T,): acts at the
    tip, one value per sample from rest on.
    """

    def __init__(
        self,
        source: SimulatedSource,
        extra_effects: Sequence[Mapping[str, Any]],
        rng: np.random.Generator,
        *,
        rig: Rig | None = None,
        tip_force_N: npt.NDArray[np.float64] | None = None,
    ) -> None:
        self._step, self._force = source.encoder_step_rad, tip_force_N
        replaced = {effect["name"] for effect in extra_effects}
        kept = [effect for effect in source.effects if effect["name"] not in replaced]
        effects = parse_effects((*kept, *extra_effects))
        super().__init__(rig or rig_of(source), effects, rng, n_modes=source.modes)

    def reset(self) -> None:
        super().reset()
        self._forces = iter(() if self._force is None else self._force.tolist())

    def measure(self) -> npt.NDArray[np.float64]:
        output = super().measure()
        if self._step:
            output[0] = self._step * np.rint(output[0] / self._step)
        return output

    def advance(self, voltage_V: float, hub_torque_Nm: float = 0.0, tip_force_N: float = 0.0) -> None:
        super().advance(voltage_V, hub_torque_Nm, tip_force_N + next(self._forces, 0.0))


def converter_steps(options: ClosedLoopOptions) -> dict[str, float]:
    """Steps of the loop's converters, as `control_design.analysis.closed_loop` calls them."""
    return {"measurement_step": options.measurement_step, "command_step": options.quantisation}


def loop_of_arm(
    config: RunConfig,
    rng: np.random.Generator,
    effects: Sequence[Mapping[str, Any]] = (),
    rig: Rig | None = None,
) -> dict[str, Any]:
    """Keywords of `simulate` and `measure_sensitivity` for the simulated arm of a run: the machine with
    further effects, which output is measured, and the steps of the converters."""
    assert isinstance(config.source, SimulatedSource)  # or the configuration had been refused
    return {
        "machine": ClippedMachine(EncodedArm(config.source, effects, rng, rig=rig), FINITE),
        "measured_index": OUTPUT_NAMES.index(config.control_channel.output),
        **converter_steps(config.closed_loop),
    }
