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
from workflow.config.run_config import AnyConfig, Channel, ClosedLoopData, FileSource, RunConfig
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
        FindingKind.REFERENCE_STILL,
        FindingKind.UNIT_CONTRADICTED,
    }
)

# Findings on rows that hold no reading of the sensor: what is identified from them is of no machine.
_NO_READINGS = frozenset({FindingKind.SPIKES, FindingKind.NO_READING})

# Share of one log that is fitted: its last part validates. Chosen, as is usual for one log.
_FITTED_SHARE = 0.7
# Samples of that last part at least: of fewer a free run says little. Chosen; half as many validate on part
# of a period of a slow reference.
_FEWEST_VALIDATING = 1000


def split_sample(record: Record) -> int | None:
    """First sample of the part of one log that validates; None where there is none.

    That is where the part would have fewer than `_FEWEST_VALIDATING` samples, or its input not half to twice
    the standard deviation of the first part. An input that stands still in the first part divides by zero.
    """
    at = round(_FITTED_SHARE * record.n_samples)
    if record.n_samples - at < _FEWEST_VALIDATING:
        return None
    first = float(np.std(record.input[:at]))
    second = float(np.std(record.input[at:]))
    return at if 0.5 < second / first < 2 else None


def fitted_records(records: Sequence[Record]) -> list[Record]:
    """Records that a model is fitted to, where nobody stated the roles of the logs.

    All but the last, which validates; of a single one its first part, or all of it where the input stands
    still in that.
    """
    if len(records) > 1:
        return list(records[:-1])
    record = records[0]
    first_part = record.input[: round(_FITTED_SHARE * record.n_samples)]
    if np.ptp(first_part) == 0:
        return [record]
    return [record.slice(0, split_sample(record) or record.n_samples)]


@contextmanager
def naming_readings(records: Sequence[Record]) -> Iterator[None]:
    """A context in which a refusal begins with the first row that holds no reading: its likely cause.

    records: with the notes of their reading. Raises InputError.
    """
    try:
        yield
    except InputError as refused:
        notes = (note for record in records for note in record.notes)
        likely = next((note for note in notes if note.kind in _NO_READINGS), None)
        if likely is None:
            raise
        from workflow.text.findings.sentences import words

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
        from workflow.text.findings.sentences import words

        progress.note(f"doubt: {words(doubt)}")


def refuse_constant_input(record: Record) -> None:
    """A record to identify from must have an input that moves. Raises InputError."""
    with naming(""):
        refuse_hopeless([record], [STILL_INPUT])


def refuse_hopeless_source(
    config: AnyConfig, records: Sequence[Record], progress: Progress | None = None
) -> None:
    """Nothing, for a configuration whose every channel can be identified from its logs.

    Parameters
    ----------
    config : AnyConfig
        Of several joints, or of simulated records, nothing is judged here.
    records : sequence of Record
        In the order of the configuration's records.
    progress : Progress, optional
        Told a line for each doubt.

    Raises
    ------
    InputError
        One line, see `refuse_hopeless_logs`.
    """
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
    """Nothing, for a channel that can be identified from its records.

    Parameters
    ----------
    channel : Channel
    measured : sequence of Record
        One input, one output.
    loop : ClosedLoopData
        How logs that were made in a loop are used.
    progress : Progress, optional
        Told a line for each doubt.

    Raises
    ------
    InputError
        One line, see `refuse_hopeless_logs`.
    """
    options = channel.identification
    # A loop is opened by its reference, if every record has one that moves, unless another way is stated.
    # Behind a filter the command may excite other frequencies than as recorded.
    moving = all(record.reference is not None and np.ptp(record.reference) > 0 for record in measured)
    filtered = channel.increments or channel.band_rad_s is not None
    real_poles = options.n_real or 0
    pole_pairs = options.n_pairs or 0
    refuse_hopeless_logs(
        measured,
        progress,
        order=real_poles + 2 * pole_pairs,
        loop=moving and not filtered and loop.method in ("auto", "two_stage"),
    )


def fit_options(options: IdentOptions | None) -> FitOptions:
    """Options of a channel with what the options of a search state; the rest is left to the channel."""
    stated = {} if options is None else options.model_dump(exclude_unset=True)
    return FitOptions.model_validate(stated)


def single_channel(
    record: Record,
    fit: FitOptions,
    described: UncertaintyOptions,
    band_rad_s: tuple[float, float] | None,
) -> Channel:
    """The channel that records like this one are identified as.

    Parameters
    ----------
    record : Record
        One input, one output.
    fit : FitOptions
        Of the pole search.
    described : UncertaintyOptions
        What the ellipses describe.
    band_rad_s : tuple of two float, or None
        The data are confined to this band [rad/s].

    Raises
    ------
    ValueError
        One line: settings that contradict each other or the sampling time.
    """
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
