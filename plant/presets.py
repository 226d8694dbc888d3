"""Arms to start from: the paper's link with a motor of our choosing, and the paper's simulation example."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plant.beam import clamped_free_modes
from plant.machine import Machine
from plant.modal import equations_of_motion
from plant.rig import Hub, Link, Motor, Payload, Rig, Sampling, Sensors

if TYPE_CHECKING:
    import control

# Real zeros of the paper's simulation example, below its eq. (32).
EXAMPLE_ZEROS_RAD_S = (10.8, -10.5)
# Its flexible pole is not printed; this is where the identification benchmark puts it.
_EXAMPLE_POLE_RAD_S = 15.0


def paper_link() -> Rig:
    """The paper's link: 1 m of aluminium, 6.35 mm x 6.35 mm, sampled at 200 Hz, on a hub and motor of our
    choosing.

    The paper (section 4.1) gives length, section and sampling rate. Ours are: aluminium 6061 (2700 kg/m^3,
    68.9 GPa), a Kelvin-Voigt constant that damps the first clamped mode (5.2 Hz) by 1.5 %, a hub of 40 mm
    radius with three quarters of the link's inertia about the axis, and a geared motor strong enough to bend
    the link by centimetres: 0.55 N m/V at stall, back-EMF braking 0.5 N m s/rad. Noise is one milliradian and
    half a millimetre.
    """
    return Rig(
        link=Link(
            length_m=1.0,
            width_m=0.00635,
            thickness_m=0.00635,
            density_kg_m3=2700.0,
            youngs_modulus_Pa=68.9e9,
            kelvin_voigt_s=0.0009,
        ),
        hub=Hub(inertia_kg_m2=0.03, radius_m=0.04, viscous_friction_Nms=0.02),
        motor=Motor(torque_constant_Nm_A=0.036, back_emf_Vs_rad=0.036, resistance_ohm=1.7, gear_ratio=26.0),
        payload=Payload(mass_kg=0.0),
        sensors=Sensors(hub_angle_noise_rad=0.001, tip_noise_m=0.0005),
        sampling=Sampling(dt_s=0.005),
    )


def paper_example_rig() -> Rig:
    """The physical arm behind `paper_example`: a slender link on a light hub, clamped at the axis.

    One assumed mode (clamped root, unit modal mass, frequency w, tip value p, coupling b) under a hub torque
    has

        tip / torque = ((L - b p) s^2 + L kappa w^2 s + L w^2) / (s^2 ((I - b^2) s^2 + I kappa w^2 s + I
        w^2)),

    I the inertia of hub and link. b p = 1.138 L for every uniform link, so there is one zero on either side,
    and their sum and product give kappa and w: w = 3.95 rad/s. I then puts the flexible pole at 15 rad/s. The
    paper's own link, 6.35 mm thick, has w = 32.6 rad/s and its zeros at +-88 rad/s; so the example needs a
    link of 0.77 mm, or of the paper's section and 2.9 m length. We keep 1 m and the width, and take the
    thinner one.
    """
    length, width, density, modulus = 1.0, 0.00635, 2700.0, 69e9
    unit = clamped_free_modes(1.0, 1.0, length, 1)
    excess = float(unit.tip[0] * unit.coupling[0]) - length  # b p - L, the same for every uniform link
    right, left = EXAMPLE_ZEROS_RAD_S
    omega_squared = -right * left * excess / length
    kelvin_voigt = (right + left) * excess / (length * omega_squared)
    shape = float(unit.omega_rad_s[0])  # omega of a link with EI = m = 1
    thickness = np.sqrt(12.0 * density * omega_squared / modulus) / shape
    mass_per_length = density * width * thickness
    coupling_squared = mass_per_length * float(unit.coupling[0]) ** 2
    inertia = coupling_squared / (1 - omega_squared / _EXAMPLE_POLE_RAD_S**2)
    return Rig(
        link=Link(
            length_m=length,
            width_m=width,
            thickness_m=float(thickness),
            density_kg_m3=density,
            youngs_modulus_Pa=modulus,
            kelvin_voigt_s=float(kelvin_voigt),
        ),
        hub=Hub(
            inertia_kg_m2=inertia - mass_per_length * length**3 / 3,
            radius_m=0.0,
            viscous_friction_Nms=0.0,
        ),
        motor=Motor(torque_constant_Nm_A=1.0, back_emf_Vs_rad=0.0, resistance_ohm=1.0, gear_ratio=1.0),
        payload=Payload(mass_kg=0.0),
        sensors=Sensors(hub_angle_noise_rad=0.0, tip_noise_m=0.004),
        sampling=Sampling(dt_s=0.005),
    )


def paper_example() -> control.TransferFunction:
    """The paper's simulation example, eq. (32) with n = 1: hub torque [N m] to tip position [m], continuous
    time.

    Two poles at the origin, a lightly damped pair at 15 rad/s (damping ratio 0.02) and real zeros at +10.8
    and -10.5 rad/s. The asymmetry of the zeros is the structural damping. See `paper_example_rig` for the
    physics.
    """
    import control  # here, because it brings a plotting library with it

    rig = paper_example_rig()
    equations = equations_of_motion(Machine(rig), n_modes=1)
    rigid, length = float(equations.mass[0, 0]), rig.link.length_m
    coupling, tip = float(equations.mass[0, 1]), float(equations.tip[1])
    omega_squared, damping = float(equations.stiffness[1, 1]), float(equations.damping[1, 1])
    return control.tf(
        [length - coupling * tip, length * damping, length * omega_squared],
        [rigid - coupling**2, rigid * damping, rigid * omega_squared, 0.0, 0.0],
        inputs=["hub_torque_Nm"],
        outputs=["tip_m"],
        name="paper_example",
    )
