"""A series of random-phase multisines that tells noise, distortion and response apart.

Realisations of the phases at every rung of a ladder of amplitudes, all on the same lines: odd ones, of which
one in every group of four is left out. What differs between the periods of a record is noise; between
realisations it is noise and nonlinear distortion; the lines without excitation show of which kind the
distortion is (Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 4).

`ExperimentPlan.within` makes a plan from a band and a duration, `records` its voltages, `scaled` fits its
amplitudes to the limits of the machine, `radius` says how exact its response will be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from plant.excitation import Integer, Real, multisine, multisine_lines
from plant.rig import one_line

# Periods as multiples of that of the lower band edge, longest first: odd, so that the edge is an excited
# line. Longer than 15 of them gains lines closer together than a fifteenth of the lowest frequency. Chosen.
_MULTIPLES = range(15, 0, -2)
# Probability of the ellipses, as everywhere in this program.
_LEVEL = 0.95
# Rounding of a duration that is meant to be just long enough, relative.
_ROUNDING = 1e-9


class ExperimentPlan(BaseModel):
    """Amplitudes x realisations, each a record from rest: a lead-in of the same signal, then whole periods.

    The lead-in belongs to the record (a fit that starts at rest uses it) and to no spectrum. Phases are
    independent between records, lines the same in all. Raises ValueError where the numbers do not fit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    rms_V: tuple[float, ...] = Field(min_length=1, description="ladder of amplitudes")
    realisations: int = Field(4, ge=1, le=1000, description="records at each amplitude, phases independent")
    periods: int = Field(2, ge=1, le=1000, description="whole periods of a record, behind its lead-in")
    period_samples: int = Field(ge=8, le=1_000_000, description="length of a period")
    lead_in_samples: int = Field(
        ge=0, le=1_000_000, description="lead-in from rest to steady state, before the whole periods"
    )
    from_Hz: float = Field(gt=0, description="lowest frequency")
    to_Hz: float = Field(gt=0, description="highest frequency")
    phase_draws: int = Field(50, ge=1, le=1000, description="the draw with the lowest crest factor is kept")
    lines_seed: int = Field(0, ge=0, description="draws which odd lines are left out")

    @model_validator(mode="after")
    def _ladder(self) -> Self:
        """The plan itself. Raises ValueError where a rung of the ladder is not positive or stands twice."""
        is_positive = all(0 < rms < np.inf for rms in self.rms_V)
        is_distinct = len(set(self.rms_V)) == len(self.rms_V)
        if not (is_positive and is_distinct):
            raise ValueError(f"rms_V must be different positive numbers; got {list(self.rms_V)}")
        return self

    @classmethod
    def within(
        cls,
        *,
        band_Hz: tuple[float, float],
        dt_s: float,
        duration_s: float,
        lead_in_s: float,
        **settings: object,
    ) -> Self:
        """The plan with the longest period that all its records together leave room for.

        The period is that of the lower band edge times an odd number up to 15, so that the edge is one of the
        odd lines.

        Parameters
        ----------
        band_Hz : pair of float
            Lowest and highest frequency.
        dt_s : float
            Sampling period.
        duration_s : float
            Of all records together, at the most.
        lead_in_s : float
            From rest to steady state, in each record.
        settings
            Other fields by name; rms_V left out is a ladder of 1 and 1/2, to be `scaled`.

        Returns
        -------
        ExperimentPlan

        Raises
        ------
        ValueError
            The duration is too short for the band, the band is none below the Nyquist frequency, or a setting
            is out of its bounds.
        """
        low, high = band_Hz
        if not 0 < low < high < 0.5 / dt_s:
            raise ValueError(
                f"need a band 0 < low < high < {0.5 / dt_s:g} Hz (Nyquist); got {low:g}, {high:g}"
            )
        # An even number of samples, and at least as many as a plan may have.
        shortest_period = max(2 * round(0.5 / (low * dt_s)), 8)
        values = {"rms_V": (1.0, 0.5), "lead_in_samples": round(lead_in_s / dt_s)} | settings
        values["from_Hz"] = 1 / (shortest_period * dt_s)
        values["to_Hz"] = float(high)
        try:
            plans = [
                cls.model_validate(values | {"period_samples": multiple * shortest_period})
                for multiple in _MULTIPLES
            ]
        except ValidationError as error:
            raise ValueError(one_line(error)) from error
        allowed_s = duration_s * (1 + _ROUNDING)
        for plan in plans:
            if plan.duration_s(dt_s) <= allowed_s:
                return plan
        shortest = plans[-1]
        shortest_s = shortest.duration_s(dt_s)
        raise ValueError(
            f"a band from {low:g} Hz needs periods of {shortest_period * dt_s:g} s: {shortest.n_records} "
            f"records of {shortest.periods} periods and lead-in last {shortest_s:g} s, {duration_s:g} s are "
            "allowed"
        )

    @property
    def n_records(self) -> int:
        """Number of records: amplitudes times realisations."""
        return len(self.rms_V) * self.realisations

    @property
    def n_samples(self) -> int:
        """Samples of each record, its lead-in included."""
        return self.lead_in_samples + self.periods * self.period_samples

    def duration_s(self, dt_s: float) -> float:
        """Duration of all records together, s, at a sampling period, s."""
        return self.n_records * self.n_samples * dt_s

    def lines(self, dt_s: float) -> Integer:
        """Harmonics (H,) that every record excites. Raises ValueError where the band holds none."""
        return multisine_lines(
            self.period_samples,
            dt_s,
            (self.from_Hz, self.to_Hz),
            "odd_random",
            np.random.default_rng(self.lines_seed),
        )

    def record(self, rms_V: float, dt_s: float, rng: np.random.Generator) -> Real:
        """Voltage (T,) of one realisation at this amplitude."""
        return multisine(
            self.lines(dt_s),
            self.period_samples,
            rms_V,
            rng,
            periods=self.periods,
            draws=self.phase_draws,
            lead_in_samples=self.lead_in_samples,
        )

    def records(self, dt_s: float, rng: np.random.Generator) -> Real:
        """Voltages (A, M, T) of all amplitudes and realisations; the ladder changes nothing but the size.

        Phases are drawn anew for every record, rung by rung.
        """
        rungs = []
        for rms_V in self.rms_V:
            realisations = [self.record(rms_V, dt_s, rng) for _ in range(self.realisations)]
            rungs.append(np.stack(realisations))
        return np.stack(rungs)

    def scaled(
        self, voltages_V: Real, *, peak_V: float, angle_rad: float, motion: Callable[[Real], Real] | None
    ) -> Self:
        """This plan with a ladder whose top is as high as voltage and motion allow.

        Parameters
        ----------
        voltages_V : (A, M, T)
            The plan's `records`, with the ladder as it is.
        peak_V : float
            Largest voltage that is allowed.
        angle_rad : float
            Largest hub angle that is allowed; without a motion it is not looked at.
        motion : callable or None
            Hub angle (T,) from rest under a voltage (T,), linear in it.

        Returns
        -------
        ExperimentPlan
            With every rung multiplied by the same share.
        """
        share = min(peak_V / float(np.max(np.abs(voltages_V))), np.inf)
        if motion is not None:
            peaks_rad = []
            for rung in voltages_V:
                for voltage in rung:
                    peaks_rad.append(float(np.max(np.abs(motion(voltage)))))
            share = min(share, angle_rad / max(peaks_rad))
        # Three digits, rounded down: a plan is read by people, and stays within its limits.
        exact = np.array(self.rms_V) * share
        third_digit = 10.0 ** (np.floor(np.log10(exact)) - 2)
        # Decimal digits that the multiplication spoils are rounded away.
        rounded = (np.floor(exact / third_digit) * third_digit).round(12)
        return self.model_copy(update={"rms_V": tuple(rounded.tolist())})

    def radius(self, rms_V: float, dt_s: float, noise_std: float) -> float:
        """Expected 95 % radius of the response at one line from white sensor noise, output units per volt.

        A line carries |U|^2 = N^2 rms^2 / (2 H) of H lines and a period of N samples, noise N std^2; averaged
        over M realisations and P periods the variance is v = 2 H std^2 / (N M P rms^2), the radius
        sqrt(-v ln 0.05). Distortion and a model that joins the lines are left out.
        """
        averaged_samples = self.period_samples * self.realisations * self.periods
        n_lines = self.lines(dt_s).size
        variance = 2 * n_lines * noise_std**2 / (averaged_samples * rms_V**2)
        return float(np.sqrt(-variance * np.log(1 - _LEVEL)))
