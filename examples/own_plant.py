"""The diagnosis on a machine of your own: a carriage on a spring, and something its simulation lacks.

    python examples/own_plant.py

What you bring: `simulate(parameters, effects, inputs) -> outputs`, stated parameters with their tolerances, a
list of what may be missing, and records. Those here come from a simulation with a seal that drags and a
tilted table; replace `recorded` by your own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose

DT_S, NOISE_M = 0.01, 2e-4
STATED = {"mass_kg": 2.0, "spring_N_m": 80.0, "damper_Ns_m": 3.0}
TOLERANCES = {"mass_kg": 0.02, "spring_N_m": 0.05, "damper_Ns_m": 0.2}
EFFECTS = (
    PlantEffect("dry_friction", (EffectParameter("force_N", 1e-3, 20.0),), dependence="continuous"),
    # An offset is a candidate like any other: without it something that resembles it wins.
    PlantEffect("constant_force", (EffectParameter("force_N", 1e-3, 20.0),), signed=True),
    PlantEffect("sensor_offset", (EffectParameter("offset_m", 1e-5, 0.1),), signed=True),
    PlantEffect("stiffening", (EffectParameter("cubic_N_m3", 1.0, 1e5),), signed=True),
    PlantEffect("input_delay", (EffectParameter("delay_s", 1e-4, 0.2),)),
)


def simulate(parameters, effects, inputs):
    """Force (T, 1), held over each sample -> position (T, 1)."""
    values = {(effect, key): value for effect, given in effects.items() for key, value in given.items()}
    position = carriage(
        np.ascontiguousarray(inputs[:, 0]) + values.get(("constant_force", "force_N"), 0.0),
        parameters["mass_kg"],
        parameters["spring_N_m"],
        parameters["damper_Ns_m"],
        values.get(("stiffening", "cubic_N_m3"), 0.0),
        values.get(("dry_friction", "force_N"), 0.0),
        values.get(("input_delay", "delay_s"), 0.0),
    )
    return position[:, None] + values.get(("sensor_offset", "offset_m"), 0.0)


@njit
def carriage(force, mass, spring, damper, cubic, dry, delay):
    """Steps of a tenth of a sample; dry friction takes off what it can, so that the carriage truly sticks."""
    steps = 10
    h = DT_S / steps
    position = np.zeros(force.size)
    whole = int(delay / DT_S)
    part = delay / DT_S - whole
    x, v = 0.0, 0.0
    for k in range(force.size):
        position[k] = x
        now = (1 - part) * force[max(k - whole, 0)] + part * force[max(k - whole - 1, 0)]
        for _ in range(steps):
            free = v + h / mass * (now - spring * x - cubic * x**3 - damper * v)
            free = np.sign(free) * max(abs(free) - h / mass * dry, 0.0)
            x += h * (v + free) / 2
            v = free
    return position


def recorded(seed=0, n_samples=600):
    """Three records to fit and one to judge, of a carriage that is a little other than stated."""
    rng = np.random.default_rng(seed)
    true = {"mass_kg": 2.03, "spring_N_m": 77.0, "damper_Ns_m": 3.3}
    lacking = {"dry_friction": {"force_N": 0.8}, "constant_force": {"force_N": -0.5}}
    for k, role in enumerate(("estimation", "estimation", "estimation", "held_out")):
        force = (3.0 + k) * rng.choice([-1.0, 1.0], n_samples // 20).repeat(20)[:, None]
        position = simulate(true, lacking, force) + NOISE_M * rng.standard_normal((n_samples, 1))
        yield PlantExperiment(f"steps {k + 1}", role, force, position)


def run(seed=0):
    plant = Plant(simulate, STATED, TOLERANCES, ("position_m",), np.array([NOISE_M]), EFFECTS)
    return diagnose(PlantCase("carriage", plant, tuple(recorded(seed))))


def main() -> None:
    found = run()
    print(f"verdict: {found.verdict}, {' and '.join(found.combination)}")
    print(f"gap on the held-out record, in noise deviations: {found.gap_before:.1f} with nominal parameters,")
    print(f"    {found.gap_refit:.1f} with these re-estimated, {found.gap_after:.2f} with the effects added")
    for effect in found.effects[: len(found.combination)]:
        for key, value in effect.parameters.items():
            low, high = effect.intervals[key]
            print(f"{effect.name}, there with probability {effect.presence:.3f}: {key} {value:.3f}")
            print(f"    95 %: {low:.3f} to {high:.3f}")
    for key, value in found.rig.parameters.items():
        print(f"{key}: stated {STATED[key]:g}, repaired {value:.3f}")


if __name__ == "__main__":
    main()
