"""How long the plant takes: a 6 s record at 5 ms per effect, and one step of a closed loop.

    OMP_NUM_THREADS=1 python -m benchmarks.plant_simulation

CPU time, medians. The first call of a fresh machine also compiles the stepper.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness import Print, main, median_s, timed
from plant import EFFECTS, Rig, SampledArm, paper_link, parse_effects, prbs, simulate
from plant.effects import Effect

SIZES: dict[str, dict[str, float]] = {
    "coulomb_friction": {"torque_Nm": 0.1},
    "stribeck_friction": {
        "static_torque_Nm": 0.15,
        "coulomb_torque_Nm": 0.1,
        "stribeck_velocity_rad_s": 0.05,
    },
    "input_delay": {"delay_s": 0.0123},
    "torque_ripple": {"amplitude_Nm": 0.1, "cycles_per_rev": 11.0, "phase_rad": 0.5},
    "gravity": {"acceleration_m_s2": 0.5},
    "backlash": {"gap_rad": 0.02},
}


def step_time_s(rig: Rig, effects: tuple[Effect, ...], voltage: np.ndarray, measure: bool) -> float:
    """CPU time per sample of a loop that advances the arm, and measures it if asked to."""
    arm = SampledArm(rig, effects, np.random.default_rng(0))

    def loop() -> None:
        for value in voltage.tolist():
            if measure:
                arm.measure()
            arm.advance(value)

    return median_s(loop, 3) / voltage.size


def run(out: Print, *, seed: int = 0) -> None:
    rig = paper_link()
    voltage = prbs(10, 4, 2.0, 1200, np.random.default_rng(seed))
    first = timed(lambda: simulate(rig, voltage))[1]
    out(f"first call (compiles, or loads what was compiled): {first:.2f} s")
    cases: dict[str, tuple[Effect, ...]] = {"nominal": ()}
    for name, size in SIZES.items():
        assert name in EFFECTS
        cases[name] = parse_effects([{"name": name, **size}])
    out(f"{'6 s record at 5 ms':28s} {'ms':>8s}")
    for name, effects in cases.items():
        seconds = median_s(lambda e=effects: simulate(rig, voltage, e), 9)
        out(f"{name:28s} {1e3 * seconds:8.2f}")
    out(f"{'closed-loop step':28s} {'us':>8s}")
    for name in ("nominal", "coulomb_friction"):
        for measure in (False, True):
            label = f"{name}, {'measure and advance' if measure else 'advance'}"
            out(f"{label:40s} {1e6 * step_time_s(rig, cases[name], voltage, measure):8.2f}")


if __name__ == "__main__":
    main(run)
