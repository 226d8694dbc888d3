"""What every step of a run leaves behind: frozen values, stored by `workflow.engine.codec`.

Channels and records stand in the order of the configuration. Signals are (T,) over samples, runs of the
closed loop (R, T); responses (F,) over frequencies.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from control_design.analysis.certificate import Certificate
from control_design.analysis.closed_loop import StepMetrics
from control_design.analysis.joint_coverage import JointCoverage
from control_design.controllers.controller import Controller, FrictionFeedforward
from control_design.convex.reference_filter import ReferenceFilter
from control_design.convex.youla import YoulaBracket
from control_design.plants.plant_set import PlantChannel as PlantChannel, UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.multivariable import MultivariableResult
from control_design.synthesis.synthesis_result import Outcome, SynthesisResult
from ident.basis.model import GobfModel
from ident.checks.plausible_modes import PairKind, kind_of_pair
from ident.checks.residual_tests import conditions_of
from ident.checks.validation import FreshFit, ScatterRow
from ident.command_timing import CommandTiming
from ident.data.arrays import BoolArray, RealArray
from ident.data.ellipses import chi2_radius
from ident.data.finding import Finding, distinct
from ident.data.record import Record
from ident.friction import EquivalentFriction, FrictionFit, RemoteFriction
from ident.identification import Identification
from ident.resampling import ratio_of, resampled, resampled_poles
from ident.response_uncertainty import Tests
from ident.stabilisation import Stabilisation
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.uncertainty.nominal import NominalAgreement, nominal_near
from workflow.config.run_config import Channel, Role, RunConfig
from workflow.engine.run_directory import RunDirectory
from workflow.text.sentences.friction import certified_for

Interval = tuple[float, float]
T = TypeVar("T")


# Records


@dataclass(frozen=True, eq=False)
class RunRecord:
    """A record of the run and what the configuration says about it.

    Attributes
    ----------
    record : Record
    role : Role
        Fitted, kept for validation, or a repeat.
    condition : str or None
        Records of one condition are repeats; for several joints the operating point.
    remark : str
    kind : str
        Of the excitation, or "file".
    """

    record: Record
    role: Role
    condition: str | None
    remark: str
    kind: str = "file"

    @property
    def name(self) -> str:
        return self.record.name

    @property
    def duration_s(self) -> float:
        return self.record.n_samples * self.record.dt_s

    @property
    def units(self) -> dict[str, str]:
        """Units of the signals that the record knows the units of."""
        known = dict(zip(self.record.input_names, self.record.input_units, strict=False))
        return known | dict(zip(self.record.output_names, self.record.output_units, strict=False))


@dataclass(frozen=True, eq=False)
class RecordsResult:
    """Records of a run, in the order of the configuration.

    timing: what their command did between two rows, for which they are corrected; None for simulated ones,
    whose command is held from row to row.
    """

    records: tuple[RunRecord, ...]
    timing: CommandTiming | None = field(default=None, metadata={"since": 2})

    def of_role(self, role: Role) -> list[RunRecord]:
        return [item for item in self.records if item.role == role]

    def fitted(self, channel: Channel) -> list[Record]:
        """The estimation records of a channel, SISO, as measured."""
        return [item.record.siso(channel.input, channel.output) for item in self.of_role("estimation")]

    def unit(self, signal: str) -> str:
        """Unit of a signal, empty where nobody stated it."""
        for item in self.records:
            unit = item.units.get(signal)
            if unit:
                return unit
        return ""


# Model


@dataclass(frozen=True)
class ModelMode:
    """A pole pair in an engineer's units."""

    omega_rad_s: float
    damping: float

    @property
    def frequency_Hz(self) -> float:
        return self.omega_rad_s / (2 * np.pi)


@dataclass(frozen=True, eq=False)
class IdentifiedChannel:
    """One channel: what was fitted to what, and free runs on the records that were not fitted.

    Attributes
    ----------
    name : str
    identification : Identification
        Model, fits and residuals.
    used : tuple of Record
        Of the fit, one input and one output, as the fit saw them.
    bounded : tuple of Record
        These records as the ellipses see them.
    fresh : tuple of FreshFit
        Free runs on the other records.
    fresh_roles : tuple of Role
        Role of each of these records.
    stabilisation : Stabilisation or None
        None where nobody asked for the plot.
    increments : bool
        The fit saw differences from sample to sample.
    band_rad_s, bounds_band_rad_s : tuple of two float, or None
        Bands to which the data of fit and ellipses were confined [rad/s].
    closed_loop : Finding or None
        How logs made in a loop were used and why; None for others.
    remote : RemoteFriction or None
        Friction of a shaft that the sensor does not see, which was taken off the records.
    """

    name: str
    identification: Identification
    used: tuple[Record, ...]
    bounded: tuple[Record, ...]
    fresh: tuple[FreshFit, ...] = ()
    fresh_roles: tuple[Role, ...] = ()
    stabilisation: Stabilisation | None = None
    increments: bool = False
    band_rad_s: Interval | None = None
    bounds_band_rad_s: Interval | None = None
    closed_loop: Finding | None = None
    remote: RemoteFriction | None = field(default=None, metadata={"since": 10})

    @property
    def model(self) -> GobfModel:
        return self.identification.model

    @property
    def input(self) -> str:
        return self.model.input_name

    @property
    def output(self) -> str:
        return self.model.output_name

    @property
    def best_fit_percent(self) -> float:
        """Best fit of a free run of the model to a log, or to one in its loop where such runs were made; not
        below zero."""
        percents = self.identification.fit_percent.tolist()
        percents += [fit.fit_percent for fit in self.fresh]
        if self.closed_loop is not None:
            percents.append(self.closed_loop.values.get("most_in_loop_percent", 0.0))
        return float(max(*percents, 0.0))

    @property
    def data_band_rad_s(self) -> Interval | None:
        """Band of the data behind the ellipses; None where they were not confined to one."""
        return self.bounds_band_rad_s or self.band_rad_s

    @property
    def modes(self) -> tuple[ModelMode, ...]:
        """Ascending in frequency."""
        poles = self.model.stable_poles
        omega_rad_s = poles.omega_rad_s(self.model.dt_s).tolist()
        pairs = zip(omega_rad_s, poles.zeta().tolist(), strict=True)
        return tuple(ModelMode(omega, zeta) for omega, zeta in sorted(pairs))

    @property
    def longest_s(self) -> float:
        """Length of the longest record of the fit."""
        return max((record.n_samples * record.dt_s for record in self.used), default=np.inf)

    def is_mode(self, pair: ModelMode) -> bool:
        """Whether a pole pair can be a mode, given its damping and the length of the records."""
        return kind_of_pair(pair.omega_rad_s, pair.damping, self.longest_s) is PairKind.MODE

    @property
    def real_poles_per_s(self) -> tuple[float, ...]:
        """Decay rates, slowest first; a pole at or left of z = 0 has none."""
        real = self.model.stable_poles.real
        decays = real > 0
        rates_per_s = -np.log(real[decays]) / self.model.dt_s
        return tuple(sorted(rates_per_s.tolist()))

    @property
    def real_poles_z(self) -> tuple[float, ...]:
        """Real poles in z, largest first."""
        return tuple(sorted(self.model.stable_poles.real.tolist(), reverse=True))

    @property
    def unstable_poles(self) -> tuple[tuple[float, float], ...]:
        """Growth rate, 1/s, and frequency, rad/s (0 for a real one), of each pole outside the circle."""
        outside = np.log(self.model.unstable_poles) / self.model.dt_s
        # Of a pair the upper one stands for both.
        return tuple((float(s.real), float(s.imag)) for s in outside if s.imag >= 0)

    @property
    def fit_percent(self) -> dict[Role, dict[str, float]]:
        """By role and record: of the fit itself on the estimation records, of free runs on the others."""
        names = self.identification.record_names
        percents = self.identification.fit_percent.tolist()
        fits: dict[Role, dict[str, float]] = {"estimation": {}, "validation": {}, "repeat": {}}
        fits["estimation"] = dict(zip(names, percents, strict=True))
        for fit, role in zip(self.fresh, self.fresh_roles, strict=True):
            fits[role][fit.name] = fit.fit_percent
        return fits


@dataclass(frozen=True, eq=False)
class IdentifyResult:
    """Models of all channels; friction: of the shaft, where a channel's response is wanted without it."""

    channels: tuple[IdentifiedChannel, ...]
    friction: FrictionFit | None = None

    @property
    def modes_rad_s(self) -> tuple[float, ...]:
        """Frequencies of the pole pairs of all channels' models that can be modes."""
        return tuple(
            mode.omega_rad_s for channel in self.channels for mode in channel.modes if channel.is_mode(mode)
        )


# Ellipses


@dataclass(frozen=True)
class Band:
    """Size of the ellipses in a band: major semi-axis over |G|."""

    from_rad_s: float
    to_rad_s: float
    median_radius_percent: float
    largest_radius_percent: float


# A step stalls that takes so many times as long with friction as without. Chosen.
STALLS = 5.0
# A damping that may be anything is that of no mode: width of its interval.
_ANYTHING = 0.5


@dataclass(frozen=True)
class ModeInterval:
    """Confidence intervals of a mode."""

    omega_rad_s: Interval
    damping: Interval

    @property
    def told(self) -> bool:
        """Whether the records tell that the pair is a mode: its damping is not just anything."""
        return self.damping[1] - self.damping[0] < _ANYTHING

    @property
    def frequency_Hz(self) -> Interval:
        low, high = self.omega_rad_s
        return low / (2 * np.pi), high / (2 * np.pi)


@dataclass(frozen=True)
class Intervals:
    """Confidence intervals of the poles of a model.

    Attributes
    ----------
    level : float
        Probability of each.
    modes : tuple of ModeInterval
        By frequency.
    real_poles_per_s : tuple of (low, high)
        Decay rates, slowest first [1/s].
    growth_per_s : tuple of (low, high)
        Growth rates of unstable poles [1/s].
    """

    level: float
    modes: tuple[ModeInterval, ...]
    real_poles_per_s: tuple[Interval, ...]
    growth_per_s: tuple[Interval, ...] = field(default=(), metadata={"since": 2})


@dataclass(frozen=True, eq=False)
class UncertainMember:
    """A part of the set that a channel may be in.

    Attributes
    ----------
    about : str
        Which part, in words.
    posterior : ResponsePosterior
    nominal : GobfModel
        A model of it.
    bands : tuple of Band
        Size of its ellipses.
    """

    about: str
    posterior: ResponsePosterior
    nominal: GobfModel
    bands: tuple[Band, ...]

    def at_rate(self, controller_dt_s: float, omega: RealArray) -> UncertainMember:
        """The part as a controller of this period [s] sees it.

        omega (F,): frequencies that logs and controller both tell [rad/s], at which the nominal model is the
        nearest one.
        """
        step_s = self.posterior.dt_s
        posterior = resampled(self.posterior, controller_dt_s)
        poles = resampled_poles(self.nominal.poles, step_s, controller_dt_s)
        return replace(self, posterior=posterior, nominal=nominal_near(posterior, poles, omega))


@dataclass(frozen=True, eq=False)
class UncertainChannel:
    """Ellipses of one channel and what the residuals say about them.

    Attributes
    ----------
    name, method : str
        Of the channel, and of the posterior.
    level : float
        Probability of each ellipse.
    posterior : ResponsePosterior
        Of the first part of the set.
    nominal : GobfModel
        Model on the identified poles that is nearest to that posterior.
    frequency : FrequencyUncertainty
        Its ellipses on the grid of the pictures.
    empirical : FrequencyUncertainty or None
        Response without a model, where the records allow one.
    bands : tuple of Band
        Size of the ellipses.
    tests : Tests
        Whiteness and independence of the residuals on the estimation records.
    agreement : NominalAgreement
        Of the nominal model with the ellipses.
    intervals : Intervals or None
        None where the method has none.
    repeat_scatter : tuple of ScatterRow or None
        None without repeats.
    advice : tuple of Finding
        What to do where a test fails.
    about : str
        Which part of the set posterior and nominal are of, "" where it has one part.
    others : tuple of UncertainMember
        Further parts. The channel is in one of all parts.
    """

    name: str
    method: str
    level: float
    posterior: ResponsePosterior
    nominal: GobfModel
    frequency: FrequencyUncertainty
    empirical: FrequencyUncertainty | None
    bands: tuple[Band, ...]
    tests: Tests
    agreement: NominalAgreement
    intervals: Intervals | None = None
    repeat_scatter: tuple[ScatterRow, ...] | None = None
    advice: tuple[Finding, ...] = ()
    about: str = field(default="", metadata={"since": 2})
    others: tuple[UncertainMember, ...] = field(default=(), metadata={"since": 2})

    @property
    def members(self) -> tuple[UncertainMember, ...]:
        """Parts of the set, that of the identified model first."""
        return (UncertainMember(self.about, self.posterior, self.nominal, self.bands), *self.others)

    @property
    def enclosing(self) -> FrequencyUncertainty:
        """Ellipses that hold those of all parts, for a file that has one of each frequency.

        Ellipses C_i about places d_i from the middle lie in that of the sum of 2 (C_i + d_i d_i'): with
        points x of the one, |x + d|^2 <= 2 |x|^2 + 2 |d|^2 in every direction.
        """
        if not self.others:
            return self.frequency
        omega = self.frequency.omega_rad_s
        parts = [member.posterior.at(omega, self.level) for member in self.members]
        centre = np.mean([part.centre for part in parts], axis=0)
        covariance = np.zeros_like(self.frequency.covariance)
        for part in parts:
            offset = part.centre - centre
            away = np.stack([offset.real, offset.imag], axis=1)
            # An ellipse of this level is so many standard deviations large.
            away = away / chi2_radius(self.level)
            covariance += 2 * (part.covariance + away[:, :, None] * away[:, None, :])
        return replace(self.frequency, centre=centre, covariance=covariance)

    @property
    def noise_order(self) -> int:
        """Order of the noise model behind which the residuals were tested."""
        report = self.posterior.report
        return 0 if report is None else len(report.ar_coefficients)

    def at_rate(self, controller_dt_s: float | None) -> UncertainChannel:
        """The channel as a controller of this period [s] sees it; None: at the step of the logs.

        Ellipses are those at frequencies below both Nyquist frequencies.
        """
        step_s = self.posterior.dt_s
        if controller_dt_s is None or ratio_of(step_s, controller_dt_s) == (1, 1):
            return self
        posterior = resampled(self.posterior, controller_dt_s)
        # Where the logs and the new controller both tell a response.
        omega = self.frequency.omega_rad_s
        below_both_nyquists = omega < 0.99 * np.pi / max(step_s, controller_dt_s)
        omega = omega[below_both_nyquists]
        poles = resampled_poles(self.nominal.poles, step_s, controller_dt_s)
        return replace(
            self,
            posterior=posterior,
            nominal=nominal_near(posterior, poles, omega),
            frequency=posterior.at(omega, self.level),
            others=tuple(other.at_rate(controller_dt_s, omega) for other in self.others),
        )

    def in_plant(self) -> PlantChannel:
        return PlantChannel(self.nominal.to_control(), self.posterior, self.level)


@dataclass(frozen=True, eq=False)
class UncertaintyResult:
    """Ellipses of all channels.

    equivalent: viscous friction that acts like the dry one, where ellipses are about an amplitude.
    """

    channels: tuple[UncertainChannel, ...]
    equivalent: EquivalentFriction | None = None

    def conditions(self, config: RunConfig) -> tuple[Finding, ...]:
        """What a certificate over these ellipses stands or falls with."""
        conditions = list[Finding]()
        for index in dict.fromkeys((config.control_index, config.performance_index)):
            if index is not None:
                conditions += conditions_of(self.channels[index].advice)
        return distinct(conditions)

    def seen_by_controller(self, config: RunConfig) -> tuple[UncertainChannel, ...]:
        """The channels at the rate of the new controller."""
        controller_dt_s = config.specification.controller_dt_s
        if controller_dt_s not in self._channels_at:
            self._channels_at[controller_dt_s] = tuple(
                channel.at_rate(controller_dt_s) for channel in self.channels
            )
        return self._channels_at[controller_dt_s]

    def plant(self, config: RunConfig) -> UncertainPlant:
        """The first of `plants`, that of the identified model."""
        return self.plants(config)[0]

    def plants(self, config: RunConfig) -> tuple[UncertainPlant, ...]:
        """What the controller is designed for: control channel and first performance channel, at its rate.

        One plant for each part of the set that the control channel may be in.
        """
        name = config.control_channel.label
        performance_index = config.performance_index
        key = name, config.control_index, performance_index, config.specification.controller_dt_s
        if key not in self._plants:
            channels = self.seen_by_controller(config)
            control = channels[config.control_index]
            performance = None
            if performance_index is not None:
                performance = channels[performance_index].in_plant()
            plants = []
            for member in control.members:
                plant_name = f"{name}, {member.about}" if member.about else name
                plants.append(
                    UncertainPlant(
                        name=plant_name,
                        nominal=member.nominal.to_control(),
                        uncertainty=member.posterior,
                        performance=performance,
                        level=control.level,
                    )
                )
            self._plants[key] = tuple(plants)
        return self._plants[key]

    @cached_property
    def _plants(self) -> dict[tuple[str, int, int | None, float | None], tuple[UncertainPlant, ...]]:
        """Plants by name, control and performance channel and rate: stages and figures ask for one again."""
        return {}

    @cached_property
    def _channels_at(self) -> dict[float | None, tuple[UncertainChannel, ...]]:
        return {}


@dataclass(frozen=True, eq=False)
class IdentifiedPlant:
    """What `flexlink identify --out` writes and `flexlink design` reads."""

    model: GobfModel
    posterior: ResponsePosterior
    level: float

    def __post_init__(self) -> None:
        chi2_radius(self.level)
        for name in ("dt_s", "integrators", "input_delay_samples"):
            of_model, of_posterior = getattr(self.model, name), getattr(self.posterior, name)
            if of_model != of_posterior:
                raise ValueError(f"{name} of the model is {of_model}, of its posterior {of_posterior}")


# Controller


@dataclass(frozen=True, eq=False)
class DesignResult:
    """The controller that a search found, and how it stands against the specification.

    Attributes
    ----------
    synthesis : SynthesisResult, MultivariableResult or None
        None where the specification is impossible from the start.
    met : bool
    reason : str
        One line: met, or how far it is missed, and which frequency and requirement block it.
    jointly : str or None
        What became of designing for sampled responses.
    specification : Specification or None
        What was designed for, where the one asked for gives way.
    """

    synthesis: SynthesisResult | MultivariableResult | None
    met: bool
    reason: str
    jointly: str | None = None
    specification: Specification | None = field(default=None, metadata={"since": 2})

    @property
    def gamma(self) -> float | None:
        """Weighted worst case on the design's own grid; inf without a stable controller, None without any."""
        return None if self.synthesis is None else self.synthesis.gamma

    @property
    def controller(self) -> Controller | None:
        """The controller, None where the search led to none that means something."""
        if self.synthesis is None or self.synthesis.outcome is Outcome.NOT_CONVERGED:
            return None
        return self.synthesis.controller


@dataclass(frozen=True, eq=False)
class AchievablePerformance:
    """What a controller of any order could reach; reason: why that is not known."""

    bracket: YoulaBracket | None = None
    reason: str | None = None


@dataclass(frozen=True)
class SampledResponses:
    """For how many sampled responses the worst case holds; reason: why none were drawn."""

    joint: JointCoverage | None = None
    calibrated: bool = False
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class CertifyResult:
    """The certificate of a controller.

    Attributes
    ----------
    certificate : Certificate or None
        None with nothing to certify.
    certified : bool
    reason : str
        One line, in any case.
    sampled : SampledResponses
        For how many sampled responses the worst case holds.
    """

    certificate: Certificate | None
    certified: bool
    reason: str
    sampled: SampledResponses = SampledResponses()


@dataclass(frozen=True, eq=False)
class ReferenceFilterResult:
    """Reference filter and friction feed-forward of a controller.

    filter: None where none was asked for, or where `reason` says why none is possible.
    """

    filter: ReferenceFilter | None = None
    reason: str | None = None
    feedforward: FrictionFeedforward | None = None

    def law(self, controller: Controller) -> Controller:
        """The controller as it runs, with its feed-forward."""
        return replace(controller, feedforward=self.feedforward)


# Closed loop


@dataclass(frozen=True, eq=False)
class LoopRuns:
    """Closed-loop runs.

    Attributes
    ----------
    output, command : (R, T) arrays
        Of R runs with T samples.
    performance : (R, T) array or None
        None without a performance channel.
    limited : (R, T) bool array
        Where a limit of the command was active.
    """

    output: RealArray
    command: RealArray
    performance: RealArray | None
    limited: BoolArray

    @classmethod
    def together(cls, several: Sequence[LoopRuns]) -> LoopRuns:
        """The runs of several, one after the other; all with a performance channel, or none."""
        performances = [runs.performance for runs in several if runs.performance is not None]
        return cls(
            output=np.concatenate([runs.output for runs in several]),
            command=np.concatenate([runs.command for runs in several]),
            performance=np.concatenate(performances) if performances else None,
            limited=np.concatenate([runs.limited for runs in several]),
        )


@dataclass(frozen=True)
class LoopMetrics(StepMetrics):
    """Metrics of the step and the disturbance of one run.

    Attributes
    ----------
    disturbance_peak : float
        Largest error in the half of the disturbance, in units of the output.
    disturbance_left : float
        Error that stays at its end.
    settled : bool
        The motion dies out.
    """

    disturbance_peak: float
    disturbance_left: float
    settled: bool


@dataclass(frozen=True, eq=False)
class MeasuredPeak:
    """S measured on the arm: response and standard deviation (F,), and its peak beside the predicted ones.

    off_certified_percent: None where nothing was certified.
    """

    name: str
    reference_rms: float
    peak: float
    peak_std: float
    peak_omega_rad_s: float
    off_nominal_percent: float
    off_certified_percent: float | None
    peak_command: float
    limited_fraction: float
    omega_rad_s: RealArray
    magnitude: RealArray
    std: RealArray

    def beyond(self, limit: RealArray) -> int | None:
        """The line at which |S| exceeds a limit (F,) by the largest factor; None where it does nowhere.

        Only where it does so by more than `SIGNIFICANT` standard deviations.
        """
        is_significant = self.magnitude - SIGNIFICANT * self.std > limit
        factor = np.where(is_significant, self.magnitude / limit, 0.0)
        line = int(np.argmax(factor))
        return line if factor[line] > 0 else None

    def beyond_bandwidth(self, bandwidth_rad_s: float) -> int | None:
        """The line up to a bandwidth at which |S| exceeds -3 dB by the largest factor, see `beyond`."""
        return self.beyond(np.where(self.omega_rad_s <= bandwidth_rad_s, np.sqrt(0.5), np.inf))


# Standard deviations by which a measured |S| is beyond a limit: of some hundred lines the largest lies two of
# them too high by chance.
SIGNIFICANT = 3.0


@dataclass(frozen=True, eq=False)
class SensitivityCheck:
    """Peak of |S|: predicted for the nominal loop, certified over the ellipses, measured."""

    nominal_peak: float
    nominal_omega_rad_s: float
    certified_peak: float
    band_rad_s: Interval
    measured: tuple[MeasuredPeak, ...]


@dataclass(frozen=True, eq=False)
class SlowSine:
    """Errors of the loop on a slow sine, without and with friction feed-forward.

    They are those measured on the machine, or those of the identified arm with its friction where there is no
    machine.

    Attributes
    ----------
    amplitude : float
        Of the sine, in units of the output.
    omega_rad_s : float
    linear_rms : float
        Of the error on the arm without friction.
    without, given : (T,) arrays
        Errors without feed-forward and with it.
    moves_from : float
        Amplitude from which on a sine of this frequency moves the arm against its friction.
    """

    amplitude: float
    omega_rad_s: float
    linear_rms: float
    without: RealArray
    given: RealArray
    moves_from: float = field(default=0.0, metadata={"since": 8})

    @property
    def stands_still(self) -> bool:
        """The arm without feed-forward: its error is nearly the whole sine."""
        rms_of_sine = self.amplitude / np.sqrt(2)
        return self.amplitude < self.moves_from and self.rms[0] > 0.9 * rms_of_sine

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of the error, without and with feed-forward."""
        without = float(np.sqrt(np.mean(self.without**2)))
        given = float(np.sqrt(np.mean(self.given**2)))
        return without, given


@dataclass(frozen=True)
class SettlingRange:
    """Settling times of steps of several sizes on an arm with dry friction.

    When friction lets an arm go hangs on the last digits of what came before: the settling time of one step
    is chance, and another one for half the integration step. The range over sizes is not.

    Attributes
    ----------
    sizes : tuple of N floats
        Of the steps, rising, in units of the output; closer where the time jumps.
    times_s : tuple of N floats or None
        Time until the output stays within 2 % of each step; None: not within `watched_s`.
    watched_s : float
        How long every step was watched.
    """

    sizes: tuple[float, ...]
    times_s: tuple[float | None, ...]
    watched_s: float

    @property
    def settled_s(self) -> tuple[float, ...]:
        """Times of the steps that settle, ascending."""
        return tuple(sorted(time for time in self.times_s if time is not None))

    @property
    def worst_s(self) -> float | None:
        """The longest time; None where a step does not settle."""
        return None if None in self.times_s else max(self.settled_s)

    @property
    def median_s(self) -> float:
        """The time within which half of the steps settle, even over the logarithm of the size; infinite where
        fewer do. Choices are made by it, as the ends of the range are chance themselves."""
        # Each size stands for the sizes up to half-way to its neighbours.
        places = np.log(np.abs(self.sizes))
        half_way = (places[1:] + places[:-1]) / 2
        edges = np.concatenate([places[:1], half_way, places[-1:]])
        shares = np.diff(edges) / (places[-1] - places[0])
        times_s = np.array([np.inf if time is None else time for time in self.times_s])
        order = np.argsort(times_s, kind="stable")
        half = int(np.searchsorted(np.cumsum(shares[order]), 0.5))
        return float(times_s[order[half]])


@dataclass(frozen=True, eq=False)
class FrictionCheck:
    """The loop on the identified arm with its dry friction.

    Attributes
    ----------
    level, level_interval : float, (low, high)
        Friction at standstill, in units of the command, with its 95 % interval.
    presliding : float
        Deflection before slipping, as identified.
    sizes : (N,) array
        Rms of the reference, falling.
    low, high : (N,) arrays
        95 % interval of the peak of |S| as it would be measured at each size.
    measured : (N,) array or None
        The peak on the machine, None without one.
    nominal_peak, certified_peak : float
        Of |S|, linear.
    tolerance_percent : float
        By which a peak may exceed those.
    certified_from : float or None
        Size from which on, up to the largest, `high` exceeds the certified peak by no more than the
        tolerance; None: not even at the largest.
    linear_from : float or None
        Size from which on the middle of the interval is as near to the nominal peak.
    sticking_step, sticking_interval : float, (low, high)
        Largest step after which the arm does not leave its pre-sliding.
    error_at_rest, error_interval : float, (low, high)
        Largest error with which it may rest, 0 with integral action.
    step : StepMetrics
        Of the reference step on the arm as it was fitted, without noise. Its settling time is chance.
    settling : SettlingRange
        Settling times of steps of half to twice its size.
    watched_s : float
        For which the step was watched.
    left : float
        Largest error in the last half of that time.
    output : (T,) array
        As long as the trial's step, or until this step has settled.
    tracking : SlowSine
    recorded, recorded_settling, recorded_output
        Step, settling range and output of the loop that made the logs; None where they do not tell it.
    errors : tuple of three float
        See `workflow.tasks.friction_loop.beside_recorded`; empty where the logs do not tell that loop.
    """

    level: float
    level_interval: Interval
    presliding: float
    sizes: RealArray
    low: RealArray
    high: RealArray
    measured: RealArray | None
    nominal_peak: float
    certified_peak: float
    tolerance_percent: float
    certified_from: float | None
    linear_from: float | None
    sticking_step: float
    sticking_interval: Interval
    error_at_rest: float
    error_interval: Interval
    step: StepMetrics
    settling: SettlingRange
    watched_s: float
    left: float
    output: RealArray
    tracking: SlowSine
    recorded: StepMetrics | None = field(default=None, metadata={"since": 9})
    recorded_settling: SettlingRange | None = None
    recorded_output: RealArray | None = field(default=None, metadata={"since": 9})
    errors: tuple[float, ...] = field(default=(), metadata={"since": 9})

    @property
    def times_slower(self) -> float:
        """Median settling time over the sizes, over that of the recorded loop.

        Infinite where only that one settles, 0 where it is not known or does not settle.
        """
        if self.recorded_settling is None or self.recorded_settling.median_s == np.inf:
            return 0.0
        # A step within its band from the start has settled in no time: one sample would do, too.
        return self.settling.median_s / max(self.recorded_settling.median_s, 1e-9)

    @property
    def inside(self) -> int:
        """How many of the measured peaks lie inside their intervals."""
        assert self.measured is not None
        return int(np.sum((self.low <= self.measured) & (self.measured <= self.high)))


@dataclass(frozen=True, eq=False)
class ConditionRun:
    """The loop under one other condition beside its prediction.

    Percentages are of `size`, the move or the predicted swing; signals are (T,).
    """

    name: str
    words: str
    size: float
    largest_difference_percent: float
    rms_difference_percent: float
    overshoot_percent: float | None
    error_left_percent: float
    peak_command: float
    limited_fraction: float
    settled: bool
    reference: RealArray
    predicted: RealArray
    achieved: RealArray
    predicted_command: RealArray
    achieved_command: RealArray


@dataclass(frozen=True, eq=False)
class LoopCheck:
    """The loop on the identified model (predicted, on the posterior mean) and on the machine (achieved).

    Attributes
    ----------
    machine : {"simulated", "identified"}
        What ran as the machine.
    tracking : bool
        Whether the reference is to be followed.
    reference_step, disturbance_step : float
        Sizes, in units of output and input.
    quantisation, measurement_step : float
        Steps of the converters of command and measurement, 0 for none.
    input_limit : float or None
        Of the command.
    filtered : bool
        The loop has a reference filter.
    predicted : LoopMetrics
    achieved : tuple of LoopMetrics
        One for each run.
    time_s, reference, disturbance : (T,) arrays
        The disturbance adds to the plant's input from T // 2 on.
    model_answer : (T,) array or None
        Of the model that the reference filter follows.
    predicted_runs, achieved_runs : LoopRuns
    sensitivity : SensitivityCheck or None
    conditions : tuple of ConditionRun
    friction : FrictionCheck or None
    """

    machine: Literal["simulated", "identified"]
    tracking: bool
    reference_step: float
    disturbance_step: float
    quantisation: float
    measurement_step: float
    input_limit: float | None
    filtered: bool
    predicted: LoopMetrics
    achieved: tuple[LoopMetrics, ...]
    time_s: RealArray
    reference: RealArray
    disturbance: RealArray
    model_answer: RealArray | None
    predicted_runs: LoopRuns
    achieved_runs: LoopRuns
    sensitivity: SensitivityCheck | None = None
    conditions: tuple[ConditionRun, ...] = ()
    friction: FrictionCheck | None = None

    @property
    def with_friction(self) -> tuple[RealArray, ...]:
        """Outputs of the reference step with the identified friction, where the runs are of linear plants.

        That of the loop, and that of the recorded one where the logs tell it.
        """
        if self.machine == "simulated" or self.friction is None:
            return ()
        if self.friction.recorded_output is None:
            return (self.friction.output,)
        return self.friction.output, self.friction.recorded_output

    @property
    def longest_settling_s(self) -> float:
        """The longest settling time of the reference steps that a picture draws; 0 where none settles.

        Those that are predicted, of the runs, and with friction where that is drawn (`with_friction`).
        """
        rows: list[StepMetrics | None] = [self.predicted, *self.achieved]
        if self.with_friction and self.friction is not None:
            rows += [self.friction.step, self.friction.recorded]
        times = [row.settling_time_s for row in rows if row is not None]
        return max((time for time in times if time is not None), default=0.0)

    @property
    def waits_for_friction(self) -> bool:
        """Whether friction lets half of the steps settle `STALLS` times as late as without it, or later."""
        without = self.predicted.settling_time_s
        if self.friction is None or without is None:
            return False
        return self.friction.settling.median_s > STALLS * without

    @property
    def draws(self) -> int:
        return len(self.achieved)

    @property
    def settled_draws(self) -> int:
        return sum(row.settled for row in self.achieved)

    @property
    def lasting_error(self) -> float:
        """Largest error that the constant disturbance leaves, predicted or in a run."""
        return max(abs(row.disturbance_left) for row in (self.predicted, *self.achieved))

    def spread_of(self, metric: str) -> tuple[float | None, float | None, float | None]:
        """First, smallest and largest of a metric over the runs; None (never reached) is larger than all."""
        values = [getattr(row, metric) for row in self.achieved]
        known = [value for value in values if value is not None]
        smallest = min(known, default=None)
        largest = max(known) if len(known) == len(values) else None
        return values[0], smallest, largest


@dataclass(frozen=True, eq=False)
class ClosedLoopResult:
    """The closed-loop check; None where there was nothing to run, and `skipped` says why."""

    skipped: str | None = None
    check: LoopCheck | None = None


class StageResult(Generic[T]):
    """The result of the stage that the attribute is named after, read when it is first asked for."""

    def __init__(self, kind: type[T]) -> None:
        self._kind = kind

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, results: AnyResults, owner: type) -> T:
        if self._name not in results.read:
            results.read[self._name] = results.run.load_stage(self._name, self._kind)
        result: T = results.read[self._name]
        return result


class AnyResults(ABC):
    """Results of a run directory, of one loop or of several joints, each read once.

    Attributes
    ----------
    run : RunDirectory
    read : dict of str to value
        Results that were read, by the name of their stage.
    """

    records = StageResult(RecordsResult)
    design = StageResult(DesignResult)

    def __init__(self, run: RunDirectory) -> None:
        self.run = run
        self.read: dict[str, Any] = {}

    @property
    @abstractmethod
    def certified(self) -> bool:
        """Whether the controller of the run is certified."""

    @property
    @abstractmethod
    def settles(self) -> bool:
        """Whether every run of the closed loop settles."""

    @abstractmethod
    def certified_for(self, config: Any) -> str:
        """What a certificate of the identified plant covers, in words; config: that of the run."""


class RunResults(AnyResults):
    """Results of a run of one loop."""

    identify = StageResult(IdentifyResult)
    uncertainty = StageResult(UncertaintyResult)
    achievable_performance = StageResult(AchievablePerformance)
    certify = StageResult(CertifyResult)
    reference_filter = StageResult(ReferenceFilterResult)
    closed_loop = StageResult(ClosedLoopResult)

    @property
    def certified(self) -> bool:
        return self.certify.certified

    @property
    def settles(self) -> bool:
        check = self.closed_loop.check
        return check is not None and check.settled_draws == check.draws

    def certified_for(self, config: RunConfig) -> str:
        channel = config.control_channel
        unit = self.records.unit(channel.input)
        return certified_for(channel.uncertainty.response, self.uncertainty.equivalent, unit)
