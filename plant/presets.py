"""Arms to start from: the paper's link with a motor of our choosing, and two such links.

Every number that a source does not give is chosen here, and the docstrings say which and what it makes of the
arm.
"""

from __future__ import annotations

from plant.rig import Hub, Link, Motor, Payload, Rig, Sampling, Sensors
from plant.two_link import TwoLinkArm


def paper_link() -> Rig:
    """Rig of the paper's link: 1 m of aluminium, 6.35 mm x 6.35 mm, sampled at 200 Hz, on our hub and motor.

    The paper (section 4.1) gives length, section and sampling rate. Ours are: aluminium 6061 (2700 kg/m^3,
    68.9 GPa), a Kelvin-Voigt constant that damps the first clamped mode (5.2 Hz) by 1.5 %, a hub of 40 mm
    radius with three quarters of the link's inertia about the axis, and a geared motor strong enough to bend
    the link by centimetres: 0.55 N m/V at stall, back-EMF braking 0.5 N m s/rad. Noise is one milliradian and
    half a millimetre.

    Returns
    -------
    Rig

    Examples
    --------
    >>> rig = flexlink.paper_link()
    >>> rig.link.length_m, rig.sampling.dt_s
    (1.0, 0.005)
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


def two_link_arm(
    payload_kg: float = 0.05,
    coulomb_Nm: tuple[float, float] = (0.0, 0.0),
    gravity_m_s2: float = 0.0,
    n_modes: int = 1,
) -> TwoLinkArm:
    """Arm of two aluminium links with motors of our choosing.

    Link 2 is the paper's, half as long; link 1 is twice as thick, so that it bends an eighth as much. Their
    Kelvin-Voigt constant damps the first clamped mode of link 2 (21 Hz) by 2 %. Noise and sampling are not
    part of the arm.

    Parameters
    ----------
    payload_kg : float
        At the tip of link 2.
    coulomb_Nm : pair of float
        Dry friction of shoulder and elbow.
    gravity_m_s2 : float
        0 for an arm in a horizontal plane.
    n_modes : int
        Modes of each link.
    """
    far = paper_link().link.model_copy(update={"length_m": 0.5, "kelvin_voigt_s": 0.0003})
    near = far.model_copy(update={"thickness_m": 2 * far.thickness_m})
    # The shoulder has the inertia of the paper's hub and turns both links; the elbow is carried by link 1.
    shoulder_hub = Hub(inertia_kg_m2=0.03, radius_m=0.0, viscous_friction_Nms=0.02)
    elbow_hub = Hub(inertia_kg_m2=0.004, radius_m=0.0, viscous_friction_Nms=0.005)
    shoulder_motor = Motor(
        torque_constant_Nm_A=0.036, back_emf_Vs_rad=0.036, resistance_ohm=1.7, gear_ratio=40.0
    )
    elbow_motor = Motor(torque_constant_Nm_A=0.02, back_emf_Vs_rad=0.02, resistance_ohm=2.5, gear_ratio=26.0)
    return TwoLinkArm(
        links=(near, far),
        hubs=(shoulder_hub, elbow_hub),
        motors=(shoulder_motor, elbow_motor),
        elbow_mass_kg=0.25,
        payload_kg=payload_kg,
        coulomb_Nm=coulomb_Nm,
        gravity_m_s2=gravity_m_s2,
        n_modes=n_modes,
    )
