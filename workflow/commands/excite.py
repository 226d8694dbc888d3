"""`flexlink excite`: voltages of an identification experiment as CSV files, with a plan file and a page."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from workflow.engine import codec, storage
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.experiment import Limits, PlannedExperiment, plan_experiment

PLAN_FILE, PAGE_FILE = "plan.json", "plan.html"


def write_experiment(
    limits: Limits, out: Path, *, seed: int, lead_in_s: float, **settings: object
) -> list[Path]:
    """Plan an experiment within limits; one CSV (time_s, voltage_V) per record, the plan and its page.

    settings: fields of `plant.ExperimentPlan` by name. Raises InputError.
    """
    RunDirectory(out).refuse_unless_free()
    found = plan_experiment(limits, seed=seed, lead_in_s=lead_in_s, **settings)
    # Here: these take seconds to load, and limits that are refused do not need them.
    from workflow.report.rendering import render_page
    from workflow.tasks.simulated_rig import INPUT_NAME

    time = np.arange(found.plan.n_samples) * limits.dt_s
    signals = found.voltages_V.reshape(-1, time.size)
    texts = {
        record.file: storage.csv_text({"time_s": time, INPUT_NAME: voltage})
        for record, voltage in zip(found.records, signals, strict=True)
    }
    texts[PLAN_FILE] = codec.plain_text(_document(found))
    texts[PAGE_FILE] = render_page("experiment.html.j2", title="Planned experiment", found=found).html
    return storage.write_new_directory(out, texts)


def _document(found: PlannedExperiment) -> dict[str, object]:
    return {
        "plan": found.plan,
        "seed": found.seed,
        "dt_s": found.limits.dt_s,
        "duration_s": found.duration_s,
        "lines_Hz": found.lines_Hz,
        "detection_lines_Hz": found.detection_Hz,
        "expected_radius_rad_per_V": found.radii,
        "records": found.records,
    }
