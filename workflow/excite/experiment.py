"""A planned experiment: voltages within limits, the motion to expect, how well the response will be known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from ident.data.arrays import RealArray
from plant.excitation import crest_factor
from plant.experiment_plan import ExperimentPlan
from plant.modal import linear_arm
from plant.rig import Rig
from workflow.config.rig_settings import rig_called
from workflow.config.settings import Section
from workflow.engine.errors import InputError


class ExperimentLimits(Section):
    """What an experiment may do; angles are those of the hub, None where nobody stated one."""

    band_Hz: tuple[float, float] = Field(
        description="frequencies to excite [Hz], low and high; default with --closed-loop: two decades up to "
        "twice the first mode, or the highest that the logs tell"
    )
    dt_s: float = Field(gt=0, description="sampling period [s]; of logs their own")
    duration_s: float = Field(
        gt=0,
        description="time allowed for all records together [s]; default with --closed-loop: what the band "
        "needs",
    )
    peak_V: float = Field(
        gt=0,
        description="largest voltage allowed [V]; with --closed-loop the largest command, in its unit, "
        "default: 80 % of the logs' largest",
    )
    rms_V: tuple[float, ...] = Field(
        (), description="root mean square [V] (repeatable); default: the highest allowed, and half of it"
    )
    angle_deg: float | None = Field(
        None, gt=0, description="largest hub angle allowed [degrees]; needs --rig or --gain"
    )
    gain_rad_per_Vs: float | None = Field(
        None, gt=0, description="rough speed of the hub per volt [rad/s per V], without a rig"
    )
    rig: Annotated[
        Rig | None, BeforeValidator(lambda rig: rig_called(rig) if isinstance(rig, str) else rig)
    ] = Field(None, description="rig file or 'paper_link': predicts motion and response; default: none")
    noise_std_rad: float | None = Field(
        None,
        gt=0,
        description="sensor noise of the hub angle [rad], for the predicted radii; default: that of the rig, "
        "else of an encoder of 12 bits, 0.00044",
    )
    lead_in_s: float = Field(1.0, ge=0, description="from rest to steady state [s]")
    motion: float | None = Field(
        None,
        gt=0,
        description="with --closed-loop: largest motion, in the output's unit; default: the logs' largest",
    )


@dataclass(frozen=True)
class PlannedRecord:
    """One voltage file and what to expect of it.

    Attributes
    ----------
    file : str
        Name of the CSV file.
    rms_V, peak_V : float
        Root mean square and largest value of the voltage.
    realisation : int
        Number of the draw of phases, from 1.
    crest_factor : float
        Peak over rms.
    peak_angle_deg : float or None
        Largest hub angle to expect; None without a rig or a gain.
    """

    file: str
    rms_V: float
    realisation: int
    peak_V: float
    crest_factor: float
    peak_angle_deg: float | None


@dataclass(frozen=True, eq=False)
class PlannedExperiment:
    """Voltages of an experiment and what is predicted of it.

    Attributes
    ----------
    limits : ExperimentLimits
        What was allowed.
    plan : ExperimentPlan
        Periods, lines and amplitudes.
    seed : int
        Of the random phases and of the lines that are left out.
    voltages_V : (A, M, T) array
        Over amplitudes, realisations and samples.
    """

    limits: ExperimentLimits
    plan: ExperimentPlan
    seed: int
    voltages_V: RealArray

    @cached_property
    def records(self) -> tuple[PlannedRecord, ...]:
        """One for each file, amplitude by amplitude."""
        motion = motion_of(self.limits)
        planned = list[PlannedRecord]()
        for rms_V, realisations in zip(self.plan.rms_V, self.voltages_V, strict=True):
            for number, voltage in enumerate(realisations, 1):
                peak_angle_deg = None
                if motion is not None:
                    peak_angle_deg = float(np.degrees(np.max(np.abs(motion(voltage)))))
                planned.append(
                    PlannedRecord(
                        file=f"{len(planned) + 1:02d}_{rms_V:g}_V_rms_realisation_{number}.csv",
                        rms_V=rms_V,
                        realisation=number,
                        peak_V=float(np.max(np.abs(voltage))),
                        crest_factor=crest_factor(voltage),
                        peak_angle_deg=peak_angle_deg,
                    )
                )
        return tuple(planned)

    @property
    def duration_s(self) -> float:
        """Time of all records together, lead-in included [s]."""
        return self.plan.duration_s(self.limits.dt_s)

    @cached_property
    def lines_Hz(self) -> RealArray:
        """Excited lines (H,)."""
        return self.plan.lines(self.limits.dt_s) / (self.plan.period_samples * self.limits.dt_s)

    @cached_property
    def detection_Hz(self) -> RealArray:
        """Odd lines between the excited ones that were left out (K,)."""
        lines = self.plan.lines(self.limits.dt_s)
        missing = np.setdiff1d(np.arange(lines[0], lines[-1] + 1, 2), lines)
        return np.asarray(missing / (self.plan.period_samples * self.limits.dt_s))

    @cached_property
    def gain(self) -> RealArray | None:
        """|hub angle / voltage| (H,) in rad/V, None without a rig or a gain."""
        omega = 2 * np.pi * self.lines_Hz
        if self.limits.rig is not None:
            return np.asarray(np.abs(linear_arm(self.limits.rig)(1j * omega)[0, 0]))
        return None if self.limits.gain_rad_per_Vs is None else self.limits.gain_rad_per_Vs / omega

    @property
    def noise_std_rad(self) -> float:
        """Standard deviation of the hub angle's noise [rad]: as stated, else of the rig, else of the steps of
        an encoder of 12 bits (a step over the root of 12: errors spread evenly over it)."""
        if self.limits.noise_std_rad:
            return self.limits.noise_std_rad
        rig = self.limits.rig
        if rig is not None and rig.sensors.hub_angle_noise_rad:
            return rig.sensors.hub_angle_noise_rad
        encoder_step_rad = 2 * np.pi / 2**12
        return float(encoder_step_rad / np.sqrt(12))

    @cached_property
    def radii(self) -> tuple[float, ...]:
        """Expected 95 % radius [rad/V] of the response at every line, per amplitude."""
        return tuple(self.plan.radius(rms, self.limits.dt_s, self.noise_std_rad) for rms in self.plan.rms_V)


def motion_of(limits: ExperimentLimits) -> Callable[[RealArray], RealArray] | None:
    """A function from voltage (T,) [V] to hub angle (T,) [rad], from rest: of the linear rig, or of an
    integrator where only a gain is stated; None without either."""
    rig = limits.rig
    gain = limits.gain_rad_per_Vs
    if rig is not None:
        # Takes a second to load: limits that are refused do not need it.
        from plant.simulation import simulate

        return lambda voltage: simulate(rig, voltage, dt_s=limits.dt_s).hub_angle_true_rad
    return None if gain is None else lambda voltage: gain * limits.dt_s * np.cumsum(voltage)


def plan_experiment(limits: ExperimentLimits, *, seed: int, **settings: object) -> PlannedExperiment:
    """The experiment with the longest periods and largest voltages that the limits allow.

    Parameters
    ----------
    limits : ExperimentLimits
    seed : int
        Of the random phases and of the lines that are left out.
    **settings : object
        Fields of `ExperimentPlan` by name.

    Raises
    ------
    InputError
        One line: no experiment stays within the limits.
    """
    motion = motion_of(limits)
    if limits.angle_deg is not None and motion is None:
        raise InputError("angle_deg is a limit of the motion: give a rig or gain_rad_per_Vs to predict it")
    if limits.rms_V:
        settings["rms_V"] = limits.rms_V
    try:
        plan = ExperimentPlan.within(
            band_Hz=limits.band_Hz,
            dt_s=limits.dt_s,
            duration_s=limits.duration_s,
            lead_in_s=limits.lead_in_s,
            lines_seed=seed,
            **settings,
        )
        voltages = plan.records(limits.dt_s, np.random.default_rng(seed))
    except ValueError as error:
        raise InputError(str(error)) from error

    # Without stated amplitudes the voltages are scaled to the first limit that they meet.
    if not limits.rms_V:
        angle_rad = np.inf if limits.angle_deg is None else float(np.radians(limits.angle_deg))
        plan = plan.scaled(voltages, peak_V=limits.peak_V, angle_rad=angle_rad, motion=motion)
        voltages = plan.records(limits.dt_s, np.random.default_rng(seed))

    # Stated amplitudes may go beyond a limit: that is refused with the first file that does.
    experiment = PlannedExperiment(limits, plan, seed, voltages)
    for record in experiment.records:
        about = f"{record.rms_V:g} V rms, realisation {record.realisation}"
        # An amplitude that was scaled to the limit may pass it by rounding.
        if record.peak_V > limits.peak_V * (1 + 1e-9):
            raise InputError(f"{about}: peak of {record.peak_V:.4g} V, {limits.peak_V:g} V are allowed")
        if limits.angle_deg is not None and not (record.peak_angle_deg or 0.0) <= limits.angle_deg:
            raise InputError(
                f"{about}: the hub is expected to turn by {record.peak_angle_deg:.4g} degrees, "
                f"{limits.angle_deg:g} are allowed"
            )
    return experiment
