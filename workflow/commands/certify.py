"""`flexlink certify`: a controller that is there, against plants, a specification and a baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit

from control_design.specification import Specification
from ident.data.settings import meant
from workflow.config.command_files import CommandFiles
from workflow.config.design_file import DesignFile
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.engine.documents import read_toml
from workflow.engine.errors import InputError, naming, need
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.tasks.system_documents import refuse_broken_files
from workflow.text.findings.sentences import words

if TYPE_CHECKING:
    from control_design.analysis.certificate import Certificate

# Relative. On one machine a certificate repeats to the last digit, others round differently: two to ten times
# what other sets of starts were seen to do to designs (tests/golden/margins.toml).
_TOLERANCES = {
    "gamma": 0.005,
    "modulus_margin": 0.005,
    "gain_margin_dB": 0.01,
    "phase_margin_deg": 0.01,
    "delay_margin_s": 0.02,
    "bandwidth_rad_s": 0.02,
    "least_mode_damping": 0.02,
}
# Head of a baseline that is written for the first time.
_HEADER = """\
# Worst cases and margins over the uncertainty set, by plant. No certificate may be worse by more than its
# tolerance (relative). Made by: flexlink certify ... --write-baseline FILE
"""


def worst_cases(certificate: Certificate, specification: Specification) -> dict[str, dict[str, Any]]:
    """By plant: numbers in the units of their names, worst case over its set. least_mode_damping: of the
    nominal loop's modes, inside the band of the damping requirement where there is one."""
    low, high = specification.mode_band_rad_s or (0.0, math.inf)
    return {
        verdict.plant: {
            "certified": certificate.certified,
            "gamma": verdict.worst_weighted,
            "modulus_margin": verdict.worst_margins.modulus,
            "gain_margin_dB": 20 * math.log10(verdict.worst_margins.gain_up),
            "phase_margin_deg": math.degrees(verdict.worst_margins.phase_rad),
            "delay_margin_s": verdict.worst_margins.delay_s,
            "bandwidth_rad_s": verdict.bandwidth_rad_s,
            "least_mode_damping": min(
                (mode.zeta for mode in verdict.closed_loop_modes if low <= mode.omega_rad_s <= high),
                default=1.0,
            ),
        }
        for verdict in certificate.plants
    }


def against(found: Mapping[str, Any], path: Path, table: str) -> dict[str, tuple[float, float, str]]:
    """Numbers of a plant beside those of a baseline.

    Parameters
    ----------
    found : mapping of str to number
        Numbers of the plant's certificate.
    path : Path
        Of the baseline.
    table : str
        Of the plant in it.

    Returns
    -------
    dict
        By name: value found, value held, and "as before", "better" or "worse". Less than the tolerance apart
        is as before; a smaller gamma is better, of all others a larger value.

    Raises
    ------
    InputError
        One line: no such table, a name or a number that is none.
    """
    held = read_toml(path)[1].get(table)
    if not isinstance(held, dict):
        raise InputError(f"{path}: no table [{table}]: write it with --write-baseline")
    compared = dict[str, tuple[float, float, str]]()
    tolerances = held.pop("tolerance", {})
    for name, value in held.items():
        share = tolerances.get(name, 0.0)
        if name not in found:
            raise InputError(f"{path}: [{table}] {name}: unknown ({meant(name, list(found), 'names')})")
        if not (isinstance(share, int | float) and isinstance(value, int | float) and 0 <= share < 1):
            raise InputError(f"{path}: [{table}] {name}: expected a number, and a tolerance from 0 to 1")
        within = value * (1 - share) <= found[name] <= value * (1 + share)
        better = found[name] < value if name == "gamma" else found[name] > value
        if within:
            verdict = "as before"
        elif better:
            verdict = "better"
        else:
            verdict = "worse"
        compared[name] = found[name], value, verdict
    forgotten = tolerances.keys() - held.keys()
    if forgotten:
        raise InputError(f"{path}: [{table}.tolerance] {min(forgotten)}: no such number in [{table}]")
    return compared


def write_baseline(path: Path, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the numbers of each plant into a baseline.

    path: of the file; found: numbers by plant. Tolerances, and what else is in the file, are kept; of a table
    that is there only the numbers it holds are written. Raises InputError.
    """
    document = tomlkit.parse(read_toml(path)[0] if path.exists() else _HEADER)
    for name, numbers in found.items():
        earlier = document.get(name, {})
        table = tomlkit.table()
        for key in [key for key in numbers if not earlier or key in earlier]:
            table.add(key, numbers[key] if isinstance(numbers[key], bool) else float(f"{numbers[key]:.6g}"))
        table.add("tolerance", earlier.get("tolerance", _TOLERANCES))
        document[name] = table
    storage.write_text(path, tomlkit.dumps(document))


def certify_controller(
    paths: Sequence[Path], file: DesignFile | None, files: CommandFiles, *, progress: Progress | None = None
) -> RunSummary:
    """Certify a controller for one or several plants (files: `workflow.tasks.design_source`), and hold its
    worst cases against a baseline; `certified` only where none is worse. file: None takes the specification
    of a run directory. Raises InputError."""
    controller = files.controller
    baseline = files.baseline
    written = files.write_baseline
    if controller is None and not paths[0].is_dir():
        raise InputError(f"{paths[0]}: no run directory, which has a controller: give --controller FILE")
    controller = controller or paths[0] / "controller.json"
    need(controller, baseline)
    storage.refuse_in_the_way([*paths, controller], [("--write-baseline", written)] if written else [])
    refuse_broken_files(paths, controller)

    # What is refused does not wait for what certifies: that takes seconds to load.
    from control_design.controllers.engineers_numbers import engineers_numbers
    from workflow.commands.design import at_one_bandwidth, load_asked, of_run
    from workflow.describe.certify import certify_sections
    from workflow.describe.design import guard_verdict
    from workflow.tasks.design import certify_asked
    from workflow.tasks.system_files import read_law

    # The plants, and the law in units of their quantities.
    progress = progress or Progress()
    progress.plan([("plants", 5.0), ("certify", 5.0)])
    with progress.stage("plants"):
        sources, asked, specification = load_asked(paths, file or DesignFile())
    specification = at_one_bandwidth(specification, of_run(paths))
    config = sources[0].config
    plants = [source.plant for source in sources]
    logged = sources[0].logged
    law = read_law(controller, plants[0].dt_s, specification.computational_delay_samples)
    if logged is not None:
        law = law.in_units(1 / np.array(logged.error), 1 / np.array(logged.command))
    elif "as logged" in law.signals:
        raise InputError(f"{controller}: in units of logged columns ({law.signals}): certify it with its run")
    with progress.stage("certify"), naming(str(controller)):
        done = certify_asked(
            law,
            plants,
            specification,
            asked.certificate,
            stage_rng(2006 if config is None else config.run.seed, "certify"),
            between_own_points=asked.plant.between_points,
        )
    assert done.certificate is not None

    # Worst cases beside the baseline; a new one is written only where all is certified.
    found = worst_cases(done.certificate, specification)
    held = {} if baseline is None else {name: against(found[name], baseline, name) for name in found}
    if written is not None and done.certified:
        write_baseline(written, found)
    worse = [
        (name, key, *told) for name, of in held.items() for key, told in of.items() if told[2] == "worse"
    ]
    doubts = [words(doubt) for doubt in done.certificate.warnings]
    numbers = engineers_numbers(law)
    return RunSummary(
        title=f"certificate of {controller}",
        sections=certify_sections(sources, law, done.certificate, found, held),
        numbers={
            "plants": [{"plant": source.plant.name, "origin": source.origin} for source in sources],
            "controller": str(controller),
            "engineers_numbers": None if numbers is None else numbers.to_dict(),
            "certificate": codec.plain(done.certificate),
            "certificate_conditions": doubts,
            "certified": done.certified,
            "worst_cases": found,
            "baseline": {
                name: {
                    key: dict(zip(("value", "held", "verdict"), told, strict=True))
                    for key, told in of.items()
                }
                for name, of in held.items()
            },
        },
        certified=done.certified and not worse,
        verdict=guard_verdict(done, worse, baseline, written, ". Also, ".join(doubts)),
    )
