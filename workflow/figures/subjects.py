"""What pages and pictures are about: an identified channel, and a run, from the typed results of the steps.

Here are the numbers that a page needs and no step has computed; every sentence stands in the templates.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from control_design.analysis.margins import nominal_margins
from control_design.analysis.stability import closed_loop_poles, loop_integrators
from control_design.controllers.controller import Controller
from control_design.controllers.engineers_numbers import ControllerNumbers, engineers_numbers
from control_design.controllers.law import Law
from control_design.plants.frequency_grid import checked_grid, frequency_grid
from control_design.plants.plant_set import Mode, UncertainPlant, frequency_response, modes_of
from control_design.specification import Specification
from ident.basis.options import IdentOptions
from ident.checks.distortion_findings import distortion_findings
from ident.checks.plausible_modes import LIGHT
from ident.data.distortion import Distortion, distortion_of
from ident.data.finding import Finding
from ident.data.record import Record
from ident.data.repeats import repeats_of
from ident.friction import FrictionFit
from workflow.config.run_config import Channel, RunConfig
from workflow.figures import style
from workflow.figures.bands import Complex, Real, smooth_grid
from workflow.figures.style import ratio_unit
from workflow.tasks.exports import Logged
from workflow.tasks.giving_way import GaveWay, gave_way
from workflow.tasks.identification import as_fitted
from workflow.tasks.log_identification import LogIdentification
from workflow.tasks.results import (
    IdentifiedChannel,
    ModelMode,
    RunResults,
    UncertainChannel,
)

# What ran as the machine, in words.
MACHINE = {"simulated": "simulated arm", "identified": "plants drawn from the identified uncertainty"}
# Looks and words of the loop with friction, of the new controller and of the recorded one.
FRICTION = (
    style.MODEL_LINE | {"label": "identified arm with friction"},
    style.MEASURED_LINE | {"label": "the same arm in the recorded loop"},
)


@dataclass(frozen=True, eq=False)
class ChannelView:
    """One channel as pages and pictures look at it.

    Attributes
    ----------
    found : IdentifiedChannel
        Model and free runs.
    spread : UncertainChannel
        Ellipses.
    options : IdentOptions
        Of the fit.
    fresh_records : tuple of Record
        Behind the free runs `found.fresh`.
    measured : tuple of Record
        Of the fit, as measured.
    units : tuple of two str
        Of input and output, "" where nobody stated them.
    file : str
        What tells its pictures from those of another channel.
    closed_loop : (n,) complex array or None
        Poles of the loop around it, where there is one.
    """

    found: IdentifiedChannel
    spread: UncertainChannel
    options: IdentOptions
    fresh_records: tuple[Record, ...]
    measured: tuple[Record, ...] = ()
    units: tuple[str, str] = ("", "")
    file: str = ""
    closed_loop: Complex | None = None

    @property
    def name(self) -> str:
        return self.found.name

    @cached_property
    def distortion(self) -> tuple[tuple[Distortion, ...], list[Finding], str]:
        """Levels of noise and distortion, what they say, and why there are none where the records refuse."""
        try:
            levels = distortion_of(self.measured)
        except ValueError as error:
            return (), [], str(error)
        return levels, distortion_findings(self.measured, levels, repeats_of(self.measured)), ""

    @property
    def light(self) -> list[tuple[int, ModelMode]]:
        """Lightly damped modes with their place among all modes."""
        light = []
        for place, mode in enumerate(self.found.modes):
            intervals = self.spread.intervals
            is_told = intervals is None or intervals.modes[place].told
            if mode.damping < LIGHT and self.found.is_mode(mode) and is_told:
                light.append((place, mode))
        return light

    @property
    def shown_fresh(self) -> int | None:
        """The free run that is shown: first validation record, else repeat, else a fitted record (None)."""
        roles = self.found.fresh_roles
        return next((roles.index(role) for role in ("validation", "repeat") if role in roles), None)

    @property
    def shown_pair(self) -> int | None:
        """The pole pair whose error surface is shown: the slowest lightly damped one, else the slowest."""
        omega = self._omega_rad_s
        zeta = self.found.model.poles.zeta()
        light = (zeta < LIGHT) & (zeta > 5e-4)
        # Where no pair is light, all may be shown.
        candidates = light | ~light.any()
        slowest = np.argsort(np.where(candidates, omega, np.inf))
        return int(slowest[0]) if slowest.size else None

    @property
    def shown_omega_rad_s(self) -> float | None:
        return None if self.shown_pair is None else float(self._omega_rad_s[self.shown_pair])

    @property
    def _omega_rad_s(self) -> Real:
        return self.found.model.poles.omega_rad_s(self.found.model.dt_s)

    @property
    def unconfirmed_rad_s(self) -> list[float]:
        """Pole pairs of the model that the stabilisation plot does not confirm."""
        plot = self.found.stabilisation
        if plot is None:
            return []
        modes = [mode.omega_rad_s for mode in plot.columns()]
        is_chosen = plot.n_pairs == plot.chosen
        # A column within 2 % has the pole pair already.
        unconfirmed = []
        for omega in plot.omega_rad_s[is_chosen]:
            is_known = any(abs(omega / mode - 1) < 0.02 for mode in modes)
            if not is_known:
                unconfirmed.append(float(omega))
        return unconfirmed

    @cached_property
    def zeros(self) -> Complex:
        return self.found.model.zeros()

    @property
    def zeros_outside(self) -> int:
        return int(np.count_nonzero(np.abs(self.zeros) > 1))

    @property
    def zero_pairs(self) -> list[tuple[float, float]]:
        """Antiresonances: frequency [rad/s] and damping ratio of lightly damped zero pairs."""
        zeros = self.zeros
        # One of each pair; a zero near the origin is no frequency.
        is_upper = (zeros.imag > 1e-9) & (np.abs(zeros) > 0.05)
        log = np.log(zeros[is_upper]) / self.found.model.dt_s
        pairs = []
        for s in log:
            omega = abs(s)
            # Zeros of a light pair dent the response; of a damped one nobody sees anything.
            if abs(s.real) < LIGHT * omega:
                pairs.append((omega, -s.real / omega))
        return sorted(pairs)

    @property
    def searched(self) -> tuple[int, int]:
        """Real poles and pole pairs that were found, those given as known left out."""
        fixed = self.options.fixed().without(self.options.unstable())
        return len(self.found.real_poles_z) - fixed.real.size, len(self.found.modes) - fixed.pairs.size

    @property
    def unseen(self) -> list[tuple[str, float, str]]:
        """Name, fit [%] and role of the records that the fit has not seen, validation first."""
        pairs = zip(self.found.fresh, self.found.fresh_roles, strict=True)
        rows = [(fit.name, fit.fit_percent, str(role)) for fit, role in pairs]
        return sorted(rows, key=lambda row: row[2] != "validation")


def log_channel(result: LogIdentification) -> ChannelView:
    """The channel of `flexlink identify`."""
    first = result.measured[0]
    units = "".join(first.input_units[:1]), "".join(first.output_units[:1])
    return ChannelView(
        result.about, result.spread, result.options, result.fresh_records, result.measured, units
    )


@dataclass(frozen=True, eq=False)
class AnyRunView:
    """A run whose stages are all there, of one loop or of several joints."""

    config: Any
    results: Any
    manifest: Mapping[str, Any]

    def largest_recorded(self, signal: str) -> float:
        """Largest size of an input in the records of the fit, in its unit."""
        largest = []
        for item in self.results.records.of_role("estimation"):
            column = item.record.input_names.index(signal)
            # Either sign: the command of a reference in the other direction is as large.
            commands = item.record.input[:, column]
            largest.append(float(np.max(np.abs(commands))))
        return max(largest)

    @property
    def signals(self) -> str:
        """What the controller's files take and give."""
        return Logged.of(self.config, self.results.records).signals


class RunView(AnyRunView):
    """A run of one loop."""

    config: RunConfig
    results: RunResults

    @property
    def specification(self) -> Specification:
        """What was designed for: every requirement as far as it gave way."""
        return self.results.design.specification or self.config.specification

    @property
    def gave_way(self) -> tuple[GaveWay, ...]:
        """What less was designed for than asked."""
        return gave_way(self.config.specification, self.results.design.specification)

    @cached_property
    def channels(self) -> tuple[ChannelView, ...]:
        return tuple(self._channel(index) for index in range(len(self.config.channels)))

    def _channel(self, index: int) -> ChannelView:
        channel = self.config.channels[index]
        identified = self.results.identify.channels[index]
        records = self.results.records
        by_name = {item.name: item.record for item in records.records}
        friction = self.results.identify.friction if channel.uncertainty.friction_identified else None
        # A name that files can have.
        slug = re.sub(r"[^A-Za-z0-9]+", "-", identified.name).strip("-").lower()[:24]
        closed_loop = None
        if index == self.config.control_index and self.results.design.controller is not None:
            closed_loop = closed_loop_poles(self.controller, self.plant)
        model = identified.model
        fresh = tuple(_as_fitted(by_name[fit.name], channel, friction) for fit in identified.fresh)
        return ChannelView(
            found=identified,
            spread=self.results.uncertainty.channels[index],
            options=channel.identification,
            fresh_records=fresh,
            measured=tuple(records.fitted(channel)),
            units=(records.unit(model.input_name), records.unit(model.output_name)),
            file=f"{index + 1}-{slug}".strip("-"),
            closed_loop=closed_loop,
        )

    @property
    def control(self) -> ChannelView:
        return self.channels[self.config.control_index]

    @property
    def performance(self) -> ChannelView | None:
        index = self.config.performance_index
        return None if index is None else self.channels[index]

    @property
    def input_unit(self) -> str:
        return self.results.records.unit(self.config.control_channel.input)

    @property
    def output_unit(self) -> str:
        return self.results.records.unit(self.config.control_channel.output)

    @property
    def controller(self) -> Controller:
        """The designed controller. Raises ValueError where there is none."""
        if self.results.design.synthesis is None:
            raise ValueError("the run has no design")
        return self.results.design.synthesis.controller

    @property
    def logged_controller(self) -> Controller:
        """The controller for the columns of the logs, as it stands in the run's files."""
        return Logged.of(self.config, self.results.records).law(self.controller)

    @property
    def engineers_numbers(self) -> ControllerNumbers | None:
        """The controller in an engineer's numbers, as the run's files have it; None without such factors."""
        return engineers_numbers(self.logged_controller)

    @property
    def loop_factor(self) -> float:
        """Factor from `model.json` times the K of `controller.json` to the loop gain.

        The controller's files take and give the columns as logged, the model is in quantities.
        """
        logged = Logged.of(self.config, self.results.records)
        return logged.command[0] / logged.error[0]

    def model_margins(self) -> dict[str, tuple[tuple[float, float, float], bool]]:
        """Margins of the nominal model, that of `model.json`, with each K of the controller's files.

        Returns
        -------
        margins : dict
            For `K_with_delay` and `K_without_delay` the gain margin nearest to 1 (a factor), the phase margin
            [deg] and the modulus margin; and whether the gain crosses at zero or at the Nyquist frequency,
            where `control.stability_margins` does not look.

        Notes
        -----
        The margins of the certificate are about the ellipses and their centres, from which the nominal model
        differs a little. Say nothing of a loop that is not stable.
        """
        plant = self.plant
        law = self.controller

        # The grid of the certificate: fine wherever the open or the closed loop has a pole or a zero.
        closed = closed_loop_poles(law, plant)
        every_mode = (*plant.modes, *modes_of(closed, plant.dt_s), *modes_of(law.poles, plant.dt_s))
        light = []
        for mode in every_mode:
            # Growing modes need a fine grid, too; a mode without damping would need one without end.
            damping = abs(mode.zeta)
            if damping < LIGHT and mode.omega_rad_s < plant.nyquist_rad_s:
                light.append(Mode(mode.omega_rad_s, max(damping, 1e-4)))
        roots = np.concatenate([plant.poles, plant.zeros, law.poles, closed])
        omega = checked_grid(plant, light, 1000, 120, roots=roots)

        def loop_gain(omega: Real, with_delay: bool) -> Complex:
            return law.response(omega, with_delay=with_delay) * frequency_response(plant.nominal, omega)

        integrators, _ = loop_integrators(law, plant)
        at_zero = None if integrators else float(loop_gain(np.zeros(1), False)[0].real)

        margins = {}
        for name, with_delay in (("K_with_delay", True), ("K_without_delay", False)):
            of_loop = nominal_margins(partial(loop_gain, with_delay=with_delay), omega, at_zero=at_zero)
            gain = of_loop.gain_up
            # The factor that is nearer to 1, up or down, is the margin.
            falls_sooner = of_loop.gain_down > 0 and -np.log(of_loop.gain_down) < np.log(of_loop.gain_up)
            if falls_sooner:
                gain = of_loop.gain_down
            ends = loop_gain(omega[-1:], with_delay).real
            if at_zero is not None:
                ends = np.append(ends, at_zero)
            at_end = bool(np.any(np.isclose(gain * ends, -1.0, rtol=1e-6)))
            phase_deg = float(np.degrees(of_loop.phase_rad))
            margins[name] = (gain, phase_deg, of_loop.modulus), at_end
        return margins

    @staticmethod
    def forms(law: Law) -> dict[str, Any]:
        """Zeros, poles and gain in z of a law with one input and output, its numerator and denominator with
        the highest power first, and its second-order sections, as lists of scipy.signal."""
        # Imported here: it takes its time to load.
        from scipy import signal

        system = law.to_control()
        here = np.exp(1j)

        # Rounding leaves pairs that are not quite conjugate, and zeros at infinity that are not quite there:
        # those of the upper half-plane are kept, and mirrored.
        def in_pairs(roots: Any) -> Any:
            is_kept = (roots.imag >= 0) & (np.abs(roots) < 1e9)
            upper = np.round(roots[is_kept], 13)
            is_complex = upper.imag > 1e-9
            return np.concatenate([upper, upper[is_complex].conj()])

        zeros = in_pairs(system.zeros())
        poles = in_pairs(system.poles())
        from_poles = np.prod(here - poles)
        from_zeros = np.prod(here - zeros)
        gain = float(np.real(system(here) * from_poles / from_zeros))
        above, below = signal.zpk2tf(zeros, poles, gain)
        # scipy's sections hold powers of 1/z: each zero fewer than there are poles is a delay of one sample.
        delays = [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * (poles.size - zeros.size)
        sections = np.vstack([signal.zpk2sos(zeros, poles, gain), *delays])
        return {"z": zeros, "p": poles, "k": gain, "num": above, "den": below, "sos": sections}

    @property
    def plant(self) -> UncertainPlant:
        return self.results.uncertainty.plant(self.config)

    @property
    def level(self) -> float:
        """Level of the ellipses of the channel that is fed back."""
        return self.control.spread.level

    @property
    def certified_level(self) -> float:
        """Level of the ellipses that were certified: calibrated to sampled responses where asked for."""
        joint = None if self.results.certify.certificate is None else self.results.certify.certificate.joint
        return self.level if joint is None else max(self.level, joint.level)

    @cached_property
    def loop_grid(self) -> Real:
        """Display frequencies, denser around the modes of controller and closed loop and where the loop's
        locus turns, with the certificate's worst one.

        A controller that notches a mode has features as narrow as the mode's own; the identified poles do
        not show them.
        """
        omega = self.control.spread.frequency.omega_rad_s
        above_zero = omega > 0
        omega = omega[above_zero]
        if self.plant.own_grid is not None:
            return omega
        poles = [closed_loop_poles(self.controller, self.plant)]
        if self.controller.order:
            poles.append(np.linalg.eigvals(self.controller.A).astype(np.complex128))
        lowest = float(omega[0])
        highest = float(omega[-1])
        modes = []
        for mode in modes_of(np.concatenate(poles), self.plant.dt_s):
            if lowest < mode.omega_rad_s < highest:
                modes.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), 1e-4)))
        certificate = self.results.certify.certificate
        plants = () if certificate is None else certificate.plants
        margins_at = [plant.worst_margin_omega_rad_s for plant in plants]
        worst = [at for at in margins_at if 0 < at <= highest]
        dense = frequency_grid(highest, modes, omega_min_rad_s=lowest, n_log=2, n_mode=81 * len(modes))
        together = np.unique(np.concatenate([omega, dense, worst]))
        is_inside = (together > 0) & (together <= highest)
        return smooth_grid(
            together[is_inside], lambda w: self.controller.response(w) * self.plant.at(w).centre
        )


# Units by the ending of a key.
_ENDINGS = (("_rad_s", "rad/s"), ("_s", "s"))


def unit_of(key: str, input_unit: str, output_unit: str) -> str:
    """Unit of a key of the specification, for a plant whose signals have these units; "" without one."""
    units = {
        "effort_limit": ratio_unit(input_unit, output_unit),
        "input_limit": input_unit,
        "rate_limit": ratio_unit(input_unit, "s"),
    }
    by_ending = [unit for end, unit in _ENDINGS if key.endswith(end)]
    default = by_ending[0] if by_ending else ""
    return units.get(key, default)


def _as_fitted(record: Record, channel: Channel, friction: FrictionFit | None) -> Record:
    """The record as the fit sees it, increments and filtered signals named so."""
    fitted = as_fitted(record, channel, friction)
    name = fitted.output_names[0]
    if channel.increments:
        name = f"Δ {name}"
    elif channel.band_rad_s is not None:
        name = f"{name}, in band"
    return replace(fitted, output_names=(name,))
