"""One case from numbers to files: diagnosis, where, next experiment, controller, JSON, page, repaired rig."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomlkit

from diagnosis.answer import Diagnosis
from diagnosis.machine.telling import telling
from diagnosis.where.where import where, where_in_records
from plant.rig import Rig
from workflow.describe.diagnosis_view import DiagnosisView, moved, shown
from workflow.diagnose.advice import advice_words
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.check import of_case
from workflow.diagnose.directory import answer_text
from workflow.diagnose.document import completeness_of, document_of
from workflow.diagnose.following import following
from workflow.diagnose.pages import case_page, plant_page, remains_of
from workflow.diagnose.simulator_case import SimulatorCase, with_units
from workflow.engine import codec, storage
from workflow.engine.errors import naming
from workflow.engine.executor import Report
from workflow.tasks.controller_check import ControllerCheck, NoControllerError, check_controller

# Longest time for what records can tell [s]. Chosen: short beside a diagnosis, which is what was asked for.
_TELLING_S = 10.0
# What comes behind the diagnosis takes about so much of a case's time, for the progress bar only.
_DIAGNOSED = 0.8
# Below this probability that nothing else remains, something else is there as likely as not.
_COMPLETE = 0.5


def files_of(
    loaded: LoadedCase | SimulatorCase,
    made_from: Mapping[str, Any],
    diagnose: Callable[..., Diagnosis],
    report: Report,
    out: Path = Path(),
) -> tuple[dict[str, bytes], float]:
    """File name -> content of one case, and the CPU time of the process so far [s].

    made_from: what the answer depends on (equal entries, equal answer); of its `options` `controller` says
    whether the controllers are compared. diagnose: `diagnosis.diagnose` with the others. out: folder of the
    files. The JSON file names the others' hashes and is to be written last. Raises InputError or StageError,
    one line.
    """
    name = loaded.case.name
    with naming(f"case {name}"):
        diagnosis = diagnose(loaded.case, progress=lambda f, m: report(_DIAGNOSED * f, m))
    if isinstance(loaded, SimulatorCase):
        # What the logs themselves make doubtful comes before what the fit does.
        diagnosis = replace(diagnosis, doubts=(*loaded.doubts, *diagnosis.doubts))
        diagnosis = with_units(diagnosis, loaded.units)
        with naming(f"case {name}"):
            beside, files = _of_simulator(loaded, diagnosis, out)
    else:
        beside, files = _of_rig(loaded, diagnosis, made_from["options"]["controller"], report)
    # Hashes of the other files: a case counts as done where all of them are as they were written.
    document = document_of(loaded, diagnosis, beside)
    document["made_from"] = made_from
    document["files"] = {name: storage.sha256_of_bytes(content) for name, content in files.items()}
    return {**files, f"{name}.json": answer_text(document).encode()}, time.process_time()


def _of_rig(
    loaded: LoadedCase, diagnosis: Diagnosis, controller: bool, report: Report
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What the answer says beside the diagnosis, and the files beside the answer."""
    case = loaded.case
    with naming(f"case {case.name}"):
        report(_DIAGNOSED, "where")
        place = where(diagnosis.case, diagnosis.residuals_refit, diagnosis.probabilities)
        remains = remains_of(diagnosis)
        report(_DIAGNOSED, "next experiment")
        coming = following(diagnosis)
        advice = advice_words(shown(diagnosis), coming)
        report(_DIAGNOSED, "controller")
        check, no_check = _control(diagnosis) if controller else (None, "not_asked")
    rig_name = f"{case.name}.rig.toml"
    effects_name = f"{case.name}.effects.toml"
    effects = effects_text(diagnosis) if diagnosis.repair else ""
    moved_values = moved(diagnosis, diagnosis.deviations)
    rig = rig_text(case.name, case.rig, diagnosis.rig, moved_values, effects_name if effects else "")
    html = case_page(
        DiagnosisView(diagnosis, place, remains),
        loaded,
        coming,
        advice,
        check=check,
        no_check=no_check,
        rig_text=rig,
        effects_text=effects,
        progress=lambda share, what: report(_DIAGNOSED + (1 - _DIAGNOSED) * share, f"drawing {what}"),
    )
    files = {f"{case.name}.html": html.encode(), rig_name: rig.encode()}
    if effects:
        files[effects_name] = effects.encode()
    if coming.proposal is not None and coming.proposal.separates:
        files[f"{case.name}.next.csv"] = coming.csv_text().encode()
    next_experiment = {"advice": coming.advice, "words": advice, **codec.plain(coming.proposal or {})}
    beside = {
        "where": place,
        "remains": remains,
        "completeness": completeness_of(diagnosis, remains),
        "next_experiment": next_experiment,
        "controller": {"skipped": no_check} if check is None else check.document(),
    }
    return beside, files


def _of_simulator(
    loaded: SimulatorCase, diagnosis: Diagnosis, out: Path
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What the answer says beside the diagnosis of a simulation, and the files beside the answer."""
    name = loaded.case.name
    files: dict[str, bytes] = {}
    coming = following(diagnosis)
    advice = advice_words(shown(diagnosis), coming)
    place = where_in_records(diagnosis.case, diagnosis.residuals_refit, diagnosis.case.dt_s)
    remains = remains_of(diagnosis)
    record_check = of_case(loaded, telling(loaded.case, time.monotonic() + _TELLING_S))
    if loaded.repaired is not None:
        files[f"{name}.xml"] = loaded.repaired(diagnosis, out).encode()
    page = plant_page(diagnosis, advice, record_check, loaded.model_error, *files, places=(place, remains))
    files[f"{name}.html"] = page.encode()
    next_experiment = {"advice": coming.advice, "words": advice, **codec.plain(coming.repeat or {})}
    # What records can tell advises more records, whatever the answer; the answer has its own advice.
    check = {key: value for key, value in record_check.numbers.items() if key != "advice"}
    beside = {
        "where": place,
        "remains": remains,
        "completeness": completeness_of(diagnosis, remains),
        "next_experiment": next_experiment,
        "check": check,
    }
    return beside, files


def _control(diagnosis: Diagnosis) -> tuple[ControllerCheck | None, str]:
    """The check, or why there is none: a key that `rig_page` words, or a sentence of the design."""
    if diagnosis.verdict == "none":
        return None, "no_gap"
    # A controller is not worth comparing between two models of which neither is likely the machine.
    incomplete = diagnosis.completeness.probability < _COMPLETE
    if diagnosis.verdict == "unknown" or incomplete or diagnosis.detail_verdict == "not_converged":
        return None, "not_explained"
    try:
        return check_controller(diagnosis.case, diagnosis.rig, diagnosis.repair), ""
    except NoControllerError as error:
        return None, str(error)


def rig_text(
    case: str, stated: Rig, repaired: Rig, deviations: Mapping[str, float], effects_file: str
) -> str:
    """A rig file that `Rig.from_toml` reads back as `repaired`.

    The head names every moved value with how far it moved; effects_file is empty where there are no effects.
    """
    head = [f"# {case}: rig as repaired by flexlink diagnose"]
    for key, tolerances in deviations.items():
        old = stated.value(key)
        new = repaired.value(key)
        if old != new:
            percent = 100 * (new / old - 1) if old else 0.0
            head.append(
                f"#   {key}: {old:.6g} stated, {new:.6g} now ({percent:+.2f} %, {tolerances:+.2f} tolerances)"
            )
    if effects_file:
        head.append(f"# The effects to add stand in {effects_file}.")
    return "\n".join([*head, repaired.to_toml()])


def effects_text(diagnosis: Diagnosis) -> str:
    """The effects as [[effects]] tables, in the spelling of [[source.effects]] in a run configuration."""
    tables = tomlkit.dumps({"effects": [effect.to_dict() for effect in diagnosis.repair]})
    origin = "found by flexlink diagnose"
    if diagnosis.partial_model:
        origin = "with which flexlink diagnose leaves less; the cause is not known"
    case = diagnosis.case.name
    head = f"# {case}: effects {origin}; in a run configuration they go under [[source.effects]]"
    return f"{head}\n\n{tables}"
