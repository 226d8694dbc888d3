"""The diagnosis on a machine of your own: a carriage on a spring, and something its simulation lacks.

    python examples/own_plant.py

What you bring: `simulate(parameters, effects, inputs) -> outputs`, stated parameters with their tolerances,
the names of what may be missing, and records. Those here come from a carriage with a seal that drags and a
tilted table; replace `recorded` by your own. docs/own_plant.md says what else there is.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from diagnosis import (
    Body,
    EffectParameter,
    Plant,
    PlantCase,
    PlantEffect,
    PlantExperiment,
    diagnose,
    with_effects,
)

DT_S, NOISE_M = 0.01, 2e-4
STATED = {"mass_kg": 2.0, "spring_N_m": 80.0, "damper_Ns_m": 3.0}
TOLERANCES = {"mass_kg": 0.02, "spring_N_m": 0.05, "damper_Ns_m": 0.2}
# Put around the simulation, which knows none of them. An offset is a candidate like any other: without it
# something that resembles it wins.
NAMES = ("coulomb_friction", "input_offset", "output_offset", "input_delay")
# Not on the list: written into the simulation.
STIFFENING = PlantEffect("stiffening", (EffectParameter("cubic_N_m3", 1.0, 1e5),), signed=True)


def simulate(parameters, effects, inputs):
    """Force (T, 1), held over each sample -> position (T, 1)."""
    cubic = effects["stiffening"]["cubic_N_m3"] if "stiffening" in effects else 0.0
    force = np.ascontiguousarray(inputs[:, 0])
    return carriage(force, *(parameters[key] for key in STATED), cubic, 0.0)[:, None]


@njit
def carriage(force, mass, spring, damper, cubic, dry):
    """Steps of a tenth of a sample; dry friction takes off what it can, so that the carriage truly sticks."""
    steps = 10
    h = DT_S / steps
    position = np.zeros(force.size)
    x, v = 0.0, 0.0
    for k in range(force.size):
        position[k] = x
        for _ in range(steps):
            free = v + h / mass * (force[k] - spring * x - cubic * x**3 - damper * v)
            free = np.sign(free) * max(abs(free) - h / mass * dry, 0.0)
            x += h * (v + free) / 2
            v = free
    return position


def recorded(seed=0, n_samples=600):
    """Three records to fit and one to judge, of a carriage that is a little other than stated."""
    rng = np.random.default_rng(seed)
    dragging, tilt = 0.8, -0.5
    for k, role in enumerate(("estimation", "estimation", "estimation", "held_out")):
        force = (3.0 + k) * rng.choice([-1.0, 1.0], n_samples // 20).repeat(20)
        position = carriage(force + tilt, 2.03, 77.0, 3.3, 0.0, dragging)
        position += NOISE_M * rng.standard_normal(n_samples)
        yield PlantExperiment(f"steps {k + 1}", role, force[:, None], position[:, None])


def case_of(experiments, **more):
    """more: of `Plant`, for example model_error=0.05 for a machine that no simulation follows exactly."""
    experiments = tuple(experiments)
    plant = Plant(simulate, STATED, TOLERANCES, ("position_m",), np.array([NOISE_M]), (STIFFENING,), **more)
    return PlantCase(
        "carriage", with_effects(plant, NAMES, experiments, dt_s=DT_S, body=Body("position_m")), experiments
    )


def run(seed=0):
    return diagnose(case_of(recorded(seed)))


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
