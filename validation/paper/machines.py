"""The two machines of the paper as we rebuild them: its simulation example, and its aluminium link.

Each gives records on demand and knows its own true linear response, so that every method can be held against
the truth. All choices of ours that the paper leaves open are made here, and named in `quotes.OPEN_CHOICES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import control
import numpy as np

from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from plant.effects import Effect, parse_effect
from plant.excitation import prbs
from plant.modal import linear_arm
from plant.presets import paper_link
from plant.rig import Rig
from plant.simulation import simulate
from validation.example_arms import paper_example
from validation.paper.settings import DT_S

# p. 104: noise variance 0.004^2 and 30 dB, so the output has a standard deviation of 0.1265.
NOISE_STD = 0.004
# Signal over noise of the simulation example.
SNR_DB = 30.0
# Samples of its records.
EXAMPLE_SAMPLES = 1000
# Samples of the experiment: 6 s, the length of Figs. 5 and 6.
EXPERIMENT_SAMPLES = 1200
# Voltage of the experiment.
EXPERIMENT_AMPLITUDE_V = 1.5
# Dry friction of its arm.
COULOMB_NM = 0.02
# Length of the shift register behind the random binary signals.
_REGISTER = 11


@dataclass(frozen=True, eq=False)
class Trial:
    """One draw of input and noise: the record of the fit, a fresh one, and the fresh output without noise."""

    fitted: Record
    fresh: Record
    fresh_clean: RealArray


def _response(system: Any, omega_rad_s: RealArray, row: int = 0, column: int = 0) -> ComplexArray:
    at = system(np.exp(1j * omega_rad_s * DT_S), squeeze=False)
    return np.asarray(at[row, column], dtype=np.complex128)


def _record(name: str, u: RealArray, y: RealArray, input_name: str, input_unit: str) -> Record:
    """A record of one input (T,) and the tip (T,)."""
    return Record(
        name=name,
        input=u[:, None],
        output=y[:, None],
        dt_s=DT_S,
        input_names=(input_name,),
        output_names=("tip_m",),
        input_units=(input_unit,),
        output_units=("m",),
    )


@dataclass(frozen=True, eq=False)
class SimulationExample:
    """Section 4, "Simulation Example": eq. (32) with one mode, hub torque to tip, noise on the output."""

    name = "simulation example"
    gain_unit = "m / (N m)"

    @cached_property
    def system(self) -> Any:
        """The plant in state space, input held over a sample."""
        return control.sample_system(control.ss(paper_example()), DT_S, "zoh")

    @property
    def mode(self) -> tuple[float, float]:
        """(omega [rad/s], damping ratio) of the mode."""
        poles = paper_example().poles()
        pole = complex(poles[np.argmax(poles.imag)])
        return abs(pole), -pole.real / abs(pole)

    def response(self, omega_rad_s: RealArray) -> ComplexArray:
        """True response (F,) with the input held over a sample."""
        return _response(self.system, omega_rad_s)

    def output(self, u: RealArray) -> RealArray:
        """Noise-free output (T,) from rest."""
        return np.asarray(control.forced_response(self.system, inputs=u).outputs, dtype=np.float64)

    def trial(self, rng: np.random.Generator) -> Trial:
        """A PRBS of new start state, scaled to the paper's output level, and a fresh one as large."""
        signs = prbs(_REGISTER, 1, 1.0, EXAMPLE_SAMPLES, rng)
        wanted = NOISE_STD * 10 ** (SNR_DB / 20)
        amplitude = wanted / float(np.std(self.output(signs)))
        inputs = amplitude * signs, prbs(_REGISTER, 1, amplitude, EXAMPLE_SAMPLES, rng)
        clean = [self.output(u) for u in inputs]
        noisy = [y + NOISE_STD * rng.standard_normal(y.size) for y in clean]
        names = ("fitted", "fresh")
        records = [
            _record(n, u, y, "hub_torque_Nm", "N m") for n, u, y in zip(names, inputs, noisy, strict=True)
        ]
        return Trial(records[0], records[1], clean[1])


@dataclass(frozen=True, eq=False)
class LinkExperiment:
    """Section 4.1: the 1 m aluminium link, motor voltage to tip, with or without dry friction."""

    friction: bool = True
    gain_unit = "m / V"

    @property
    def name(self) -> str:
        return "experiment" if self.friction else "experiment without friction"

    @property
    def effects(self) -> Sequence[Effect]:
        if not self.friction:
            return ()
        return (parse_effect({"name": "coulomb_friction", "torque_Nm": COULOMB_NM}),)

    @cached_property
    def rig(self) -> Rig:
        """The preset with the paper's noise on the tip."""
        return paper_link().perturbed({"sensors.tip_noise_m": NOISE_STD})

    @cached_property
    def system(self) -> Any:
        """The arm without dry friction, voltage held over a sample."""
        return linear_arm(self.rig).sample(DT_S)

    @property
    def mode(self) -> tuple[float, float]:
        """(omega [rad/s], damping ratio) of the first mode."""
        poles = linear_arm(self.rig).poles()
        is_upper = poles.imag > 0
        pairs = poles[is_upper]
        pole = complex(pairs[np.argmin(np.abs(pairs))])
        return abs(pole), -pole.real / abs(pole)

    def response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Linear response (F,) of the arm without dry friction, all modes, voltage held over a sample."""
        return _response(self.system, omega_rad_s, row=1, column=0)

    def trial(self, rng: np.random.Generator) -> Trial:
        """Two runs of the nonlinear arm from rest, each with its own PRBS and sensor noise."""
        records = []
        clean = np.zeros(0)
        for name in ("fitted", "fresh"):
            u = prbs(_REGISTER, 1, EXPERIMENT_AMPLITUDE_V, EXPERIMENT_SAMPLES, rng)
            run = simulate(self.rig, u, self.effects, rng=rng)
            records.append(_record(name, u, run.tip_m, "voltage_V", "V"))
            clean = run.tip_true_m
        return Trial(records[0], records[1], clean)


PaperMachine = SimulationExample | LinkExperiment
