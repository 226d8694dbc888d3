"""The loop on the identified arm with its dry friction: |S| by size of the reference, sticking, error at
rest, and the feed-forward of the friction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from control_design.analysis.closed_loop import (
    ClosedLoopTrajectory,
    MeasuredSensitivity,
    law_arrays,
    sensitivity_of,
    simulate,
    step_metrics,
)
from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.controller import Controller, FrictionFeedforward
from control_design.specification import GIVES_WAY, Specification
from ident.data.arrays import RealArray, kernel_array
from ident.data.ellipses import LEVEL
from ident.friction import FrictionFit, FrictionLaw
from ident.friction.gauss_newton import lag_steps
from ident.friction.kernel import loop_through
from ident.resampling import resampled_friction
from workflow.tasks.loop_sensitivity import (
    SMALL,
    measured_on_arm,
    rms_of,
    sensitivity_plan,
    settling_samples,
)
from workflow.tasks.results import (
    STALLS,
    DesignResult,
    FrictionCheck,
    Interval,
    SensitivityCheck,
    SettlingRange,
    SlowSine,
)
from workflow.tasks.simulated_rig import converter_steps, loop_of_arm
from workflow.tasks.stage import StageInput

# A step sought by bisection is right to this share of itself.
_BISECTION_SHARE = 0.01
# Factor by which that step may lie below or above the guess. Chosen.
_BISECTION_RANGE = 10.0
# Arms drawn for an interval: Student's factor at 95 % is then within a tenth of its limit (2.13 of 1.96).
_DRAWS = 16
# Of a peak of |S|, in percent: half a decibel.
TOLERANCE_PERCENT = 5.0
# Shares of the large size; the first and SMALL are measured by `sensitivity_on_arm`.
_SHARES = (1.0, 0.3, SMALL, 0.03, 0.01)
# The slow sine's period over the delay of the loop; the linear error is 2 pi over that, 2 % of the sine.
_PERIOD_OVER_DELAY = 300.0
# Samples of that period at most.
_LONGEST_PERIOD = 20_000
# Amplitude of the slow sine over the reference step. Chosen.
_SINE_SHARE = 0.2
# Friction lets integral action wait: the step is watched so many times as long as the linear loop needs.
_WATCHED = 20
# Samples for which it is watched at most, unless the linear loop itself needs more.
_MOST_WATCHED = 100_000
# A picture shows at most so many times the trial's step: what moves in that is still seen.
_MOST_SHOWN = 4
# Sizes over which a step's settling time is given, over the one asked for: an octave either way, which a user
# who tries another step hardly leaves; a quarter of an octave apart, with the step itself (share 1) in the
# middle.
STEP_SHARES = 2.0 ** np.linspace(-1.0, 1.0, 9)
# The longest times lie beside jumps, where sticking ends just outside of the band of 2 %: so many further
# sizes are tried there. On eight hunting loops at most 3 % of 300 random sizes settle outside of the range,
# with 15 even sizes up to 13 %.
_MORE_SIZES = 8
# Factor between the times of neighbouring sizes up to which nothing is sought between them.
_JUMP = 1.2


@dataclass(frozen=True, eq=False)
class FrictionLoop:
    """A controller, with its limits and feed-forward, around one arm of a fit.

    Neglected: limits other than the controller's own.

    Attributes
    ----------
    controller : Controller
    fit : FrictionFit
        The fit that the arm is of, at the controller's period.
    coefficients : (P,) array
        Of this arm, in the basis of the fit.
    friction : FrictionLaw
        At the shaft of this arm.
    load_level : float
        Level of the friction at the load behind the first spring, in units of the input; 0 for none.
    measurement_step, command_step : float
        Of the converters, see `control_design.analysis.closed_loop.simulate`.
    """

    controller: Controller
    fit: FrictionFit
    coefficients: RealArray
    friction: FrictionLaw
    load_level: float = 0.0
    measurement_step: float = 0.0
    command_step: float = 0.0

    @classmethod
    def of(cls, controller: Controller, fit: FrictionFit, **steps: float) -> FrictionLoop:
        """The loop on the arm as it was fitted; steps: of the converters, by name."""
        return cls(controller, fit, fit.coefficients, fit.law, fit.beyond, **steps)

    def run(self, reference: RealArray, noise: np.random.Generator | None = None) -> ClosedLoopTrajectory:
        """The loop from rest.

        Parameters
        ----------
        reference : (T,) array
            In units of the output.
        noise : Generator, optional
            Of white measurement noise, as large as the fit's residual (sensor and encoder); None: none.
        """
        law = self.controller
        arm = self.fit.arm
        n = reference.size
        spring = self.fit.spring
        measured = np.empty(n)
        command = np.empty(n)
        limited = np.empty(n, dtype=np.bool_)
        weights = arm.weights @ self.coefficients
        # An arm has inertia. Where the fit has the speed jump against the force, a shaft at rest would creep.
        # It is taken off the fastest real pole: off an integrator it would change the gain at standstill.
        is_real_decay = ~(arm.chain | (arm.rates.imag != 0))
        size = np.where(is_real_decay, np.abs(arm.rates), 0.0)
        if np.any(size):
            jump = float(weights[~arm.chain].real.sum())
            weights[np.argmax(size)] -= min(jump, 0.0)
        measurement_noise = np.zeros(n) if noise is None else self.fit.noise_std * noise.standard_normal(n)
        feedforward = np.zeros(n)
        if law.feedforward is not None:
            feedforward = law.feedforward.signal(reference, law.dt_s)
        loop_through(
            kernel_array(reference),
            measurement_noise,
            feedforward,
            *law_arrays(law),
            np.array([self.measurement_step, self.command_step]),
            law.computational_delay_samples,
            arm.structure.input_delay_samples,
            lag_steps(self.fit.lag),
            arm.stepped(weights),
            arm.dt_s,
            self.friction.array,
            np.zeros(6) if spring is None else spring.array(self.load_level, self.friction),
            measured,
            command,
            limited,
        )
        time_s = np.asarray(np.arange(n) * law.dt_s, dtype=np.float64)
        return ClosedLoopTrajectory(time_s, reference, measured[:, None], command, limited, law.dt_s)

    def answer(self, step: RealArray, filtered: RealArray | None = None) -> ClosedLoopTrajectory:
        """The answer to a step (T,), which is held for as long as friction may make the loop wait.

        filtered (T,): what a reference filter makes of the step; None: there is no filter.
        """
        held = watched_samples(step.size) - step.size
        reference = step if filtered is None else filtered
        run = self.run(np.pad(reference, (0, held), mode="edge"))
        # Errors are counted from the step that was wanted, not from its filtered form.
        return replace(run, reference=np.pad(step, (0, held), mode="edge"))

    def settling(
        self,
        step: RealArray,
        filtered: RealArray | None = None,
        *,
        answer: ClosedLoopTrajectory | None = None,
    ) -> SettlingRange:
        """Settling times over the sizes of a step, of half to twice this one (T,).

        Parameters
        ----------
        step : (T,) array
            The reference, in units of the output.
        filtered : (T,) array, optional
            What a reference filter makes of it.
        answer : ClosedLoopTrajectory, optional
            What `answer` gives for this step, where the caller has it: it is not run again.

        Notes
        -----
        One step's time is chance with dry friction: sticking just inside or just outside of the band of 2 %
        decides, and so do the last digits of the integration. See `SettlingRange`.
        """
        filtered = step if filtered is None else filtered
        dt_s = self.controller.dt_s

        def settling_time_s(share: float) -> float | None:
            if share == 1.0 and answer is not None:
                return step_metrics(answer).settling_time_s
            return step_metrics(self.answer(share * step, share * filtered)).settling_time_s

        shares = STEP_SHARES.tolist()
        times_s = [settling_time_s(share) for share in shares]
        watched_s = (watched_samples(step.size) - int(np.flatnonzero(step)[0])) * dt_s

        # Between neighbours whose times differ most; of two such gaps the wider one.
        for _ in range(_MORE_SIZES):
            seconds = [watched_s if time is None else max(time, dt_s) for time in times_s]
            jumps = np.abs(np.diff(np.log(seconds)))
            if np.max(jumps) <= np.log(_JUMP):
                break
            spacing = np.diff(np.log(shares))
            gap = int(np.argmax(jumps * np.sqrt(spacing)))
            between = float(np.sqrt(shares[gap] * shares[gap + 1]))
            shares.insert(gap + 1, between)
            times_s.insert(gap + 1, settling_time_s(between))

        sizes = tuple(share * float(step[-1]) for share in shares)
        return SettlingRange(sizes, tuple(times_s), watched_s)

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
            run = self.run(np.full(samples, size))
            largest = np.max(np.abs(run.measured))
            return bool(largest <= self.friction.presliding)

        # While the shaft stands, the command is the controller's answer to a constant error.
        law = self.controller
        # Imported here: it brings a plotting library with it.
        import control

        answer = control.step_response(law.to_control(), np.arange(samples) * law.dt_s).outputs
        size = self.friction.breakaway / float(np.max(np.abs(answer)))
        low = size / _BISECTION_RANGE
        high = size * _BISECTION_RANGE
        if not (size > 0 and sticks(low)):
            return 0.0
        while high > (1 + _BISECTION_SHARE) * low:
            middle = float(np.sqrt(low * high))
            if sticks(middle):
                low = middle
            else:
                high = middle
        return low

    @property
    def error_at_rest(self) -> float:
        """Largest error with which the arm may stay at rest: friction over |K + 1 / G| at standstill, where
        an arm that integrates has 1 / G = 0 and integral action leaves no error."""
        # A millionth of the Nyquist frequency: there an integrator is as good as infinite.
        omega = np.array([1e-6 * np.pi / self.controller.dt_s])
        gain = self.controller.response(omega) + 1 / self.fit.model.frequency_response(omega)
        return breakaway_of(self.friction, self.load_level) / float(np.abs(gain[0]))

    def moving_sine(self, omega_rad_s: float) -> float:
        """Amplitude of a sine from which on it moves the arm: friction over |K|, as the command of an
        arm that stands is K times the reference."""
        gain = self.controller.response(np.array([omega_rad_s]), with_delay=False)
        return breakaway_of(self.friction, self.load_level) / float(np.abs(gain[0]))


def watched_samples(samples: int) -> int:
    """Number of samples for which a step is watched that the linear loop follows within so many."""
    return min(_WATCHED * samples, max(_MOST_WATCHED, samples))


def breakaway_of(friction: FrictionLaw, load_level: float) -> float:
    """Force that friction at shaft and load holds together at standstill, in units of the input.

    The friction of the load is taken to fall with speed as that of the shaft does.
    """
    if not friction.level > 0:
        return friction.breakaway
    return friction.breakaway * (1 + load_level / friction.level)


def drawn(
    controller: Controller, fit: FrictionFit, rng: np.random.Generator, draws: int, **steps: float
) -> list[FrictionLoop]:
    """Loops of a controller on arms drawn from the covariance of the fit; steps: of the converters."""
    loops = []
    for _ in range(draws):
        change = fit.covariance_factor @ rng.standard_normal(fit.covariance_factor.shape[1])
        coefficients, friction = fit.moved(change)
        load_level = 0.0
        if fit.spring is not None:
            load_level = max(fit.beyond + float(change[-1]), 0.0)
        loops.append(FrictionLoop(controller, fit, coefficients, friction, load_level, **steps))
    return loops


def predicted_peak(
    loops: Sequence[FrictionLoop],
    phases: Callable[[], np.random.Generator],
    noise: np.random.Generator,
    **excitation: Any,
) -> Interval:
    """95 % interval of the peak of |S| as it would be measured on one more arm like these.

    Parameters
    ----------
    loops : sequence of FrictionLoop
        Two or more, with arm and friction of their own.
    phases : callable
        Returns a generator of the excitation's phases, in the same state in every call.
    noise : Generator
        Of the measurement noise.
    **excitation
        Keywords of `sensitivity_of`.
    """
    return interval_of([loop.sensitivity(phases(), noise, **excitation).peak[0] for loop in loops])


def friction_feedforward(controller: Controller, fit: FrictionFit) -> FrictionFeedforward:
    """Feed-forward of the identified friction at shaft and load.

    It comes as late as T = G K / (1 + G K) does towards standstill, but one sample at least: the loop
    follows its reference with that delay.
    """
    omega = np.array([1e-5 * np.pi / controller.dt_s])
    # Far below all of its own frequencies the closed loop's phase over the frequency is its delay.
    arm = fit.model.frequency_response(omega) * fit.drive_response(omega)
    loop = controller.response(omega) * arm
    closed = loop / (1 + loop)
    delay_s = float(-np.angle(closed)[0] / omega[0])
    law = fit.law
    load_factor = fit.level / law.level if law.level > 0 else 1.0
    return FrictionFeedforward(
        fit.level,
        law.presliding,
        max(delay_s, controller.dt_s),
        excess=load_factor * law.excess,
        fall=law.fall if law.excess > 0 else 1.0,
    )


def interval_of(values: Sequence[float]) -> Interval:
    """95 % interval in which one more of these positive values lies, two or more: Student's law of their
    logarithms."""
    from scipy import stats  # here: it takes its time to load

    logs = np.log(values)
    quantile = stats.t.ppf(0.5 + LEVEL / 2, logs.size - 1)
    reach = quantile * np.sqrt(1 + 1 / logs.size) * np.std(logs, ddof=1)
    return float(np.exp(logs.mean() - reach)), float(np.exp(logs.mean() + reach))


def check_friction(
    stage: StageInput,
    controller: Controller,
    reference: RealArray,
    filtered: RealArray,
    sensitivity: SensitivityCheck | None,
) -> FrictionCheck:
    """What dry friction does to the loop of a controller without feed-forward.

    Parameters
    ----------
    stage : StageInput
        With an identified friction and a certificate.
    controller : Controller
    reference : (T,) array
        A step, and the time in which the linear loop settles.
    filtered : (T,) array
        What a reference filter makes of it.
    sensitivity : SensitivityCheck or None
        |S| measured on the simulated arm: then further sizes are measured, too; None: all is predicted.
    """
    certificate = stage.results.certify.certificate
    assert stage.results.identify.friction is not None
    assert certificate is not None
    fit = resampled_friction(stage.results.identify.friction, controller.dt_s)
    steps = converter_steps(stage.config.closed_loop)
    loops = drawn(controller, fit, stage.rng("closed_loop", "friction"), _DRAWS, **steps)

    # The peak of |S| by size of the reference: predicted over the drawn arms, measured on the machine.
    plan = sensitivity_plan(stage, controller, reference.size)
    names = ["0", "further 1", "1", "further 2", "further 3"]
    low = np.empty(len(_SHARES))
    high = np.empty(len(_SHARES))
    measured = np.empty(len(_SHARES))
    for k, (name, share) in enumerate(zip(names, _SHARES, strict=True)):
        excitation = plan.excitation(share)
        noise = stage.rng("closed_loop", "friction noise", name)
        phases = partial(stage.rng, "closed_loop", "sensitivity", name)
        low[k], high[k] = predicted_peak(loops, phases, noise, **excitation)
        if sensitivity is not None and name.isdigit():
            measured[k] = sensitivity.measured[int(name)].peak
        elif sensitivity is not None:
            measured[k] = measured_on_arm(stage, controller, excitation, name).peak[0]
    sizes = plan.rms * np.array(_SHARES)
    certified = max(plant.worst_peak_sensitivity for plant in certificate.plants)

    # Sticking and the error at rest, on the arm as fitted and on the drawn ones.
    fitted_loop = FrictionLoop.of(controller, fit, **steps)
    radius = float(np.max(np.abs(controller.poles), initial=0.0))
    settle_samples = settling_samples(radius, 200, 6000)
    # With integral action the command grows until the arm moves, however small the step or the error.
    integral = radius > 1 - 1e-9
    sticking = [0.0 if integral else loop.sticking_step(settle_samples) for loop in (fitted_loop, *loops)]
    error_at_rest = 0.0 if integral else fitted_loop.error_at_rest
    breakaway = breakaway_of(fit.law, fit.beyond)

    # The reference step on the arm as fitted.
    run = fitted_loop.answer(reference, filtered)
    first_moved = int(np.flatnonzero(run.reference)[0])
    error = np.abs(run.reference - run.measured)[first_moved:]
    tolerance = TOLERANCE_PERCENT / 100
    middle = np.sqrt(low * high)
    sine_amplitude = _SINE_SHARE * float(reference[-1])
    # A step that does not stick in one of the fits has no interval of logarithms: it begins at 0.
    sticking_interval = interval_of(sticking[1:]) if min(sticking) > 0 else (0.0, max(sticking))
    return FrictionCheck(
        level=breakaway,
        level_interval=_around(breakaway, fit),
        presliding=fit.law.presliding,
        sizes=sizes,
        low=low,
        high=high,
        measured=None if sensitivity is None else measured,
        nominal_peak=plan.nominal_peak,
        certified_peak=certified,
        tolerance_percent=TOLERANCE_PERCENT,
        certified_from=holds_from(sizes, high / certified - 1 - tolerance),
        linear_from=holds_from(sizes, np.abs(middle / plan.nominal_peak - 1) - tolerance),
        sticking_step=sticking[0],
        sticking_interval=sticking_interval,
        error_at_rest=error_at_rest,
        error_interval=_around(error_at_rest, fit),
        step=step_metrics(run),
        settling=fitted_loop.settling(reference, filtered, answer=run),
        watched_s=error.size * controller.dt_s,
        left=float(np.max(error[error.size // 2 :])),
        output=run.measured[: _shown_samples(run, reference.size)],
        tracking=slow_sine(stage, controller, sine_amplitude, on_arm=sensitivity is not None),
        **beside_recorded(stage, fitted_loop, reference),
    )


def _shown_samples(run: ClosedLoopTrajectory, samples: int) -> int:
    """Number of samples of a run that a picture shows.

    Those of the trial's step, or, where its settling takes longer, a little more than that needs, up to
    `_MOST_SHOWN` times the step.
    """
    settling_s = step_metrics(run).settling_time_s
    if settling_s is None:
        return samples
    before = int(np.flatnonzero(run.reference)[0])
    # So that the picture shows that it stays where it settled.
    needed = before + round(1.15 * settling_s / run.dt_s)
    return max(samples, min(needed, _MOST_SHOWN * samples))


def beside_recorded(stage: StageInput, loop: FrictionLoop, step: RealArray) -> dict[str, Any]:
    """The loop that made the logs beside the new one: the fields of `FrictionCheck` that begin with
    "recorded", and `errors`; empty where the logs do not tell that loop.

    It answers the same step (T,); `errors` are the standard deviations of the error on the reference of the
    first log: as logged, of the recorded loop in simulation, of the new loop.
    """
    recorded = recorded_loop(stage, loop)
    record = stage.results.records.fitted(stage.config.control_channel)[0]
    if recorded is None or record.reference is None:
        return {}
    reference = record.reference[:, 0] - record.reference[0, 0]
    recorded_run = recorded.run(reference)
    new_run = loop.run(reference)
    errors = (
        float(np.std(record.reference - record.output)),
        float(np.std(reference - recorded_run.measured)),
        float(np.std(reference - new_run.measured)),
    )
    answer = recorded.answer(step)
    return {
        "recorded": step_metrics(answer),
        "recorded_settling": recorded.settling(step, answer=answer),
        "recorded_output": answer.measured[: step.size],
        "errors": errors,
    }


def recorded_loop(stage: StageInput, loop: FrictionLoop) -> FrictionLoop | None:
    """The controller that made the logs in the place of the loop's, its command not limited.

    None where the logs do not tell it: a law that does not repeat the recorded command is not the one that
    ran, nor is one that ran at another step than the arm is stepped.
    """
    # Imported here: it takes its time to load.
    import scipy.signal

    timing = stage.results.records.timing
    law = None if timing is None else timing.law
    if law is None or law.on_error is None:
        return None
    # The loops are compared sample by sample.
    if abs(law.dt_s - loop.controller.dt_s) > 1e-6 * law.dt_s:
        return None
    numerator, denominator = law.on_error
    state_space = scipy.signal.tf2ss(numerator, denominator)
    recorded = Controller(*state_space, loop.controller.dt_s, computational_delay_samples=0)
    return replace(loop, controller=recorded)


def soonest(
    stage: StageInput, first: DesignResult, again: Callable[[Specification], DesignResult]
) -> DesignResult:
    """A design whose bandwidth was left open, or one `again` of one or two states fewer, whichever lets the
    reference step settle soonest with the identified friction.

    The requirements do not see that a controller with many slow states hunts. Designs are compared by the
    median settling time over sizes of the step (`SettlingRange`). Enough is `STALLS` times what the linear
    loop needs, and no more than the recorded loop takes.
    """
    config = stage.config
    asked = config.specification
    friction = stage.results.identify.friction
    law = first.controller
    if not first.met or friction is None or law is None or asked.lowest_bandwidth_rad_s is None:
        return first
    # A structure that was asked for has the order that it has.
    if asked.structure != "biquads":
        return first
    # The arm at the rate of the controller.
    friction = resampled_friction(friction, law.dt_s)

    # The step of the closed-loop stage, for as long as the slowest pole of the linear loop needs.
    records = stage.results.records.fitted(config.control_channel)
    size = config.closed_loop.reference_step or 0.5 * rms_of([record.output for record in records])
    radii = [np.max(np.abs(closed_loop_poles(law, plant))) for plant in stage.plants]
    samples = settling_samples(max(map(float, radii)), 200, 60_000) // 2
    step = np.append(0.0, np.full(samples, size))

    # What is soon enough.
    loop = FrictionLoop.of(law, friction, **converter_steps(config.closed_loop))
    best = first
    best_s = loop.settling(step).median_s
    without_s = step_metrics(replace(loop, friction=FrictionLaw(0.0)).answer(step)).settling_time_s
    enough_s = np.inf if without_s is None else STALLS * without_s
    recorded = recorded_loop(stage, loop)
    if recorded is not None:
        enough_s = min(enough_s, recorded.settling(step).median_s)

    # No more is tried than the bandwidth that was reached, as fewer states do not slow the loop, and nothing
    # else gives way further.
    reached = first.specification or asked
    fixed: dict[str, Any] = {}
    for key, limit in GIVES_WAY.items():
        fixed |= {key: getattr(reached, key), limit: None}
    if reached.bandwidth_rad_s and reached.bandwidth_rad_s > asked.lowest_bandwidth_rad_s:
        fixed["lowest_bandwidth_rad_s"] = asked.lowest_bandwidth_rad_s
    for fewer in range(1, min(3, law.order)):
        if best_s <= enough_s:
            break
        design = again(asked.model_copy(update={**fixed, "controller_order": law.order - fewer}))
        if design.met and design.controller is not None:
            design_s = replace(loop, controller=design.controller).settling(step).median_s
            if design_s < best_s:
                best = design
                best_s = design_s
    return best


def _around(value: float, fit: FrictionFit) -> Interval:
    """95 % interval of a value that is proportional to the level of the friction."""
    # 95 % of a normal distribution lie within 1.96 standard deviations.
    share = 1.96 * fit.level_std / fit.level if fit.level > 0 else 0.0
    return value * max(1 - share, 0.0), value * (1 + share)


def holds_from(sizes: Sequence[float] | RealArray, excess: RealArray) -> float | None:
    """The size from which on, up to the largest, an excess is not positive.

    Parameters
    ----------
    sizes : (N,) sequence
        Falling.
    excess : (N,) array
        Taken as straight over the logarithm of the size between two of them. nan counts as positive.

    Returns
    -------
    float or None
        None where the excess is positive at the largest size already.
    """
    over = np.flatnonzero(~(excess <= 0))
    if over.size == 0:
        return float(sizes[-1])
    k = int(over[0])
    if k == 0:
        return None
    # The excess is taken as linear over the logarithm of the size.
    before, after = excess[k - 1], excess[k]
    share = before / (before - after)
    ratio = sizes[k] / sizes[k - 1]
    return float(sizes[k - 1] * ratio**share)


def slow_sine(stage: StageInput, controller: Controller, amplitude: float, *, on_arm: bool) -> SlowSine:
    """Errors of the loop on a slow sine, without friction feed-forward and with it.

    Parameters
    ----------
    stage : StageInput
        With an identified friction.
    controller : Controller
    amplitude : float
        Of the sine, in units of the output.
    on_arm : bool
        On the simulated arm of the run; else on the identified arm with its friction.

    Returns
    -------
    SlowSine
        Errors after the first quarter of a period, in which the loop leaves its rest.
    """
    assert stage.results.identify.friction is not None
    fit = resampled_friction(stage.results.identify.friction, controller.dt_s)
    forward = friction_feedforward(controller, fit)
    period = int(min(_PERIOD_OVER_DELAY * forward.lag_s / controller.dt_s, _LONGEST_PERIOD))
    omega = 2 * np.pi / (period * controller.dt_s)
    # The first quarter of a period lets the arm start.
    samples = np.arange(round(1.25 * period))
    reference = amplitude * np.sin(2 * np.pi * samples / period)
    reference_filter = stage.results.reference_filter.filter
    if reference_filter is not None:
        reference = reference_filter.filtered(reference)
    errors = []
    for feedforward in (None, forward):
        law = replace(controller, feedforward=feedforward)
        noise = stage.rng("closed_loop", "slow sine")
        if on_arm:
            run = simulate(law, reference=reference, **loop_of_arm(stage.config, noise))
        else:
            run = FrictionLoop.of(law, fit).run(reference, noise)
        errors.append((run.reference - run.measured)[period // 4 :])
    linear = FrictionLoop(controller, fit, fit.coefficients, FrictionLaw(0.0)).run(reference)
    linear_error = (linear.reference - linear.measured)[period // 4 :]
    return SlowSine(
        amplitude=amplitude,
        omega_rad_s=omega,
        linear_rms=float(np.sqrt(np.mean(linear_error**2))),
        without=errors[0],
        given=errors[1],
        moves_from=FrictionLoop.of(controller, fit).moving_sine(omega),
    )
