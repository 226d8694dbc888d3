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
# Of the random starts where no run states one. Any number: it is fixed so that results repeat.
_SEED = 2006
# Head of a baseline that is written for the first time.
_HEADER = """\
# Worst cases and margins over the uncertainty set, by plant. No certificate may be worse by more than its
# tolerance (relative). Made by: flexlink certify ... --write-baseline FILE
"""


def worst_cases(certificate: Certificate, specification: Specification) -> dict[str, dict[str, Any]]:
    """Worst cases over the uncertainty set of each plant, in the units of their names.

    Parameters
    ----------
    certificate : Certificate
    specification : Specification
        Its band of the damping requirement, where there is one, limits the modes that count.

    Returns
    -------
    dict
        By plant, by name. `least_mode_damping` is that of the nominal loop's modes, 1 without any.
    """
    low, high = specification.mode_band_rad_s or (0.0, math.inf)
    numbers_by_plant: dict[str, dict[str, Any]] = {}
    for verdict in certificate.plants:
        margins = verdict.worst_margins
        zetas = [mode.zeta for mode in verdict.closed_loop_modes if low <= mode.omega_rad_s <= high]
        numbers_by_plant[verdict.plant] = {
            "certified": certificate.certified,
            "gamma": verdict.worst_weighted,
            "modulus_margin": margins.modulus,
            "gain_margin_dB": 20 * math.log10(margins.gain_up),
            "phase_margin_deg": math.degrees(margins.phase_rad),
            "delay_margin_s": margins.delay_s,
            "bandwidth_rad_s": verdict.bandwidth_rad_s,
            "least_mode_damping": min(zetas, default=1.0),
        }
    return numbers_by_plant


def against(numbers: Mapping[str, Any], path: Path, table: str) -> dict[str, tuple[float, float, str]]:
    """Numbers of a plant beside those of a baseline.

    Parameters
    ----------
    numbers : mapping of str to number
        Numbers of the plant's certificate.
    path : Path
        Of the baseline.
    table : str
        Of the plant in it.

    Returns
    -------
    dict
        By name: value of the certificate, value of the baseline, and "as before", "better" or "worse". Less
        than the tolerance apart is as before; a smaller gamma is better, of all others a larger value.

    Raises
    ------
    InputError
        One line: no such table, a name or a number that is none.
    """
    baseline = read_toml(path)[1].get(table)
    if not isinstance(baseline, dict):
        raise InputError(f"{path}: no table [{table}]: write it with --write-baseline")
    compared = dict[str, tuple[float, float, str]]()
    tolerances = baseline.pop("tolerance", {})
    for name, value in baseline.items():
        share = tolerances.get(name, 0.0)
        if name not in numbers:
            raise InputError(f"{path}: [{table}] {name}: unknown ({meant(name, list(numbers), 'names')})")
        if not (isinstance(share, int | float) and isinstance(value, int | float) and 0 <= share < 1):
            raise InputError(f"{path}: [{table}] {name}: expected a number, and a tolerance from 0 to 1")
        number = numbers[name]
        is_better = number < value if name == "gamma" else number > value
        if value * (1 - share) <= number <= value * (1 + share):
            verdict = "as before"
        elif is_better:
            verdict = "better"
        else:
            verdict = "worse"
        compared[name] = number, value, verdict
    # A tolerance of no number is a misspelt name: its number would be held to the last digit.
    forgotten = tolerances.keys() - baseline.keys()
    if forgotten:
        raise InputError(f"{path}: [{table}.tolerance] {min(forgotten)}: no such number in [{table}]")
    return compared


def write_baseline(path: Path, numbers_by_plant: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the numbers of each plant into a baseline.

    Tolerances, and what else is in the file, are kept; of a table that is there only the numbers it holds are
    written: what somebody took out is not to be compared. Raises InputError.
    """
    document = tomlkit.parse(read_toml(path)[0] if path.exists() else _HEADER)
    for name, numbers in numbers_by_plant.items():
        earlier = document.get(name, {})
        table = tomlkit.table()
        for key, number in numbers.items():
            if earlier and key not in earlier:
                continue
            # Six digits, far below any tolerance: others change from machine to machine.
            table.add(key, number if isinstance(number, bool) else float(f"{number:.6g}"))
        table.add("tolerance", earlier.get("tolerance", _TOLERANCES))
        document[name] = table
    storage.write_text(path, tomlkit.dumps(document))


def certify_controller(
    paths: Sequence[Path], file: DesignFile | None, files: CommandFiles, *, progress: Progress | None = None
) -> RunSummary:
    """Certify a controller for one or several plants, and hold its worst cases against a baseline.

    Parameters
    ----------
    paths : sequence of Path
        Of the plants, as in `workflow.tasks.design_source`; a single run directory has a controller, too.
    file : DesignFile or None
        None takes the specification of a run directory.
    files : CommandFiles
        Controller, baseline, and where a new baseline is to be written.
    progress : Progress, optional

    Returns
    -------
    RunSummary
        `certified` only where no number is worse than that of the baseline.

    Raises
    ------
    InputError
    """
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
            stage_rng(_SEED if config is None else config.run.seed, "certify"),
            between_own_points=asked.plant.between_points,
        )
    assert done.certificate is not None

    # Worst cases beside the baseline; a new one is written only where all is certified.
    worst = worst_cases(done.certificate, specification)
    compared: dict[str, dict[str, tuple[float, float, str]]] = {}
    if baseline is not None:
        compared = {plant: against(numbers, baseline, plant) for plant, numbers in worst.items()}
    if written is not None and done.certified:
        write_baseline(written, worst)
    worse = []
    comparisons: dict[str, dict[str, dict[str, Any]]] = {}
    for plant, by_name in compared.items():
        comparisons[plant] = {}
        for name, (value, held, verdict) in by_name.items():
            comparisons[plant][name] = {"value": value, "held": held, "verdict": verdict}
            if verdict == "worse":
                worse.append((plant, name, value, held, verdict))
    doubts = [words(doubt) for doubt in done.certificate.warnings]
    numbers = engineers_numbers(law)
    return RunSummary(
        title=f"certificate of {controller}",
        sections=certify_sections(sources, law, done.certificate, worst, compared),
        numbers={
            "plants": [{"plant": source.plant.name, "origin": source.origin} for source in sources],
            "controller": str(controller),
            "engineers_numbers": None if numbers is None else numbers.to_dict(),
            "certificate": codec.plain(done.certificate),
            "certificate_conditions": doubts,
            "certified": done.certified,
            "worst_cases": worst,
            "baseline": comparisons,
        },
        certified=done.certified and not worse,
        verdict=guard_verdict(done, worse, baseline, written, ". Also, ".join(doubts)),
    )
