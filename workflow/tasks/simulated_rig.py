"""The simulated arm as a configuration describes it: rig file or preset, effects by name, experiments; and
`truth.json` beside its logs, with the modes of the arm behind them, shown beside what is found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from control_design.analysis.closed_loop import simulate as simulate_loop
from control_design.controllers.controller import Controller
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.data.record import Record
from plant.effects import make_machine, parse_effects
from plant.modal import default_n_modes, equations_of_motion
from plant.rig import Rig
from plant.simulation import SampledArm, quantised, simulate
from workflow.config.rig_settings import rig_called
from workflow.config.run_config import (
    ClosedLoopOptions,
    RunConfig,
    SimulatedRecord,
    SimulatedSource,
    SimulationConfig,
)
from workflow.config.settings import Section, check
from workflow.engine import documents
from workflow.engine.errors import naming
from workflow.engine.randomness import stage_rng
from workflow.tasks.results import IdentifiedChannel
from workflow.tasks.sampled_plant import FINITE

# Columns of a simulated log.
INPUT_NAME = "voltage_V"
# Its reference, where the arm was simulated in a loop.
REFERENCE_NAME = "reference_rad"
# Its outputs: hub angle and tip.
OUTPUT_NAMES = SampledArm.output_names
# Units of these columns.
UNITS = {"voltage_V": "V", "hub_angle_rad": "rad", "tip_m": "m"}


def rig_of(source: SimulatedSource) -> Rig:
    """The nominal rig. Raises InputError for a rig file that cannot be read."""
    return rig_called(source.rig)


def simulate_record(source: SimulatedSource, entry: SimulatedRecord, seed: int) -> Record:
    """Run one experiment on the rig with the effects of the source.

    The record has the commanded voltage, hub angle (in encoder steps) and tip position as measured, from
    rest, and the reference where the source has a loop. Excitation and sensor noise have random streams of
    their own, keyed by the record's name: a record stays as it is when others come or go.
    """
    rig = rig_of(source)
    dt_s = rig.sampling.dt_s
    rng = stage_rng(seed, "records", entry.name, "noise")
    voltage = entry.excitation.signal(dt_s, stage_rng(seed, "records", entry.name, "excitation"))
    reference = None
    if source.loop is None:
        output = simulate(rig, voltage, parse_effects(source.effects), rng=rng, n_modes=source.modes).output
        output = quantised(output, source.encoder_step_rad)
    else:
        slope = source.loop.derivative_Vs_per_rad / dt_s
        # In z: K = proportional + slope (1 - 1/z), whose one state is the last error.
        proportional = source.loop.proportional_V_per_rad
        law = Controller(
            np.zeros((1, 1)),
            np.ones((1, 1)),
            np.array([[-slope]]),
            np.array([[proportional + slope]]),
            dt_s,
            computational_delay_samples=0,
            input_limit=source.input_limit,
        )
        reference = source.loop.reference_rad_per_V * voltage
        ran = simulate_loop(law, encoded_arm(source, (), rng), reference)
        voltage = ran.command
        output = ran.output
    return Record(
        name=entry.name,
        input=voltage[:, None],
        output=output,
        dt_s=dt_s,
        input_names=(INPUT_NAME,),
        output_names=OUTPUT_NAMES,
        input_units=(UNITS[INPUT_NAME],),
        output_units=tuple(UNITS[name] for name in OUTPUT_NAMES),
        reference=None if reference is None else reference[:, None],
        reference_names=() if reference is None else (REFERENCE_NAME,),
    )


def simulated_records(
    config: RunConfig | SimulationConfig,
    called: str,
    progress: Callable[[float, str], None] = lambda share, name: None,
) -> list[Record]:
    """Every record of a configuration whose records are those of the simulated arm.

    Parameters
    ----------
    config : RunConfig or SimulationConfig
    called : str
        What a complaint calls the configuration.
    progress : callable
        Called with the share that is done and the name of the record that is made next.

    Raises
    ------
    InputError
        One line that names the entry.
    """
    source = config.source
    # Nobody asks where the records are files.
    assert isinstance(source, SimulatedSource)
    make = partial(simulate_record, source, seed=config.run.seed)
    return made_one_by_one(source.records, make, f"{called}: source.records", progress)


def made_one_by_one(
    entries: Sequence[Any],
    make: Callable[[Any], Record],
    called: str,
    progress: Callable[[float, str], None],
) -> list[Record]:
    """A record for each entry of a list in a configuration.

    Parameters
    ----------
    entries : sequence
        Each has a name.
    make : callable
        Makes the record of an entry.
    called : str
        What a complaint calls the list.
    progress : callable
        Called with the share that is done and the name of the record that is made next.

    Raises
    ------
    InputError
        One line that names the entry.
    """
    made = list[Record]()
    for index, entry in enumerate(entries):
        progress(index / len(entries), entry.name)
        with naming(f"{called}[{index}] ({entry.name})"):
            made.append(make(entry))
    return made


def encoded_arm(
    source: SimulatedSource,
    extra_effects: Sequence[Mapping[str, Any]],
    rng: np.random.Generator,
    *,
    rig: Rig | None = None,
    tip_force_N: npt.NDArray[np.float64] | None = None,
) -> SampledArm:
    """The simulated arm behind its encoder.

    Parameters
    ----------
    source : SimulatedSource
    extra_effects : sequence of mappings
        Take the place of the source's effects that have their names.
    rng : Generator
        Of the sensor noise.
    rig : Rig, optional
        In place of the source's.
    tip_force_N : (T,) array, optional
        A force at the tip.
    """
    replaced = {effect["name"] for effect in extra_effects}
    unchanged = [effect for effect in source.effects if effect["name"] not in replaced]
    return SampledArm(
        rig or rig_of(source),
        parse_effects((*unchanged, *extra_effects)),
        rng,
        n_modes=source.modes,
        encoder_step_rad=source.encoder_step_rad,
        tip_force_N=tip_force_N,
    )


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
    # Any other source was refused with the configuration.
    assert isinstance(config.source, SimulatedSource)
    return {
        "machine": encoded_arm(config.source, effects, rng, rig=rig),
        "clip": FINITE,
        "measured_index": OUTPUT_NAMES.index(config.control_channel.output),
        **converter_steps(config.closed_loop),
    }


# Beside simulated logs: what they were simulated from.
TRUTH_FILE = "truth.json"
# Its format, so that a foreign file of that name is left alone.
_TRUTH: Literal["flexlink truth 1"] = "flexlink truth 1"


class TrueMode(Section):
    frequency_Hz: float
    damping: float


class Truth(Section):
    """Modes below Nyquist by output, slowest first: of the linear equations, with those effects that are
    linear; friction is left out, and a backlash is closed."""

    format: Literal["flexlink truth 1"] = _TRUTH
    modes: Mapping[str, tuple[TrueMode, ...]]


def truth_of(source: SimulatedSource) -> Truth:
    """Modes of the simulated arm below Nyquist, one set for all outputs: they differ in zeros alone."""
    machine = make_machine(rig_of(source), parse_effects(source.effects))
    machine = replace(machine, joint=replace(machine.joint, backlash_gap_rad=None))
    rig = machine.rig
    a = equations_of_motion(machine, source.modes or default_n_modes(rig)).state_matrix()
    poles = np.linalg.eigvals(a)
    omega = np.abs(poles)
    zeta = -poles.real / np.maximum(omega, np.finfo(float).tiny)
    nyquist_rad_s = np.pi / rig.sampling.dt_s
    # One of each pair, lightly damped, and slow enough to be sampled.
    swings = (poles.imag > 0) & (zeta < LARGEST_DAMPING) & (omega < nyquist_rad_s)
    order = np.argsort(omega[swings])
    pairs = zip(omega[swings][order].tolist(), zeta[swings][order].tolist(), strict=True)
    modes = tuple(TrueMode(frequency_Hz=w / (2 * np.pi), damping=z) for w, z in pairs)
    return Truth(modes=dict.fromkeys(OUTPUT_NAMES, modes))


def truth_beside(logs: Sequence[Path], output: str) -> tuple[TrueMode, ...]:
    """The true modes of an output where the one folder of all logs has the file; none otherwise.

    Raises InputError (one line) for a damaged file; a foreign one of that name is left alone.
    """
    folders = {Path(path).absolute().parent for path in logs}
    path = folders.pop() / TRUTH_FILE
    if folders or not path.is_file():
        return ()
    document = documents.read_json(path)
    if document.get("format") != _TRUTH:
        return ()
    return check(Truth, document, source=str(path)).modes.get(output, ())


def beside(found: IdentifiedChannel, true: Sequence[TrueMode]) -> tuple[TrueMode | None, ...]:
    """Beside each pole pair the true mode that it stands for; None where it stands for none.

    found: an identified channel, of which only pairs that can be modes count. A pair and a true mode belong
    together where each is the nearest of the other, by the ratio of frequencies.
    """
    modes = [mode for mode in found.modes if found.is_mode(mode)]
    if not modes or not true:
        return (None,) * len(found.modes)
    ratios = [[mode.frequency_Hz / other.frequency_Hz for other in true] for mode in modes]
    distance = np.abs(np.log(ratios))
    nearest = distance.argmin(axis=1).tolist()
    back = distance.argmin(axis=0).tolist()
    # Each is the nearest of the other: two found modes cannot share a true one.
    matched = {modes[i]: true[j] for i, j in enumerate(nearest) if back[j] == i}
    return tuple(matched.get(mode) for mode in found.modes)
