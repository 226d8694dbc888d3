"""The two-link arm against one in MuJoCo whose links are cut into rigid segments with springs between them,
and a controller designed for ours in the loop around that one. They share sizes and no equation."""

import control
import numpy as np
import pytest

from control_design.plants.multivariable import MultivariablePlant
from control_design.specification import Specification
from control_design.specification.multivariable import MultivariableSpecification
from control_design.synthesis.multivariable import synthesise_multivariable
from plant import TwoLinkArm, TwoLinkMachine, multisine, multisine_lines, two_link_arm

mujoco = pytest.importorskip("mujoco")

DT_S, STEP_S, SEGMENTS = 0.004, 5e-5, 6
ELBOW_RAD = 1.2


def _link(name: str, link, at_m: float, root: str, inside: str) -> str:
    """Nested bodies, springs a length h apart and half of it at both ends; root: the first hinge."""
    h = link.length_m / SEGMENTS
    lengths = [h / 2, *[h] * (SEGMENTS - 1), h / 2]
    spring = link.bending_stiffness_Nm2 / h
    text = inside
    for k in reversed(range(len(lengths))):
        mass, length = link.mass_per_length_kg_m * lengths[k], lengths[k]
        inertia = mass * length**2 / 12
        hinge = root if k == 0 else (
            f'<joint axis="0 0 1" stiffness="{spring}" damping="{link.kelvin_voigt_s * spring}"/>'
        )  # fmt: skip
        text = (
            f'<body name="{name}{k}" pos="{at_m if k == 0 else lengths[k - 1]} 0 0">{hinge}'
            f'<inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
            f"{text}</body>"
        )
    return text


def _point(x_m: float, mass_kg: float, inertia: float = 1e-9) -> str:
    size = f"{inertia} {inertia} {inertia}"
    return f'<body pos="{x_m} 0 0"><inertial pos="0 0 0" mass="{mass_kg}" diaginertia="{size}"/></body>'


class Segmented:
    """Same commands and measurements as `TwoLinkMachine`, in a horizontal plane and without dry friction."""

    def __init__(self, arm: TwoLinkArm, elbow_rad: float) -> None:
        half = [link.length_m / SEGMENTS / 2 for link in arm.links]
        brakes = [
            hub.viscous_friction_Nms + motor.back_emf_damping_Nms
            for hub, motor in zip(arm.hubs, arm.motors, strict=True)
        ]
        hinges = [
            f'<joint name="{name}" axis="0 0 1" damping="{brake}"/>'
            for name, brake in zip(("shoulder", "elbow"), brakes, strict=True)
        ]
        # A hub turns with the root of its link: it sits on the first body of that link.
        hubs = [_point(0.0, 1e-9, hub.inertia_kg_m2) for hub in arm.hubs]
        far = _link("far", arm.links[1], half[0], hinges[1], _point(half[1], arm.payload_kg))
        far = far.replace(hinges[1], hinges[1] + hubs[1])
        near = _link("near", arm.links[0], 0.0, hinges[0], _point(half[0], arm.elbow_mass_kg) + far)
        near = near.replace(hinges[0], hinges[0] + hubs[0])
        motors = "".join(
            f'<motor joint="{name}" gear="{motor.torque_per_volt_Nm_V}"/>'
            for name, motor in zip(("shoulder", "elbow"), arm.motors, strict=True)
        )
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{STEP_S}" gravity="0 0 0" integrator="implicitfast"/>'
            f"<worldbody>{near}</worldbody><actuator>{motors}</actuator></mujoco>"
        )
        self.data = mujoco.MjData(self.model)
        self._at = [self.model.joint(name).qposadr[0] for name in ("shoulder", "elbow")]
        self._start = np.array([0.0, elbow_rad])
        self.data.qpos[self._at] = self._start

    def measure(self) -> np.ndarray:
        return self.data.qpos[self._at] - self._start

    def advance(self, u: np.ndarray) -> None:
        self.data.ctrl[:] = u
        for _ in range(round(DT_S / STEP_S)):
            mujoco.mj_step(self.model, self.data)


def _voltages(seconds: float, rms_V: float) -> np.ndarray:
    rng, count = np.random.default_rng(3), round(seconds / DT_S)
    lines = multisine_lines(count, DT_S, (0.5, 12.0))
    return np.column_stack([multisine(lines, count, rms_V, rng) for _ in range(2)])


@pytest.mark.slow
def test_the_same_voltages_move_both_arms_alike() -> None:
    arm, u = two_link_arm(n_modes=2), _voltages(1.5, 2.0)
    ours = TwoLinkMachine(arm, (0.0, ELBOW_RAD), DT_S, 0.0, np.random.default_rng(0)).run(u)
    other = Segmented(arm, ELBOW_RAD)
    theirs = np.empty_like(ours)
    for k, now in enumerate(u):
        theirs[k] = other.measure()
        other.advance(now)
    assert np.all(np.ptp(theirs, axis=0) > 0.05)
    # Measured over 3 s: 0.0005 of the motion. A tenth more payload makes 0.03 at the elbow.
    assert np.all(_apart(ours, theirs) < 0.002)
    heavier = two_link_arm(1.1 * arm.payload_kg, n_modes=2)
    changed = TwoLinkMachine(heavier, (0.0, ELBOW_RAD), DT_S, 0.0, np.random.default_rng(0)).run(u)
    assert _apart(changed, theirs)[1] > 0.02


def _apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Root mean square difference of each joint, as a share of its motion."""
    return np.asarray(np.sqrt(np.mean((one - other) ** 2, axis=0)) / np.std(other, axis=0))


@pytest.mark.slow
def test_a_controller_designed_for_ours_settles_the_other() -> None:
    arm = two_link_arm()
    a, b = arm.linear(ELBOW_RAD)
    nominal = control.c2d(control.ss(a, b, np.eye(2, a.shape[0]), np.zeros((2, 2))), DT_S)
    joint = Specification(bandwidth_rad_s=5.0, modulus_margin=0.4, effort_limit=100.0, input_limit=24.0)
    asked = MultivariableSpecification(joints=(joint, joint), controller_order=4)
    law = synthesise_multivariable(MultivariablePlant("arm", nominal), asked).controller
    machine, stepper = Segmented(arm, ELBOW_RAD), law.stepper()
    wanted, command = np.array([0.2, -0.3]), np.zeros(2)
    angles = np.empty((750, 2))
    for k in range(len(angles)):
        angles[k] = machine.measure()
        following = stepper.step(wanted - angles[k])
        machine.advance(command if law.computational_delay_samples else following)
        command = following
    np.testing.assert_allclose(angles[-100:], np.tile(wanted, (100, 1)), atol=0.004)
    assert np.max(np.abs(angles)) < 1.5 * 0.3
