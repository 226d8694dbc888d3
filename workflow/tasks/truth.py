"""`truth.json` beside simulated logs: the modes of the arm behind them, shown beside what is found.

Nothing but the display reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ident.checks.plausible_modes import LARGEST_DAMPING
from plant.effects import make_machine, parse_effects
from plant.modal import default_n_modes, equations_of_motion
from workflow.config.run_config import SimulatedSource
from workflow.config.settings import Section, check
from workflow.engine import documents
from workflow.tasks.results import IdentifiedChannel
from workflow.tasks.simulated_rig import OUTPUT_NAMES, rig_of

FILE_NAME = "truth.json"
_FORMAT: Literal["flexlink truth 1"] = "flexlink truth 1"


class TrueMode(Section):
    frequency_Hz: float
    damping: float


class Truth(Section):
    """Modes below Nyquist by output, slowest first: of the linear equations, with those effects that are
    linear; friction is left out, and a backlash is closed."""

    format: Literal["flexlink truth 1"] = _FORMAT
    modes: Mapping[str, tuple[TrueMode, ...]]


def truth_of(source: SimulatedSource) -> Truth:
    """One set of modes for all outputs: they differ in zeros alone."""
    machine = make_machine(rig_of(source), parse_effects(source.effects))
    machine = replace(machine, joint=replace(machine.joint, backlash_gap_rad=None))
    rig = machine.rig
    a = equations_of_motion(machine, source.modes or default_n_modes(rig)).state_matrix()
    poles = np.linalg.eigvals(a)
    omega, zeta = np.abs(poles), -poles.real / np.maximum(np.abs(poles), np.finfo(float).tiny)
    swings = (poles.imag > 0) & (zeta < LARGEST_DAMPING) & (omega < np.pi / rig.sampling.dt_s)
    order = np.argsort(omega[swings])
    pairs = zip(omega[swings][order].tolist(), zeta[swings][order].tolist(), strict=True)
    modes = tuple(TrueMode(frequency_Hz=w / (2 * np.pi), damping=z) for w, z in pairs)
    return Truth(modes=dict.fromkeys(OUTPUT_NAMES, modes))


def truth_beside(logs: Sequence[Path], output: str) -> tuple[TrueMode, ...]:
    """The true modes of an output where the one folder of all logs has the file; none otherwise.

    Raises InputError (one line) for a damaged file; a foreign one of that name is left alone.
    """
    folders = {Path(path).absolute().parent for path in logs}
    path = folders.pop() / FILE_NAME
    if folders or not path.is_file():
        return ()
    document = documents.read_json(path)
    if document.get("format") != _FORMAT:
        return ()
    return check(Truth, document, source=str(path)).modes.get(output, ())


def beside(found: IdentifiedChannel, true: Sequence[TrueMode]) -> tuple[TrueMode | None, ...]:
    """For each pole pair that can be a mode the true one nearest in ratio; each is nearest to the other."""
    modes = [mode for mode in found.modes if found.is_mode(mode)]
    if not modes or not true:
        return (None,) * len(found.modes)
    distance = np.abs(np.log([[mode.frequency_Hz / other.frequency_Hz for other in true] for mode in modes]))
    nearest, back = distance.argmin(axis=1).tolist(), distance.argmin(axis=0).tolist()
    matched = {modes[i]: true[j] for i, j in enumerate(nearest) if back[j] == i}
    return tuple(matched.get(mode) for mode in found.modes)
