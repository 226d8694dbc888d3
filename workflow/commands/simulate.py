"""`flexlink simulate`: the experiments of a configuration as CSV files, and the true modes beside them."""

from __future__ import annotations

import re
from pathlib import Path

from workflow.config.run_config import SimulatedSource, built_in_config, load_simulation
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import RunDirectory


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
    # Here: what simulates takes seconds to load, and a configuration that is refused does not need it.
    from workflow.tasks.simulated_rig import (
        INPUT_NAME,
        OUTPUT_NAMES,
        TRUTH_FILE,
        simulate_record,
        truth_of,
    )

    texts = {}
    for index, entry in enumerate(config.source.records):
        with naming(f"{config_path or 'default arm'}: source.records[{index}] ({entry.name})"):
            record = simulate_record(config.source, entry, config.run.seed)
        signals = dict(zip((INPUT_NAME, *OUTPUT_NAMES), [*record.input.T, *record.output.T], strict=True))
        safe = re.sub(r"[^A-Za-z0-9_.-]+", "_", entry.name)
        texts[f"{index + 1:02d}_{safe}.csv"] = storage.csv_text({"time_s": record.time_s, **signals})
    texts[TRUTH_FILE] = truth_of(config.source).model_dump_json(indent=1) + "\n"
    return storage.write_new_directory(out, texts)
