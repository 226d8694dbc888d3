"""A small case whose residuals are made to order: white noise plus a gap whose place is known."""

import numpy as np

from diagnosis import Case, Experiment
from plant import multisine, multisine_lines, paper_link, prbs, simulate

RIG = paper_link().perturbed(
    {
        "link.length_m": 0.6, "link.width_m": 0.025, "link.thickness_m": 0.0011, "link.density_kg_m3": 7850.0,
        "link.youngs_modulus_Pa": 2e11, "link.kelvin_voigt_s": 0.0018, "hub.inertia_kg_m2": 0.007,
        "hub.radius_m": 0.05, "hub.viscous_friction_Nms": 0.006, "motor.torque_constant_Nm_A": 0.024,
        "motor.back_emf_Vs_rad": 0.024, "motor.resistance_ohm": 2.6, "motor.gear_ratio": 20.0,
        "sensors.tip_noise_m": 0.0008,
    }
)  # fmt: skip
NOISE = np.array([RIG.sensors.hub_angle_noise_rad, RIG.sensors.tip_noise_m])
DT = RIG.sampling.dt_s
PERIOD = 700


def inputs():
    """Voltages (T,) of four experiments by name; the multisine has two periods."""
    rng = np.random.default_rng(11)
    lines = multisine_lines(PERIOD, DT, (0.2, 35.0))
    return {
        "prbs_low": prbs(9, 6, 0.4, 1400, rng),
        "prbs_high": prbs(9, 6, 1.2, 1400, rng),
        "multisine": multisine(lines, PERIOD, 0.8, rng, periods=2),
        "fresh": prbs(9, 6, 0.8, 1200, rng),
    }


def made(residuals):
    """The case whose records are the model plus these residuals (name -> (T, 2)) times the noise."""
    return Case(
        "synthetic",
        RIG,
        tuple(
            Experiment(
                name,
                "held_out" if name == "fresh" else "estimation",
                voltage,
                MODEL[name] + residuals[name] * NOISE,
                "multisine" if name == "multisine" else "prbs",
            )
            for name, voltage in inputs().items()
        ),
    )


MODEL = {name: simulate(RIG, voltage).output for name, voltage in inputs().items()}


def white(rng):
    """White residuals of unit variance for every experiment."""
    return {name: rng.standard_normal(output.shape) for name, output in MODEL.items()}
