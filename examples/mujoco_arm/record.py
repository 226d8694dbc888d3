"""The two logs of this example: an arm under a controller, whose elbow drags more than its model says.

    python examples/mujoco_arm/record.py            writes first.csv and second.csv beside this file

The machine is MuJoCo at a fifth of the model's step; dry friction is a torque of our own on the joint. What a
log holds is what a real one would: time, commanded torques and angles as read, with 0.2 mrad of noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
from scipy.signal import butter, sosfilt

HERE = Path(__file__).parent
DT_S, SAMPLES, NOISE_RAD, FRICTION_NM = 0.01, 300, 2e-4, 0.15
KP, KD = np.array([25.0, 10.0]), np.array([2.5, 0.8])


def recorded(seed: int) -> np.ndarray:
    """(T, 5) time, torques, angles: random steps about hanging down, PD controller on the read angles."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_file(str(HERE / "arm.xml"))
    spec.option.timestep /= 5
    model = spec.compile()
    data = mujoco.MjData(model)
    hanging = np.array([np.pi / 2, 0.0])
    data.qpos[:] = hanging
    steps = np.repeat(rng.uniform(-1.0, 1.0, (SAMPLES // 60, 2)), 60, axis=0)
    steps[:20] = 0.0
    reference = hanging + sosfilt(butter(2, 2.5, fs=1 / DT_S, output="sos"), steps, axis=0)
    rows, last = [], hanging
    for k in range(SAMPLES):
        angles = data.qpos + NOISE_RAD * rng.standard_normal(2)
        torques = KP * (reference[k] - angles) - KD * (angles - last) / DT_S
        last = angles
        rows.append([k * DT_S, *torques, *angles])
        for _ in range(round(DT_S / model.opt.timestep)):
            data.ctrl[:] = torques
            data.qfrc_applied[1] = -FRICTION_NM * np.tanh(data.qvel[1] / 5e-3)
            mujoco.mj_step(model, data)
    return np.array(rows)


def main(folder: Path = HERE) -> None:
    names = "time_s,shoulder_torque,elbow_torque,shoulder,elbow"
    for seed, name in enumerate(("first.csv", "second.csv")):
        table = recorded(seed)
        np.savetxt(folder / name, table, fmt="%.6g", delimiter=",", header=names, comments="")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
