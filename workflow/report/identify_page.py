"""The page of `flexlink identify`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import metadata

from workflow.figures.subjects import log_channel
from workflow.report.rendering import render_page
from workflow.tasks.log_identification import LogIdentification
from workflow.tasks.results import RunRecord


def identify_page(
    result: LogIdentification, inputs: Mapping[str, str], progress: Callable[[float, str], None] | None = None
) -> str:
    """One self-contained HTML page; inputs are the files with their SHA-256. Same results, same page."""
    options, channel = result.options, log_channel(result)
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "nlopt")]
    page = render_page(
        "identification.html.j2",
        progress,
        title=f"{channel.found.input} to {channel.found.output}",
        result=result,
        channel=channel,
        records=[
            *(RunRecord(record, "estimation", None, "") for record in result.measured),
            *(RunRecord(record, "validation", None, "") for record in result.fresh_records),
        ],
        changed=[
            (name, value)
            for name, field in type(options).model_fields.items()
            if (value := getattr(options, name)) != field.default
        ],
        versions=[*versions, ("python", sys.version.split()[0])],
        inputs=inputs,
    )
    return page.html
