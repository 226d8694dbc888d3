"""The loop on the identified arm with its dry friction, which the linear prediction knows nothing of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import control
import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from control_design.analysis.closed_loop import ClosedLoopTrajectory, MeasuredSensitivity, sensitivity_of
from control_design.controllers.controller import Controller
from control_design.controllers.feedforward import FrictionFeedforward
from ident.friction import FrictionFit, FrictionLaw
from ident.friction.loop import loop_through

Real = npt.NDArray[np.float64]
Interval = tuple[float, float]

# A step sought by bisection is right to this share of itself; how far around the guess it may lie.
_SHARE, _APART = 0.01, 10.0


@dataclass(frozen=True, eq=False)
class FrictionLoop:
    """A controller, with its limits and feed-forward, around one arm of a fit.

    coefficients (P,) and friction: of the arm; the steps as of
    `control_design.analysis.closed_loop.simulate`. Neglected: limits other than the controller's own.
    """

    controller: Controller
    found: FrictionFit
    coefficients: Real
    friction: FrictionLaw
    measurement_step: float = 0.0
    command_step: float = 0.0

    @classmethod
    def of(cls, controller: Controller, found: FrictionFit, **steps: float) -> FrictionLoop:
        """On the arm as it was fitted."""
        return cls(controller, found, found.coefficients, found.law, **steps)

    def run(self, reference: Real, noise: np.random.Generator | None = None) -> ClosedLoopTrajectory:
        """From rest, reference (T,); noise: white, of the size of the fit's residual (sensor and encoder)."""
        law, arm = self.controller, self.found.arm
        n = reference.size
        measured, command, limited = np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
        loop_through(
            np.ascontiguousarray(reference, dtype=np.float64),
            np.zeros(n) if noise is None else self.found.noise_std * noise.standard_normal(n),
            np.zeros(n) if law.feedforward is None else law.feedforward.signal(reference, law.dt_s),
            self._law,
            np.array([law.input_limit or np.inf, (law.rate_limit or np.inf) * law.dt_s]),
            np.array([self.measurement_step, self.command_step]),
            law.computational_delay_samples,
            arm.structure.input_delay_samples,
            arm.rates,
            arm.chain,
            arm.weights @ self.coefficients,
            arm.dt_s,
            self.friction.array,
            measured,
            command,
            limited,
        )
        time_s = np.asarray(np.arange(n) * law.dt_s, dtype=np.float64)
        return ClosedLoopTrajectory(time_s, reference, measured[:, None], command, limited, law.dt_s)

    @cached_property
    def _law(self) -> Real:
        law = self.controller
        assert law.anti_windup_gain is not None
        matrix = np.block([[law.A, law.B, law.anti_windup_gain], [law.C, law.D, np.zeros((1, 1))]])
        return np.ascontiguousarray(matrix, dtype=np.float64)

    def sensitivity(
        self, phases: np.random.Generator, noise: np.random.Generator, **excitation: Any
    ) -> MeasuredSensitivity:
        """S as it would be measured with the excitation of `sensitivity_of`."""
        return sensitivity_of(
            lambda reference: self.run(reference, noise), phases, dt_s=self.controller.dt_s, **excitation
        )

    def sticking_step(self, samples: int) -> float:
        """Largest step of the reference after which the shaft stays in its pre-sliding deflection, without
        noise, for so many samples (in which the controller's command settles). 0 where none was found."""

        def sticks(size: float) -> bool:
            moved = self.run(np.full(samples, size)).measured
            return bool(np.max(np.abs(moved)) <= self.friction.presliding)

        # While the shaft stands, the command is the controller's answer to a constant error.
        law = self.controller
        answer = control.step_response(law.to_control(), np.arange(samples) * law.dt_s).outputs
        reach = float(np.max(np.abs(answer)))
        size = self.friction.breakaway / reach
        low, high = size / _APART, size * _APART
        if not (size > 0 and sticks(low)):
            return 0.0
        while high > (1 + _SHARE) * low:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if sticks(middle) else (low, middle)
        return low

    @property
    def error_at_rest(self) -> float:
        """Largest error with which the arm may stay at rest: level over |K + 1 / G| at standstill, where an
        arm that integrates has 1 / G = 0 and integral action leaves no error."""
        # A millionth of the Nyquist frequency: there an integrator is as good as infinite.
        omega = np.array([1e-6 * np.pi / self.controller.dt_s])
        gain = self.controller.response(omega) + 1 / self.found.model.frequency_response(omega)
        return self.friction.breakaway / float(np.abs(gain[0]))


def drawn(
    controller: Controller, found: FrictionFit, rng: np.random.Generator, draws: int, **steps: float
) -> list[FrictionLoop]:
    """Loops on arms drawn from the covariance of the fit."""
    loops = []
    for _ in range(draws):
        change = found.covariance_factor @ rng.standard_normal(found.covariance_factor.shape[1])
        coefficients, friction = found.moved(change)
        loops.append(FrictionLoop(controller, found, coefficients, friction, **steps))
    return loops


def predicted_peak(
    loops: Sequence[FrictionLoop],
    phases: Callable[[], np.random.Generator],
    noise: np.random.Generator,
    **excitation: Any,
) -> Interval:
    """95 % interval of the peak of |S| as it would be measured with the excitation of `sensitivity_of`, whose
    phases (the same in every call) are known; arm, friction and noise are those of the loops."""
    return interval_of([loop.sensitivity(phases(), noise, **excitation).peak[0] for loop in loops])


def friction_feedforward(controller: Controller, found: FrictionFit) -> FrictionFeedforward:
    """Of the identified friction, as late as T = G K / (1 + G K) is towards standstill."""
    omega = np.array([1e-5 * np.pi / controller.dt_s])
    loop = controller.response(omega) * found.model.frequency_response(omega)
    delay_s = float(-np.angle(loop / (1 + loop))[0] / omega[0])
    law = found.law
    fall = law.fall if law.excess > 0 else 1.0
    return FrictionFeedforward(
        law.level, law.presliding, max(delay_s, controller.dt_s), excess=law.excess, fall=fall
    )


def interval_of(values: Sequence[float], level: float = 0.95) -> Interval:
    """Where one more of these positive values lies: Student's law of their logarithms."""
    logs = np.log(values)
    reach = student.ppf(0.5 + level / 2, logs.size - 1) * np.sqrt(1 + 1 / logs.size) * np.std(logs, ddof=1)
    return float(np.exp(logs.mean() - reach)), float(np.exp(logs.mean() + reach))
