"""Logs judged before anything slow is loaded: refused in one line, or what is doubtful of them said at
once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from pydantic import ValidationError

from ident.basis.options import IdentOptions
from ident.checks.early_checks import STILL_INPUT, early_checks, early_doubts, refuse_hopeless
from ident.data.finding import FindingKind, distinct
from ident.data.record import Record
from ident.data.signal_filter import band_edges
from workflow.config.joints_config import AnyConfig
from workflow.config.run_config import Channel, ClosedLoopData, FileSource, RunConfig
from workflow.config.uncertainty_options import FitOptions, UncertaintyOptions
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress

# Of the ways in which a log was read, what may spoil the whole answer: said before anything is searched. The
# table and the page have them all.
_SAID_AT_ONCE = frozenset(
    {
        FindingKind.TIME_UNIT,
        FindingKind.UNIT_OF_LOOP,
        FindingKind.EXCHANGED,
        FindingKind.OPPOSITE,
        FindingKind.UNIT_OF_REFERENCE,
        FindingKind.UNIT_CONTRADICTED,
    }
)

# Findings on readings that are none: what is identified from them is of no machine.
_NO_READINGS = frozenset({FindingKind.SPIKES, FindingKind.NO_READING})


@contextmanager
def naming_readings(records: Sequence[Record]) -> Iterator[None]:
    """A refusal inside begins with the first reading that is none, its likely cause. Raises InputError."""
    try:
        yield
    except InputError as refused:
        notes = (note for record in records for note in record.notes)
        likely = next((note for note in notes if note.kind in _NO_READINGS), None)
        if likely is None:
            raise
        from workflow.text.templates import words  # templates take a moment to load, and few logs need them

        raise InputError(f"{words(likely).partition(' Delete such rows')[0]} Then: {refused}") from refused


def refuse_hopeless_logs(
    measured: Sequence[Record], progress: Progress | None = None, *, order: int = 0, loop: bool = False
) -> None:
    """Nothing, once doubts about logs that can be used are said to whoever watches.

    Parameters
    ----------
    measured
        Records to identify from, one input and one output each.
    progress
        Told a line for each doubt.
    order
        Of the model, where it is stated.
    loop
        The logs were made in a loop that is to be opened.

    Raises
    ------
    InputError
        One line, where no model can come out of these records.
    """
    with naming(""):
        refuse_hopeless(measured, early_checks(order, loop=loop))
    if progress is None:
        return
    doubts = [doubt for record in measured for doubt in record.doubts if doubt.kind in _SAID_AT_ONCE]
    doubts += early_doubts(measured)
    for doubt in distinct(doubts):
        from workflow.text.templates import words  # templates take a moment to load, and few logs need them

        progress.note(f"doubt: {words(doubt)}")


def refuse_constant_input(record: Record) -> None:
    """A record to identify from must have an input that moves. Raises InputError."""
    with naming(""):
        refuse_hopeless([record], [STILL_INPUT])


def refuse_hopeless_source(
    config: AnyConfig, records: Sequence[Record], progress: Progress | None = None
) -> None:
    """`refuse_hopeless_logs` for each channel of a configuration and its records, in its order; of several
    joints nothing is judged here. Raises InputError."""
    if not isinstance(config, RunConfig) or not isinstance(config.source, FileSource):
        return
    limit = config.source.input_limit or np.inf
    fitted = [
        record.limited(limit)
        for entry, record in zip(config.source.records, records, strict=True)
        if entry.role == "estimation"
    ]
    for channel in config.channels:
        refuse_hopeless_channel(
            channel,
            [record.siso(channel.input, channel.output) for record in fitted],
            config.closed_loop_data,
            progress,
        )


def refuse_hopeless_channel(
    channel: Channel, measured: Sequence[Record], loop: ClosedLoopData, progress: Progress | None = None
) -> None:
    """`refuse_hopeless_logs` for the records (one input, one output) that a channel is identified from; loop:
    how logs of one are used. Raises InputError."""
    options = channel.identification
    # A loop is opened by its reference, if every record has one that moves, unless another way is stated.
    # Behind a filter the command may excite other frequencies than as recorded.
    moving = all(record.reference is not None and np.ptp(record.reference) > 0 for record in measured)
    filtered = channel.increments or channel.band_rad_s is not None
    refuse_hopeless_logs(
        measured,
        progress,
        order=(options.n_real or 0) + 2 * (options.n_pairs or 0),
        loop=moving and not filtered and loop.method in ("auto", "two_stage"),
    )


def fit_options(options: IdentOptions | None) -> FitOptions:
    """Options of a search as those of a channel: what is not stated is left to the channel."""
    stated = {} if options is None else options.model_dump(exclude_unset=True)
    return FitOptions.model_validate(stated)


def single_channel(
    record: Record,
    fit: FitOptions,
    described: UncertaintyOptions,
    band_rad_s: tuple[float, float] | None,
) -> Channel:
    """The channel that records like this one (one input, one output) are identified as. Raises ValueError,
    one line, for settings that contradict each other or the sampling time."""
    try:
        channel = Channel(
            input=record.input_names[0],
            output=record.output_names[0],
            identification=fit,
            uncertainty=described,
            band_rad_s=band_rad_s,
        )
    except ValidationError as error:
        raise ValueError(str(error.errors()[0]["ctx"]["error"])) from error
    if band_rad_s is not None:
        band_edges(record.dt_s, *band_rad_s)
    return channel
