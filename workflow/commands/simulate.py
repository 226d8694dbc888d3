"""`flexlink simulate`: the experiments of a configuration as CSV files, and the true modes beside them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ident.data.record import Record
from workflow.config.run_config import SimulatedSource, built_in_config, load_simulation
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import RunDirectory
from workflow.tasks import truth
from workflow.tasks.simulated_rig import INPUT_NAME, OUTPUT_NAMES, simulate_record


def simulate_to_csv(config_path: Path | None, out: Path) -> list[Path]:
    """Simulate the experiments of a configuration; one CSV per record, named after it, then truth.json.

    Columns time_s, voltage_V, hub_angle_rad, tip_m, so that the files can be read back as a log. Raises
    InputError.
    """
    config = load_simulation(config_path) if config_path is not None else built_in_config()[0]
    if not isinstance(config.source, SimulatedSource):
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = 'simulated'")
    out = Path(out)
    RunDirectory(out).refuse_unless_free()
    records = []
    for index, entry in enumerate(config.source.records):
        with naming(f"source.records[{index}] ({entry.name})"):
            records.append(simulate_record(config.source, entry, config.run.seed))
    existed = out.is_dir()
    files: list[Path] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for number, record in enumerate(records, start=1):
            path = out / f"{number:02d}_{file_name(record.name)}.csv"
            storage.write_text(path, csv_text(record))
            files.append(path)
        path = out / truth.FILE_NAME
        storage.write_text(path, truth.truth_of(config.source).model_dump_json(indent=1) + "\n")
        files.append(path)
    except (OSError, InputError) as error:
        for path in files:  # all of the experiments or none
            path.unlink()
        if not existed and out.is_dir():
            out.rmdir()
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot write {out}: {error.strerror or error}") from error
    return files


def file_name(name: str) -> str:
    """A record's name in a file name: all but letters, digits, '_', '.' and '-' becomes '_'."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name)


def csv_text(record: Record) -> str:
    """The record as CSV with one header line; nine digits, far below any sensor's noise."""
    lines = [",".join(("time_s", INPUT_NAME, *OUTPUT_NAMES))]
    table = np.column_stack([record.time_s, record.input, record.output])
    lines += [",".join(f"{value:.9g}" for value in row) for row in table]
    return "\n".join(lines) + "\n"
