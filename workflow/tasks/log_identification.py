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

    Attributes
    ----------
    measured, fresh_records : tuples of Record
        As read: those of the fit, and those for free runs.
    options : IdentOptions
        Of the pole search.
    about : IdentifiedChannel
        Model and free runs, as the stage "identify" of a run leaves them.
    spread : UncertainChannel
        Ellipses and tests, as the stage "uncertainty" leaves them.
    described : UncertaintyOptions
        What the ellipses describe.
    friction : FrictionFit or None
        Identified where `described` asks for it.
    equivalent : EquivalentFriction or None
        Viscous friction that acts like the dry one, where `described` asks for an amplitude.
    true_modes : tuple of TrueMode or None
        Beside each mode of `about` the true one; known of simulated logs only.
    input_limit : float or None
        Of the amplifier, where it was stated, in units of the input.
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
        """What is doubtful of the model and of its ellipses."""
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
    """The channel of these records as a run with these settings identifies it; nothing is written.

    Parameters
    ----------
    measured : sequence of Record
        One input, one output, one sampling time.
    fresh_records : sequence of Record
        For free runs of the model.
    options : IdentOptions, optional
        Of the pole search.
    described : UncertaintyOptions, optional
        What the ellipses describe, and their level.
    band_rad_s : tuple of two float, optional
        The data are confined to this band [rad/s].
    loop : ClosedLoopData, optional
        How logs that were made in closed loop are used.
    with_plot : bool
        Also compute the stabilisation plot.
    timing : CommandTiming, optional
        Of the command between two rows; the records are corrected for it already.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line: the logs cannot carry a model.
    """
    progress = progress or Progress()
    described = described or UncertaintyOptions()
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
