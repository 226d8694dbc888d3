"""What a channel's settings do to a record before anything is fitted: one column pair, one filter."""

from __future__ import annotations

from ident.data.record import Record
from ident.data.signal_filter import band_limited, increments
from workflow.config.run_config import Channel


def as_fitted(record: Record, channel: Channel) -> Record:
    """The channel's columns as the pole search sees them: as measured, as increments, or inside the band."""
    record = record.siso(channel.input, channel.output)
    if channel.increments:
        return increments(record)
    return record if channel.band_rad_s is None else band_limited(record, *channel.band_rad_s)


def as_bounded(record: Record, channel: Channel) -> Record:
    """The channel's columns as the ellipses see them; the same unless a wider band is given for them."""
    if channel.bounds_band_rad_s is None:
        return as_fitted(record, channel)
    return band_limited(record.siso(channel.input, channel.output), *channel.bounds_band_rad_s)
