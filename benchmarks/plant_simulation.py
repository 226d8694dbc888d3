"""How long the plant takes: a 6 s record at 5 ms per effect, and one step of a closed loop.

Run as `python benchmarks/plant_simulation.py`; one thread. The first call of a fresh machine also compiles
the stepper.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

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


def median_of(repeats: int, work: Callable[[], object]) -> float:
    """Median wall time in seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def step_time_s(rig: Rig, effects: tuple[Effect, ...], voltage: np.ndarray, measure: bool) -> float:
    """Wall time per sample of a loop that advances the arm, and measures it if asked to."""
    arm = SampledArm(rig, effects, np.random.default_rng(0))

    def loop() -> None:
        for value in voltage.tolist():
            if measure:
                arm.measure()
            arm.advance(value)

    return median_of(3, loop) / voltage.size


def main() -> None:
    rig = paper_link()
    voltage = prbs(10, 4, 2.0, 1200, np.random.default_rng(0))
    start = time.perf_counter()
    simulate(rig, voltage)
    print(f"first call (compiles, or loads what was compiled): {time.perf_counter() - start:.2f} s")
    cases: dict[str, tuple[Effect, ...]] = {"nominal": ()}
    for name, size in SIZES.items():
        assert name in EFFECTS
        cases[name] = parse_effects([{"name": name, **size}])
    print(f"{'6 s record at 5 ms':28s} {'ms':>8s}")
    for name, effects in cases.items():
        print(f"{name:28s} {1e3 * median_of(9, lambda e=effects: simulate(rig, voltage, e)):8.2f}")
    print(f"{'closed-loop step':28s} {'us':>8s}")
    for name in ("nominal", "coulomb_friction"):
        for measure in (False, True):
            label = f"{name}, {'measure and advance' if measure else 'advance'}"
            print(f"{label:40s} {1e6 * step_time_s(rig, cases[name], voltage, measure):8.2f}")


if __name__ == "__main__":
    main()
