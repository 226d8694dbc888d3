"""The loop on the nonlinear arm under conditions it was not designed in, each beside the same prediction.

The prediction is the identified model with the controller and its limits; it does not know payload, delay,
friction and converter steps. A push at the tip enters it as a disturbance of the output: the free arm's
answer, computed without friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from control_design.analysis.closed_loop import ClosedLoopTrajectory, simulate
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from ident.data.arrays import RealArray
from ident.uncertainty import ResponsePosterior
from plant.effects import EFFECTS, parse_effects
from plant.machine import Machine
from plant.rig import Rig
from plant.simulation import simulate as simulate_arm
from workflow.config.run_config import ClosedLoopOptions, SimulatedSource
from workflow.tasks.loop_sensitivity import SETTLED
from workflow.tasks.results import ConditionRun
from workflow.tasks.sampled_plant import FINITE, realise, simulate_plant
from workflow.tasks.simulated_rig import OUTPUT_NAMES, UNITS, encoded_arm
from workflow.text.sentences import conditions

# Share of the voltage limit that the slew is predicted to use. Chosen, so that other conditions have room.
_SLEW_SHARE = 0.6
# Voltage that the large step would need, over the limit. Chosen; at 1 the limit would not act.
_OVERDRIVEN = 2.0
# Length of the push [s]: half a period of 5 Hz, which excites the first modes.
_PUSH_S = 0.1


def condition_run(
    name: str,
    words: str,
    reference: RealArray,
    predicted: ClosedLoopTrajectory,
    achieved: ClosedLoopTrajectory,
    size: float,
) -> ConditionRun:
    """One run beside its prediction, errors in percent of `size`: the move, or the predicted swing."""
    error = 100 * (reference - achieved.measured) / size
    away = 100 * (achieved.measured - predicted.measured) / size
    tail = error[-max(1, error.size // 10) :]
    moves = bool(np.any(reference != 0))
    beyond_target = float(np.max(achieved.measured) - np.max(reference))
    passed = 100 * beyond_target / size
    largest_difference = np.max(np.abs(away))
    rms_difference = np.sqrt(np.mean(away**2))
    peak_command = np.max(np.abs(achieved.command))
    return ConditionRun(
        name=name,
        words=words,
        size=size,
        largest_difference_percent=float(largest_difference),
        rms_difference_percent=float(rms_difference),
        overshoot_percent=max(0.0, passed) if moves else None,
        error_left_percent=float(np.mean(tail)),
        peak_command=float(peak_command),
        limited_fraction=float(np.mean(achieved.limited)),
        settled=bool(np.ptp(tail) <= 100 * SETTLED),
        reference=reference,
        predicted=predicted.measured,
        achieved=achieved.measured,
        predicted_command=predicted.command,
        achieved_command=achieved.command,
    )


@dataclass(frozen=True, eq=False)
class ConditionBench:
    """Everything the conditions share.

    reference: (T,) step after a lead-in; reference_filter: what every reference goes through, if any;
    options: effects and steps of the closed-loop check; rng: noise of run k comes from the k-th spawned
    generator.
    """

    controller: Controller
    posterior: ResponsePosterior
    source: SimulatedSource
    options: ClosedLoopOptions
    rig: Rig
    reference: RealArray
    measured: int
    rng: np.random.Generator
    reference_filter: ReferenceFilter | None = None

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Effects of the arm the controller meets, by name."""
        every_effect = (*self.source.effects, *self.options.effects)
        return {str(effect["name"]): dict(effect) for effect in every_effect}

    def predict(
        self,
        reference: RealArray,
        *,
        law: Controller | None = None,
        output_disturbance: RealArray | None = None,
        clip: float = np.inf,
    ) -> ClosedLoopTrajectory:
        """The loop on the posterior mean, which has no friction for a feed-forward to meet."""
        return simulate_plant(
            replace(law or self.controller, feedforward=None),
            realise(self.posterior, self.posterior.mean),
            self._filtered(reference),
            output_disturbance=output_disturbance,
            clip=clip,
        )

    def _filtered(self, reference: RealArray) -> RealArray:
        """What the loop is given for a reference."""
        return reference if self.reference_filter is None else self.reference_filter.filtered(reference)

    @property
    def step(self) -> float:
        return float(self.reference[-1])

    def slew(self) -> ConditionRun:
        """A smooth move, as large as the voltage allows."""
        n = self.reference.size
        start = n // 20
        length = max(2, round(0.4 * n))
        samples_moving = np.arange(n) - start
        x = np.clip(samples_moving / length, 0.0, 1.0)
        # The shortest polynomial from 0 to 1 that begins and ends without speed and acceleration.
        shape = x**3 * (10 - 15 * x + 6 * x**2)
        size = 4 * self.step
        if self.controller.input_limit is not None:
            # The loop is linear: its command grows with the move.
            unit_move = self.predict(shape, law=self._unlimited)
            peak = float(np.max(np.abs(unit_move.command)))
            size = min(_SLEW_SHARE * self.controller.input_limit / peak, 20 * self.step)
        words = conditions.smooth_move(length * self.controller.dt_s)
        return self._run("slew", words, np.asarray(size * shape))

    def push(self) -> ConditionRun:
        """A half-sine force at the tip, set point zero."""
        dt = self.controller.dt_s
        n = self.reference.size
        start = n // 20
        length = max(2, round(_PUSH_S / dt))
        force = np.zeros(n)
        phase = np.pi * (np.arange(length) + 0.5) / length
        # What would last beyond the run is cut off.
        force[start : start + length] = np.sin(phase)[: n - start]
        effects = parse_effects(self.effects.values())
        linear = [effect for effect in effects if effect.modify(Machine(self.rig)).linear]
        free = simulate_arm(
            self.rig, np.zeros(n), linear, rng=None, tip_force_N=force, n_modes=self.source.modes
        )
        hub_and_tip = np.column_stack([free.hub_angle_true_rad, free.tip_true_m])
        answer = hub_and_tip[:, self.measured]
        # So strong a push that the free arm swings as far as the reference step goes.
        scale = self.step / float(np.max(np.abs(answer)))
        return self._run(
            "push at the tip",
            conditions.half_sine(scale, 1e3 * length * dt),
            np.zeros(n),
            output_disturbance=scale * answer,
            tip_force_N=scale * force,
        )

    def payloads(self) -> list[ConditionRun]:
        """0, 100 and 200 % of the rated payload: that of the rig and its effects, or a tenth of the link.

        A tenth is chosen: an arm without a payload is there to carry some, and this one it does not notice
        much.
        """
        link = self.rig.link
        # Of the mass of the link alone, without hub and payload [kg].
        tenth = 0.1 * link.density_kg_m3 * link.width_m * link.thickness_m * link.length_m
        extra = float(self.effects.get("tip_payload", {}).get("mass_kg", 0.0))
        rated = self.rig.payload.mass_kg + extra or tenth
        without = {"tip_payload": {"name": "tip_payload", "mass_kg": 0.0}}
        runs = []
        for percent in (0, 100, 200):
            mass_kg = rated * percent / 100
            runs.append(
                self._run(
                    f"payload {percent} %",
                    conditions.payload(1e3 * rated * percent / 100),
                    effects=without,
                    # It sets the value.
                    rig=self.rig.perturbed({"payload.mass_kg": mass_kg}),
                )
            )
        return runs

    def late(self) -> ConditionRun:
        """One sample of delay more."""
        delay_s = float(self.effects.get("input_delay", {}).get("delay_s", 0.0))
        longer = {"input_delay": {"name": "input_delay", "delay_s": delay_s + self.controller.dt_s}}
        return self._run("late", conditions.more_delay(1e3 * self.controller.dt_s), effects=longer)

    def frictions(self) -> list[ConditionRun]:
        """None of the arm's joint friction effects, and twice as much of each."""
        frictions = {name: effect for name, effect in self.effects.items() if EFFECTS[name].friction}
        if not frictions:
            return []

        def scaled(factor: float) -> dict[str, dict[str, Any]]:
            # Torques, and coefficients that make torques of speeds.
            return {
                name: {key: factor * value if "_Nm" in key else value for key, value in effect.items()}
                for name, effect in frictions.items()
            }

        names = list(frictions)
        return [
            self._run("no friction", conditions.other_friction(names, 0), effects=scaled(0.0)),
            self._run("double friction", conditions.other_friction(names, 2), effects=scaled(2.0)),
        ]

    def coarse(self) -> ConditionRun:
        """Converters of eight bits and an encoder four times as coarse."""
        limit = self.controller.input_limit
        if not limit:
            command_of_step = self.predict(self.reference).command
            limit = float(np.max(np.abs(command_of_step)))
        # Eight bits from limit to limit, and never finer than the converters of the trial.
        command = max(limit / 128, self.options.quantisation)
        finest = max(self.source.encoder_step_rad, self.options.measurement_step)
        measurement = 4 * finest or 0.004 * self.step
        words = conditions.coarse_steps(command, measurement, UNITS[OUTPUT_NAMES[self.measured]])
        return self._run("coarse", words, steps=(measurement, command))

    def overdriven(self) -> list[ConditionRun]:
        """A step that needs twice the voltage there is, with anti-windup and without."""
        limit = self.controller.input_limit
        if limit is None:
            return []
        free = self._unlimited
        command = self.predict(self.reference, law=free).command
        peak = float(np.max(np.abs(command)))
        reference = self.reference * (_OVERDRIVEN * limit / peak)
        limit_known = conditions.overdriven(_OVERDRIVEN, known=True)
        limit_ignored = conditions.overdriven(_OVERDRIVEN, known=False)
        return [
            self._run("voltage limit", limit_known, reference),
            self._run("no anti-windup", limit_ignored, reference, law=free, clip=limit),
        ]

    @property
    def _unlimited(self) -> Controller:
        return replace(self.controller, input_limit=None, rate_limit=None)

    def _run(
        self,
        name: str,
        words: str,
        reference: RealArray | None = None,
        *,
        law: Controller | None = None,
        clip: float = np.inf,
        output_disturbance: RealArray | None = None,
        effects: Mapping[str, Mapping[str, Any]] | None = None,
        rig: Rig | None = None,
        steps: tuple[float, float] | None = None,
        tip_force_N: RealArray | None = None,
    ) -> ConditionRun:
        """The reference (the step, unless another is given) predicted, and achieved on the arm with effects
        exchanged by name; steps: of measurement and command."""
        reference = self.reference if reference is None else reference
        predicted = self.predict(reference, law=law, output_disturbance=output_disturbance, clip=clip)
        changed = {key: dict(effect) for key, effect in (effects or {}).items()}
        extra = list((self.effects | changed).values())
        rng = self.rng.spawn(1)[0]
        arm = encoded_arm(self.source, extra, rng, rig=rig or self.rig, tip_force_N=tip_force_N)
        measurement, command = steps or (self.options.measurement_step, self.options.quantisation)
        achieved = simulate(
            law or self.controller,
            arm,
            self._filtered(reference),
            measured_index=self.measured,
            measurement_step=measurement,
            command_step=command,
            clip=min(clip, FINITE),
        )
        size = float(reference[-1]) or float(np.max(np.abs(predicted.measured)))
        return condition_run(name, words, reference, predicted, achieved, size)
