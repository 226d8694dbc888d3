"""`flexlink excite`: voltages of an identification experiment as CSV files, with a plan file and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.data.roles import is_position
from workflow.commands.init import read_channel
from workflow.commands.logs import Reading
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.engine.run_directory import RunDirectory

if TYPE_CHECKING:
    from workflow.excite.experiment import ExperimentLimits

# The plan, beside the records.
PLAN_FILE = "plan.json"
# Its page.
PAGE_FILE = "plan.html"


def write_experiment(limits: ExperimentLimits, out: Path, *, seed: int, **settings: object) -> list[Path]:
    """Plan an experiment within limits; one CSV (time_s, voltage_V) per record, the plan and its page.

    settings: fields of `plant.ExperimentPlan` by name. Raises InputError.
    """
    from workflow.excite.experiment import plan_experiment

    RunDirectory(out).refuse_unless_free()
    experiment = plan_experiment(limits, seed=seed, **settings)
    # Here: these take seconds to load, and limits that are refused do not need them.
    from workflow.excite.page import experiment_page
    from workflow.report.rendering import render_described
    from workflow.tasks.simulated_rig import INPUT_NAME

    time = np.arange(experiment.plan.n_samples) * limits.dt_s
    signals = experiment.voltages_V.reshape(-1, time.size)
    texts = {
        record.file: storage.csv_text({"time_s": time, INPUT_NAME: voltage})
        for record, voltage in zip(experiment.records, signals, strict=True)
    }
    texts[PLAN_FILE] = codec.plain_text(
        {
            "plan": experiment.plan,
            "seed": experiment.seed,
            "dt_s": experiment.limits.dt_s,
            "duration_s": experiment.duration_s,
            "lines_Hz": experiment.lines_Hz,
            "detection_lines_Hz": experiment.detection_Hz,
            "expected_radius_rad_per_V": experiment.radii,
            "records": experiment.records,
        }
    )
    texts[PAGE_FILE] = render_described(experiment_page(experiment)).html
    return storage.write_new_directory(out, texts)


def write_reference(
    logs: Sequence[Path],
    out: Path,
    stated: Reading,
    **wanted: Any,
) -> RunSummary:
    """Plan a reference for the loop that made these logs; one CSV per record, and the plan.

    Parameters
    ----------
    logs : sequence of Path
    out : Path
        A directory; each CSV has time_s and the reference.
    stated : Reading
        How the logs are read.
    **wanted
        Keywords of `plan_reference`.

    Raises
    ------
    InputError
        One line.
    """
    RunDirectory(out).refuse_unless_free()
    read = read_channel("excite --closed-loop", logs, stated)
    # Takes seconds to load.
    from workflow.excite.reference_plan import plan_reference
    from workflow.excite.words import reference_sections

    roles = read.roles
    position = is_position(roles.output, read.unit_of[roles.output])
    plan = plan_reference(read.records, position=position, **wanted)
    column = roles.reference or "reference"
    time = np.arange(plan.plan.n_samples) * plan.dt_s
    texts = {
        f"{plan.plan.realisations * level + k + 1:02d}_level_{level + 1}_realisation_{k + 1}.csv": (
            storage.csv_text({"time_s": time, column: plan.offset + signal})
        )
        for level, signals in enumerate(plan.references)
        for k, signal in enumerate(signals)
    }
    numbers = {key: value for key, value in vars(plan).items() if key != "references"}
    texts[PLAN_FILE] = codec.plain_text({"files": sorted(texts), "reference": column, **numbers})
    storage.write_new_directory(out, texts)
    return RunSummary(
        title=str(out),
        sections=reference_sections(plan, read.unit_of[roles.input], read.unit_of[roles.output]),
        numbers=codec.plain(numbers),
        verdict=f"play {column} of each file; log {column}, {roles.input} and {roles.output} from its start",
    )
