"""The same machine in Exudyn: absolute nodal coordinate beams with large rotations, implicit integration.

Needs the extra `blind` (pip install 'flexlink[blind]'). A second opinion on the truth of the blind protocol:
another beam formulation, another integrator and other authors. Without backlash, air drag, inductance and
uneven friction. The static paths of voltage and sensors are those of `Truth`.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import numpy.typing as npt

from validation.blind.truth import (
    LISTED,
    PRE_SLIDING_RAD,
    UNLISTED,
    Clean,
    Effects,
    Feedback,
    Real,
    RigTable,
    Truth,
    amplified,
)
from workflow.engine.errors import InputError

SUPPORTED = tuple(
    name
    for name in LISTED + UNLISTED
    if name not in ("backlash", "air_drag", "inductance", "asymmetric_friction")
)
_ELEMENTS = 12
_SUBSTEPS = 16
# The link is practically inextensible either way; a softer axis keeps Newton's iteration well conditioned.
_AXIAL_SHARE = 0.01


def load_exudyn() -> Any:
    """The library, or one clear line."""
    try:
        return importlib.import_module("exudyn")
    except ModuleNotFoundError as error:
        raise InputError(
            "the simulator exudyn needs the optional extra: pip install 'flexlink[blind]'"
        ) from error


class ExudynTruth:
    """Takes the place of `Truth` for making records."""

    def __init__(self, rig: RigTable, effects: Effects = ()) -> None:
        names = {str(e["name"]) for e in effects}
        if not names <= set(SUPPORTED):
            raise ValueError(f"not in Exudyn's truth: {', '.join(sorted(names - set(SUPPORTED)))}")
        self._plain = Truth(rig, effects)  # checks, and the static voltage and sensor paths
        self.names, self.get, self.amplifier = names, self._plain.get, self._plain.amplifier
        self.rig = rig
        self.dt_s = self._plain.dt_s
        self.noise = self._plain.noise

    def record(
        self, voltage_V: npt.ArrayLike, feedback: Feedback | None = None, hub_noise_rad: Real | None = None
    ) -> Clean:
        """As `Truth.record`."""
        commanded = np.array(voltage_V, dtype=np.float64)
        noise = np.zeros(commanded.size) if hub_noise_rad is None else np.asarray(hub_noise_rad)
        if feedback is not None:
            commanded[:] = 0.0
        run = _Run(self, commanded, feedback, noise)
        run.solve()
        if not np.all(np.isfinite(run.outputs)):
            raise ValueError("the motion leaves every bound: the loop is unstable or the voltage too high")
        return self._plain.sensed(commanded, run.outputs)


class _Run:
    """One record: the multibody system and what happens before each of its steps."""

    def __init__(self, machine: ExudynTruth, commanded: Real, feedback: Feedback | None, noise: Real) -> None:
        self.machine, self.commanded, self.feedback, self.noise = machine, commanded, feedback, noise
        self.acting = amplified(commanded, machine.amplifier)
        self.outputs = np.full((commanded.size, 2), np.nan)
        self.step_s = machine.dt_s / _SUBSTEPS
        self.delay_s = machine.get("input_delay", "delay_s", 0.0)
        self.step = 0
        self.slip = self.filtered = self.seen_tip = self.tip = self.rate = self.before = 0.0
        self.exu = load_exudyn()
        self._build()

    def _build(self) -> None:
        items = importlib.import_module("exudyn.itemInterface")
        get, rig = self.machine.get, self.machine.rig
        link, hub, motor = rig["link"], rig["hub"], rig["motor"]
        self.radius, self.length = hub["radius_m"], link["length_m"]
        self.container = self.exu.SystemContainer()
        self.mbs = mbs = self.container.AddSystem()
        section = link["width_m"] * link["thickness_m"]
        bending = (
            link["youngs_modulus_Pa"]
            * section
            * link["thickness_m"] ** 2
            / 12
            * get("link_stiffness", "ratio", 1.0)
        )
        damping = bending * link["kelvin_voigt_s"] * get("structural_damping", "ratio", 1.0)
        line = link["density_kg_m3"] * section
        J = hub["inertia_kg_m2"] * get("hub_inertia", "ratio", 1.0)
        ground = mbs.AddObject(items.ObjectGround())
        fixed = mbs.AddNode(items.NodePointGround())
        fixed_mark = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=fixed, coordinate=0))
        # The body that carries the link turns with the hub, or against a spring if the joint is compliant.
        compliant = "joint_compliance" in self.machine.names
        root_node = mbs.AddNode(items.NodeRigidBody2D())
        inertia = 1e-4 * J if compliant else J
        root = mbs.AddObject(items.ObjectRigidBody2D(mass=1.0, inertia=inertia, nodeNumber=root_node))
        pin = [mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=b)) for b in (ground, root)]
        mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=pin))
        root_mark = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=root_node, coordinate=2))
        self.hub_node, self.hub_coordinate, hub_mark = root_node, 2, root_mark
        if compliant:
            self.hub_node, self.hub_coordinate, hub_mark = self._rotor(items, J)
            mbs.AddObject(
                items.ObjectConnectorCoordinateSpringDamper(
                    markerNumbers=[hub_mark, root_mark],
                    stiffness=get("joint_compliance", "stiffness_Nm_rad", 0.0),
                    damping=get("joint_compliance", "damping_Nms", 0.0),
                )
            )
        self.base_node, base_mark = None, fixed_mark
        if "base_compliance" in self.machine.names:
            self.base_node, _, base_mark = self._rotor(items, get("base_compliance", "inertia_kg_m2", 0.0))
            mbs.AddObject(
                items.ObjectConnectorCoordinateSpringDamper(
                    markerNumbers=[fixed_mark, base_mark],
                    stiffness=get("base_compliance", "stiffness_Nm_rad", 0.0),
                    damping=get("base_compliance", "damping_Nms", 0.0),
                )
            )
        self.per_volt = motor["gear_ratio"] * motor["torque_constant_Nm_A"] / motor["resistance_ohm"]
        self.emf = motor["gear_ratio"] * motor["back_emf_Vs_rad"]
        viscous = hub["viscous_friction_Nms"] + get("viscous_friction", "coefficient_Nms", 0.0)
        mbs.AddObject(
            items.ObjectConnectorCoordinateSpringDamper(
                markerNumbers=[base_mark, hub_mark], damping=viscous + self.per_volt * self.emf
            )
        )
        mbs.AddObject(
            items.ObjectConnectorCoordinateSpringDamper(
                markerNumbers=[fixed_mark, hub_mark],
                stiffness=get("ground_spring", "stiffness_Nm_rad", 0.0),
            )
        )
        self.frictions = [
            self._friction(items, base_mark, hub_mark, static, coulomb, speed)
            for static, coulomb, speed in (
                (get("coulomb_friction", "torque_Nm", 0.0), get("coulomb_friction", "torque_Nm", 0.0), 1.0),
                (
                    get("stribeck_friction", "static_torque_Nm", 0.0),
                    get("stribeck_friction", "coulomb_torque_Nm", 0.0),
                    get("stribeck_friction", "stribeck_velocity_rad_s", 1.0),
                ),
            )
            if static > 0
        ]
        self.motor_load = mbs.AddLoad(items.LoadCoordinate(markerNumber=hub_mark, load=0.0))
        self.ground_load = mbs.AddLoad(items.LoadCoordinate(markerNumber=hub_mark, load=0.0))
        self.base_load = None
        if self.base_node is not None:
            self.base_load = mbs.AddLoad(items.LoadCoordinate(markerNumber=base_mark, load=0.0))
        self._beam(items, root, bending, damping, line)

    def _rotor(self, items: Any, inertia: float) -> tuple[int, int, int]:
        node = self.mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
        self.mbs.AddObject(items.ObjectRotationalMass1D(inertia=inertia, nodeNumber=node))
        return node, 0, self.mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=0))

    def _friction(
        self, items: Any, base_mark: int, hub_mark: int, static: float, coulomb: float, speed: float
    ) -> dict[str, float]:
        """An elastic element whose slider moves along once per step."""
        state = {
            "stretch": 0.0,
            "from": 0.0,
            "stiffness": static / PRE_SLIDING_RAD,
            "static": static,
            "coulomb": coulomb,
            "speed": speed,
        }

        def force(mbs: Any, t: float, item: int, u: float, v: float, *rest: float) -> float:
            return state["stiffness"] * _stretched(state, u, v)

        self.mbs.AddObject(
            items.ObjectConnectorCoordinateSpringDamper(
                markerNumbers=[base_mark, hub_mark], springForceUserFunction=force
            )
        )
        return state

    def _beam(self, items: Any, root: int, bending: float, damping: float, line: float) -> None:
        get, mbs = self.machine.get, self.mbs
        link = self.machine.rig["link"]
        axial = _AXIAL_SHARE * link["youngs_modulus_Pa"] * link["width_m"] * link["thickness_m"]
        part = self.length / _ELEMENTS
        nodes = [
            mbs.AddNode(items.NodePoint2DSlope1(referenceCoordinates=[self.radius + k * part, 0.0, 1.0, 0.0]))
            for k in range(_ELEMENTS + 1)
        ]
        gravity = get("gravity", "acceleration_m_s2", 0.0)
        cables = []
        for k in range(_ELEMENTS):
            cable = mbs.AddObject(
                items.ObjectANCFCable2D(
                    length=part,
                    massPerLength=line,
                    bendingStiffness=bending,
                    axialStiffness=axial,
                    bendingDamping=damping,
                    nodeNumbers=[nodes[k], nodes[k + 1]],
                    useReducedOrderIntegration=1,
                )
            )
            cables.append(cable)
            if gravity:
                mark = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=cable))
                mbs.AddLoad(items.LoadMassProportional(markerNumber=mark, loadVector=[gravity, 0.0, 0.0]))
        marks = [
            mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=root, localPosition=[self.radius, 0.0, 0.0])),
            mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=cables[0], localPosition=[0.0, 0.0, 0.0])),
        ]
        mbs.AddObject(items.GenericJoint(markerNumbers=marks, constrainedAxes=[1, 1, 0, 0, 0, 1]))
        self.tip_node = nodes[-1]
        mass = self.machine.rig["payload"]["mass_kg"] + get("tip_payload", "mass_kg", 0.0)
        if mass:
            mbs.AddObject(
                items.ObjectGenericODE2(
                    nodeNumbers=[self.tip_node], massMatrix=np.diag([mass, mass, 0.0, 0.0])
                )
            )
            if gravity:
                mark = mbs.AddMarker(items.MarkerNodePosition(nodeNumber=self.tip_node))
                mbs.AddLoad(items.LoadForceVector(markerNumber=mark, loadVector=[mass * gravity, 0.0, 0.0]))

    def solve(self) -> None:
        """Step to the last sample."""
        self.mbs.SetPreStepUserFunction(self._before_step)
        self.mbs.Assemble()
        # The first half step of voltage only moves the lag; the load at rest is that just after t = 0.
        self._voltage(-0.5 * self.step_s)
        prompt = self.delay_s == 0 and self.machine.get("actuator_lag", "time_constant_s", 0.0) == 0
        self._load(0.0, self.acting[0] if prompt else 0.0, 0.0, 0.0, 0.0)
        settings = self.exu.SimulationSettings()
        count = (self.commanded.size - 1) * _SUBSTEPS + 1
        settings.timeIntegration.numberOfSteps = count
        settings.timeIntegration.endTime = count * self.step_s
        settings.timeIntegration.verboseMode = 0
        settings.timeIntegration.adaptiveStep = False
        settings.timeIntegration.generalizedAlpha.spectralRadius = 0.95
        settings.timeIntegration.newton.useModifiedNewton = not self.frictions
        settings.timeIntegration.newton.relativeTolerance = 1e-8
        settings.timeIntegration.newton.absoluteTolerance = 1e-9
        settings.solution.file.write = False
        settings.linearSolver.solverType = self.exu.LinearSolverType.EXUdense
        settings.parallel.numberOfThreads = 1
        self.exu.config.printToConsole = False
        try:
            self.mbs.SolveDynamic(settings)
        except self.exu.SolverError as error:
            raise ValueError("the motion leaves every bound, or Exudyn's iteration does not end") from error

    def _angles(self) -> tuple[float, float, float, float]:
        """Hub and base angle and speed."""
        kind = self.exu.OutputVariableType
        j = self.hub_coordinate
        hub = float(np.atleast_1d(self.mbs.GetNodeOutput(self.hub_node, kind.Coordinates))[j])
        speed = float(np.atleast_1d(self.mbs.GetNodeOutput(self.hub_node, kind.Coordinates_t))[j])
        if self.base_node is None:
            return hub, speed, 0.0, 0.0
        base = float(np.atleast_1d(self.mbs.GetNodeOutput(self.base_node, kind.Coordinates))[0])
        base_speed = float(np.atleast_1d(self.mbs.GetNodeOutput(self.base_node, kind.Coordinates_t))[0])
        return hub, speed, base, base_speed

    def _before_step(self, mbs: Any, t: float) -> bool:
        h = self.step_s
        hub, speed, base, base_speed = self._angles()
        self._look(hub, base)
        # Loads are those of the end of the step (generalised alpha weighs them with the step before), so a
        # held voltage is averaged around that instant; half a step of delay would remain otherwise.
        slip = speed - base_speed
        shaft = hub - base + h * slip
        volt = self._voltage((self.step + 0.5) * h)
        self._load((self.step + 1) * h, volt, shaft, 2 * slip - self.slip, hub + h * speed)
        self.slip = slip
        for state in self.frictions:
            state["stretch"] = _stretched(state, hub - base, slip)
            state["from"] = hub - base
        self.step += 1
        return bool(abs(hub) < 7.0)

    def _load(self, time: float, volt: float, shaft: float, slip: float, hub: float) -> None:
        """Set motor torque and what acts from ground; the rest is springs and dampers of the system."""
        get, mbs = self.machine.get, self.mbs
        torque = self.per_volt * volt
        cogging = get("cogging", "relative_amplitude", 0.0)
        turn = get("cogging", "cycles_per_rev", 0.0) * shaft + get("cogging", "phase_rad", 0.0)
        factor = (1 + cogging * np.cos(turn)) / (1 + get("winding_heat", "rate_1_s", 0.0) * time)
        torque += (factor - 1) * self.per_volt * (volt - self.emf * slip)
        ripple = get("torque_ripple", "cycles_per_rev", 0.0) * shaft + get("torque_ripple", "phase_rad", 0.0)
        torque += get("torque_ripple", "amplitude_Nm", 0.0) * np.sin(ripple)
        outside = -get("hardening_spring", "cubic_Nm_rad3", 0.0) * hub**3
        turn = 2 * np.pi * get("periodic_disturbance", "frequency_Hz", 0.0) * time
        turn += get("periodic_disturbance", "phase_rad", 0.0)
        outside += get("periodic_disturbance", "amplitude_Nm", 0.0) * np.sin(turn)
        mbs.SetLoadParameter(self.motor_load, "load", float(torque))
        mbs.SetLoadParameter(self.ground_load, "load", float(outside))
        if self.base_load is not None:
            mbs.SetLoadParameter(self.base_load, "load", -float(torque))

    def _look(self, hub: float, base: float) -> None:
        """Tip and its sensor lag at every step; samples and the controller at every sixteenth."""
        x, y, _ = self.mbs.GetNodeOutput(self.tip_node, self.exu.OutputVariableType.Position)
        now = (self.radius + self.length) * hub - x * np.sin(hub) + y * np.cos(hub)
        lag = self.machine.get("sensor_lag", "time_constant_s", 0.0)
        if lag > 0 and self.step:
            slope, decay = (now - self.tip) / self.step_s, np.exp(-self.step_s / lag)
            self.seen_tip = now - slope * lag + (self.seen_tip - self.tip + slope * lag) * decay
        self.tip = now
        k, rest = divmod(self.step, _SUBSTEPS)
        if rest or k >= self.commanded.size:
            return
        self.outputs[k] = hub - base, self.seen_tip if lag > 0 else now
        control = self.feedback
        if control is not None and k + 1 < self.commanded.size:
            measured = hub - base + self.noise[k]
            pole = control.filter_pole
            self.rate = pole * self.rate + (1 - pole) * (measured - self.before) / self.machine.dt_s
            self.before = measured
            command = control.proportional_V_rad * (control.reference_rad[k] - measured)
            command -= control.derivative_Vs_rad * self.rate
            self.commanded[k + 1] = np.round(command, 4)
            self.acting[k + 1] = amplified(self.commanded[k + 1 : k + 2], self.machine.amplifier)[0]

    def _voltage(self, begin: float) -> float:
        """Mean over the step of the delayed, lagged voltage."""
        h, dt = self.step_s, self.machine.dt_s
        at = (begin - self.delay_s) / dt
        k = int(np.floor(at + 1e-9))
        first = self.acting[k] if 0 <= k < self.acting.size else 0.0
        left = min((k + 1 - at) * dt, h)
        after = self.acting[k + 1] if 0 <= k + 1 < self.acting.size else 0.0
        lag = self.machine.get("actuator_lag", "time_constant_s", 0.0)
        if lag <= 0:
            return float((left * first + (h - left) * after) / h)
        mean = 0.0
        for span, held in ((left, first), (h - left, after)):
            decay = float(np.exp(-span / lag))
            mean += (held * span + (self.filtered - held) * lag * (1 - decay)) / h
            self.filtered = held + (self.filtered - held) * decay
        return mean


def _stretched(state: dict[str, float], angle: float, speed: float) -> float:
    level = state["coulomb"] + (state["static"] - state["coulomb"]) * np.exp(-abs(speed) / state["speed"])
    limit = level / state["stiffness"]
    return float(min(max(state["stretch"] + angle - state["from"], -limit), limit))
