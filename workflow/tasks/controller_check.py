"""What a gap means for a controller: designed on the nominal rig, and again on the repaired one.

Both designs have the same specification, made from the nominal rig: bandwidth a tenth of its first flexible
mode, modulus margin 0.5, voltages as large as in the records. Predicted is the linear model the design saw;
achieved is the repaired machine with all its effects, which stands for the real one. Costs are the integral
of the squared tip error over the squared move, for a step of the hub angle and then a short push by the
voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from control_design.analysis.certificate import certify
from control_design.analysis.closed_loop import LinearMachine, SampledMachine, measure_sensitivity, simulate
from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import PlantChannel, UncertainPlant, modes_of
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import Outcome
from diagnosis.machine.case import Case
from plant.effects import Effect, make_machine
from plant.machine import VoltagePath
from plant.modal import default_n_modes, equations_of_motion
from plant.rig import Rig
from plant.simulation import SampledArm
from workflow.engine import codec
from workflow.tasks.loop_sensitivity import LEAD_IN, SETTLED, plan_sensitivity, rms_of, settling_samples

if TYPE_CHECKING:
    import control

Real = npt.NDArray[np.float64]

# Bandwidth asked for, as a share of the first flexible mode: far below it any arm has a controller.
_BANDWIDTH_SHARE = 0.1
# The usual one: gain margin 2, phase margin 29 degrees.
_MODULUS_MARGIN = 0.5
# A loop far below the first mode needs a lead and no more.
_ORDER = 2
# The second shows whether the first is an optimum.
_STARTS = 2
# Gamma at which the search for a controller ends.
_ENOUGH = 0.9
# Samples of a trial at least: its step, its push and the rest after both are seen.
_SHORTEST = 400
# Samples of a trial at most: a loop that settles later than this is slow enough as it is.
_LONGEST = 3000
# Size of the push in the middle of a trial, as a share of the records' RMS voltage. Chosen: it is seen beside
# the step and saturates nothing.
_PUSH = 0.2
# Parts of a trial of which one is the push, and the last one of each half decides whether the loop settles.
_PARTS = 20
# Any; the same for both controllers.
_SEED = 2006


@dataclass(frozen=True, eq=False)
class Run:
    """One closed loop: cost [s], smallest distance from -1, tip position and command (T,) over the trial.

    modulus_margin: nominal margin of the design on its own model, one over the largest measured |S| on the
    machine. settles: at the end of the trial it moves by less than a tenth of the step.
    """

    design: str
    machine: str
    cost_s: float
    modulus_margin: float
    peak_command_V: float
    settles: bool
    tip_m: Real
    command_V: Real


@dataclass(frozen=True, eq=False)
class ControllerCheck:
    """Four runs on one trial: design on the stated rig predicted and achieved, design on the repaired one
    likewise."""

    trial: ControllerTrial
    specification: Specification
    certified: tuple[bool, bool]
    runs: tuple[Run, Run, Run, Run]

    def document(self) -> dict[str, Any]:
        specification = {
            "bandwidth_rad_s": self.specification.bandwidth_rad_s,
            "modulus_margin": self.specification.modulus_margin,
            "effort_limit_V_rad": self.specification.effort_limit,
            "controller_order": self.specification.controller_order,
        }
        certified_nominal, certified_repaired = self.certified
        certified = {"nominal parameters": certified_nominal, "repaired": certified_repaired}
        return {
            "specification": specification,
            "step_rad": self.trial.step_rad,
            "disturbance_V": float(np.max(self.trial.disturbance_V)),
            "certified_on_own_model": certified,
            "runs": [codec.plain(run, arrays=False) for run in self.runs],
        }


class NoControllerError(Exception):
    """No controller to compare with, and why."""


def check_controller(case: Case, rig: Rig, effects: tuple[Effect, ...]) -> ControllerCheck:
    """Design on `case.rig` and on the repaired rig with its effects, run both on the repaired machine.

    Raises NoControllerError where a plant allows no controller of this kind.
    """
    machines = sampled_linear_machine(case.rig, ()), sampled_linear_machine(rig, effects)
    names = ("nominal parameters", "repaired")
    plants = [_plant(name, machine) for name, machine in zip(names, machines, strict=True)]
    specification = _specification(case, plants[0])
    # One specification for both, so that the designs differ by what each knows of the arm only.
    designs = [_designed(plant, specification) for plant in plants]
    certificates = [certify(k, [p], specification) for k, p in zip(designs, plants, strict=True)]
    trial = ControllerTrial.of(case, designs[0], plants[0])
    arm = _WatchedArm(rig, effects)
    runs = []
    for controller, plant, machine, certificate in zip(designs, plants, machines, certificates, strict=True):
        margin = certificate.plants[0].nominal_margins.modulus
        runs.append(trial.run(controller, LinearMachine(machine), plant.name, "its own model", margin))
        # On the arm: one over the largest |S| measured there.
        input_rms = rms_of([e.voltage_V for e in case.estimation])
        plan = plan_sensitivity(controller, plant, input_rms, trial.time_s.size // 2)
        seen = measure_sensitivity(controller, arm, np.random.default_rng(_SEED), **plan.excitation())
        measured_margin = 1.0 / seen.peak[0]
        runs.append(trial.run(controller, arm, plant.name, "repaired machine", measured_margin))
    return ControllerCheck(
        trial=trial,
        specification=specification,
        certified=(certificates[0].certified, certificates[1].certified),
        runs=(runs[0], runs[1], runs[2], runs[3]),
    )


def _plant(name: str, both: control.StateSpace) -> UncertainPlant:
    """The hub channel of a linear machine with both outputs, for the design."""
    # Imported here: it brings a plotting library with it.
    import control

    no_feedthrough = np.zeros((1, 1))
    hub, tip = (control.ss(both.A, both.B, both.C[i : i + 1], no_feedthrough, both.dt) for i in (0, 1))
    try:
        return UncertainPlant(hub, name=name, uncertainty=None, performance=PlantChannel(tip))
    except ValueError as error:
        raise NoControllerError(str(error)) from error


def _specification(case: Case, plant: UncertainPlant) -> Specification:
    modes = modes_of(plant.poles, plant.dt_s)
    if not modes:
        raise NoControllerError("the nominal rig has no lightly damped mode to set a bandwidth by")
    first = modes[0].omega_rad_s
    largest_V = _largest_voltage(case)
    return Specification(
        bandwidth_rad_s=_BANDWIDTH_SHARE * first,
        modulus_margin=_MODULUS_MARGIN,
        # The step alone may ask for the largest voltage of the records.
        effort_limit=largest_V / _step(case),
        effort_rolloff_rad_s=2 * first,
        input_limit=largest_V,
        controller_order=_ORDER,
    )


def _largest_voltage(case: Case) -> float:
    return max(float(np.max(np.abs(e.voltage_V))) for e in case.experiments)


def _step(case: Case) -> float:
    """Half the spread of the hub angle in the records."""
    return 0.5 * rms_of([e.output[:, 0] for e in case.estimation])


def _designed(plant: UncertainPlant, specification: Specification) -> Controller:
    options = SynthesisOptions(starts=_STARTS, sufficient_gamma=_ENOUGH)
    try:
        synthesis = synthesise([plant], specification, options, rng=np.random.default_rng(_SEED))
    except SpecificationError as error:
        raise NoControllerError(str(error)) from error
    if synthesis.outcome is Outcome.NOT_CONVERGED:
        raise NoControllerError(f"{plant.name}: no start led to a stable loop")
    return synthesis.controller


@dataclass(frozen=True, eq=False)
class ControllerTrial:
    """A step after a lead-in, half-way a short push by the voltage as well; arrays (T,)."""

    time_s: Real
    reference_rad: Real
    disturbance_V: Real
    arm_m: float

    @classmethod
    def of(cls, case: Case, controller: Controller, plant: UncertainPlant) -> ControllerTrial:
        dt = case.rig.sampling.dt_s
        radius = float(np.max(np.abs(closed_loop_poles(controller, plant))))
        k = np.arange(settling_samples(radius, _SHORTEST, _LONGEST))
        half = k.size // 2
        mean_squares = [np.mean(experiment.voltage_V**2) for experiment in case.estimation]
        voltage = float(np.sqrt(np.mean(mean_squares)))
        is_after_step = k >= round(LEAD_IN * k.size)
        is_pushed = (k >= half) & (k < half + k.size // _PARTS)
        return cls(
            time_s=np.asarray(k * dt, dtype=np.float64),
            reference_rad=np.where(is_after_step, _step(case), 0.0),
            disturbance_V=np.where(is_pushed, _PUSH * voltage, 0.0),
            arm_m=case.rig.hub.radius_m + case.rig.link.length_m,
        )

    @property
    def reference_m(self) -> Real:
        """Tip position (T,) asked for."""
        return np.asarray(self.arm_m * self.reference_rad)

    @property
    def step_rad(self) -> float:
        return float(self.reference_rad[-1])

    def run(
        self, controller: Controller, machine: SampledMachine, design: str, on: str, margin: float
    ) -> Run:
        """What a controller does in this trial.

        Args:
            controller: The law.
            machine: Its last output is the tip position.
            design: What the controller was designed on, in words.
            on: What it runs on, in words.
            margin: Modulus margin of the loop.
        """
        loop = simulate(controller, machine, self.reference_rad, input_disturbance=self.disturbance_V)
        tip = loop.output[:, -1]
        n = self.time_s.size
        error = (self.reference_m - tip) / (self.arm_m * self.step_rad)
        # Before the push and at the end nothing may move any more.
        ends = [loop.measured[stop - n // _PARTS : stop] for stop in (n // 2, n)]
        settles = all(np.ptp(end) <= SETTLED * self.step_rad for end in ends)
        peak_V = float(np.max(np.abs(loop.command)))
        return Run(
            design=design,
            machine=on,
            cost_s=float(np.sum(error**2)) * controller.dt_s,
            modulus_margin=margin,
            peak_command_V=peak_V,
            settles=bool(settles),
            tip_m=tip,
            command_V=loop.command,
        )


class _WatchedArm(SampledArm):
    """The arm, with the true tip position as a third output."""

    in_loop = None  # type: ignore[assignment]  # it measures two outputs

    def measure(self) -> Real:
        return np.append(super().measure(), self.true_output[1])


def sampled_linear_machine(rig: Rig, effects: Sequence[Effect]) -> control.StateSpace:
    """voltage_V -> (hub_angle_rad, tip_m), the voltage held over the rig's sampling period.

    Rig values, compliances, gain, delay (any fraction of a sample) and lag of the actuator are in it. Dry
    friction, backlash, dead zone, saturation, ripple, the hardening spring, gravity and everything behind the
    tip sensor are not: they have no linear model, or none that is fed back.
    """
    machine = make_machine(rig, effects)
    if machine.joint.backlash_gap_rad is not None:
        machine = replace(machine, joint=replace(machine.joint, backlash_gap_rad=None))
    equations = equations_of_motion(machine, default_n_modes(machine.rig))
    a = equations.state_matrix()
    torque = machine.rig.motor.torque_per_volt_Nm_V * equations.shaft
    b = machine.voltage.gain * equations.input_column(torque)[:, None]
    c = np.array([equations.position_row(equations.encoder), equations.position_row(equations.tip)])
    if machine.voltage.lag_s > 0:
        a, b, c = _with_lag(a, b, c, machine.voltage.lag_s)
    return _sampled(a, b, c, rig.sampling.dt_s, machine.voltage)


def _with_lag(a: Real, b: Real, c: Real, lag_s: float) -> tuple[Real, Real, Real]:
    """The acting voltage as a further state."""
    n = a.shape[0]
    wide = np.zeros((n + 1, n + 1))
    wide[:n, :n] = a
    wide[:n, n:] = b
    wide[n, n] = -1 / lag_s
    column = np.zeros((n + 1, 1))
    column[n] = 1 / lag_s
    no_output = np.zeros((c.shape[0], 1))
    return wide, column, np.hstack([c, no_output])


def _sampled(a: Real, b: Real, c: Real, dt_s: float, path: VoltagePath) -> control.StateSpace:
    """Exact under a held input that arrives late: past samples of the voltage become states."""
    # A delay of whole samples may come out of the division a rounding error below.
    whole = int(path.delay_s / dt_s * (1 + 1e-12))
    late = max(path.delay_s - whole * dt_s, 0.0)
    n = a.shape[0]
    first, early = _held(a, b, late)
    second, now = _held(a, b, dt_s - late)
    past = whole
    if late > 0:
        past += 1
    # columns[:, k]: effect of the voltage commanded k samples ago.
    columns = np.zeros((n, past + 1))
    columns[:, whole] += now[:, 0]
    if late > 0:
        columns[:, whole + 1] += (second @ early)[:, 0]
    A = np.zeros((n + past, n + past))
    B = np.zeros((n + past, 1))
    A[:n, :n] = second @ first
    A[:n, n:] = columns[:, 1:]
    B[:n] = columns[:, :1]
    if past:
        B[n] = 1.0
        A[n + 1 :, n:-1] = np.eye(past - 1)
    # Imported here: it brings a plotting library with it.
    import control

    # The voltages that are still on their way do not show in the outputs.
    C = np.hstack([c, np.zeros((c.shape[0], past))])
    D = np.zeros((c.shape[0], 1))
    return control.ss(A, B, C, D, dt_s)


def _held(a: Real, b: Real, time_s: float) -> tuple[Real, Real]:
    """e^(a t) and the integral of e^(a s) b over (0, t)."""
    # Imported here: it takes its time to load.
    from scipy.signal import cont2discrete

    # Outputs are asked for by the function, but not used.
    c = np.zeros((1, len(a)))
    d = np.zeros((1, b.shape[1]))
    step, held, *_ = cont2discrete((a, b, c, d), time_s, "zoh")
    return step, held
