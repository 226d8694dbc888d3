"""Records of one channel into its model, ellipses and tests: what `flexlink identify` computes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ident.basis.options import IdentOptions
from ident.command_timing import CommandTiming
from ident.data.finding import Finding
from ident.data.record import Record
from ident.friction import EquivalentFriction, FrictionFit
from workflow.config.run_config import ClosedLoopData, RunSection
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine.errors import naming
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.tasks.early_refusals import fit_options, single_channel
from workflow.tasks.identification import identify_channel, made_in_loop, shaft_friction
from workflow.tasks.results import IdentifiedChannel, UncertainChannel
from workflow.tasks.simulated_rig import TrueMode
from workflow.tasks.uncertainty import uncertainty_of


@dataclass(frozen=True, eq=False)
class LogIdentification:
    """Everything that was found in a set of logs.

    `measured` are the records as read; `about` and `spread` results as of a run's stages; `careful` says what
    to look at. The stabilisation plot is None where nobody asked for it. `true_modes`: beside each mode of
    `about` the true one, known of simulated logs. `described`: what the ellipses are about; friction:
    identified, where that asks for it; equivalent: the viscous friction that acts like it, where it asks for
    an amplitude. input_limit: that the amplifier gives, where it was stated.
    """

    measured: tuple[Record, ...]
    fresh_records: tuple[Record, ...]
    options: IdentOptions
    about: IdentifiedChannel
    spread: UncertainChannel
    described: UncertaintyOptions
    friction: FrictionFit | None = None
    equivalent: EquivalentFriction | None = None
    true_modes: tuple[TrueMode | None, ...] = ()
    input_limit: float | None = None

    @property
    def careful(self) -> tuple[Finding, ...]:
        return (*self.about.identification.warnings, *self.spread.advice)


def identify_records(
    measured: Sequence[Record],
    fresh_records: Sequence[Record] = (),
    options: IdentOptions | None = None,
    *,
    described: UncertaintyOptions | None = None,
    band_rad_s: tuple[float, float] | None = None,
    loop: ClosedLoopData | None = None,
    with_plot: bool = True,
    timing: CommandTiming | None = None,
    progress: Progress | None = None,
) -> LogIdentification:
    """Identify one channel from SISO records, as a run with these settings does; nothing is written.

    described: what the ellipses are about, and their level; loop: how to use logs made in closed loop;
    timing: of the command between two rows, for which the records are corrected. Raises InputError.
    """
    progress, described = progress or Progress(), described or UncertaintyOptions()
    loop = loop or ClosedLoopData()
    fit = fit_options(options)
    friction = None
    with naming("identify"), progress.stage("identify") as update:
        channel = single_channel(measured[0], fit, described, band_rad_s)
        if described.friction_identified:
            friction = shaft_friction(measured, channel, update)
        about = identify_channel(
            channel,
            measured,
            [(record, "validation") for record in fresh_records],
            loop if loop.stated or made_in_loop(measured) else None,
            update,
            friction=friction,
            with_plot=with_plot,
            law=None if timing is None else timing.law,
        )
    with naming("identify"), progress.stage("uncertainty"):
        rng = stage_rng(RunSection().seed, "uncertainty", channel.label)
        spread, equivalent = uncertainty_of(
            channel, about, measured, rng, friction=friction, timing=timing, in_parts=False
        )
    return LogIdentification(
        measured=tuple(measured),
        fresh_records=tuple(fresh_records),
        options=fit,
        about=about,
        spread=spread,
        described=described,
        friction=friction,
        equivalent=equivalent,
    )
