"""One case from numbers to files: diagnosis, where, next experiment, controller, JSON, page, repaired rig."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomlkit

from diagnosis.answer import Diagnosis
from diagnosis.machine.telling import telling
from diagnosis.where.where import where, where_in_records
from plant.rig import Rig
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.check import of_case
from workflow.diagnose.controller_check import ControllerCheck, NoControllerError, check_controller
from workflow.diagnose.directory import answer_text
from workflow.diagnose.document import completeness_of, document_of
from workflow.diagnose.following import following
from workflow.diagnose.pages import CasePage, case_page, moved, plant_page, remains_of
from workflow.diagnose.simulator_case import SimulatorCase, with_units
from workflow.engine import codec, storage
from workflow.engine.errors import naming
from workflow.engine.executor import Report
from workflow.text.templates import render_text

# Seconds for what records can tell.
_TOLD_S = 10.0
# Shares of a case's time, for the progress bar only.
_DIAGNOSED, _WHERE, _NEXT, _CONTROLLER = 0.75, 0.8, 0.85, 0.9


@dataclass(frozen=True, eq=False)
class Work:
    """One case to do. made_from: what the answer depends on (equal entries, equal answer); of its `options`
    `controller` says whether the controllers are compared. diagnose: `diagnosis.diagnose` with the others.
    out: folder of the files."""

    loaded: LoadedCase | SimulatorCase
    made_from: Mapping[str, Any]
    diagnose: Callable[..., Diagnosis]
    out: Path = Path()

    def run(self, report: Report) -> tuple[dict[str, bytes], float]:
        """File name -> content, and the CPU time of the process so far [s].

        The JSON file names the others' hashes and is to be written last. Raises InputError or StageError, one
        line.
        """
        if isinstance(self.loaded, SimulatorCase):
            return self._of_simulator(self.loaded, report)
        loaded, case = self.loaded, self.loaded.case
        with naming(f"case {case.name}"):
            found = self.diagnose(case, progress=lambda f, m: report(_DIAGNOSED * f, m))
            report(_DIAGNOSED, "where")
            place = where(found.case, found.residuals_refit, found.probabilities)
            remains = remains_of(found)
            report(_WHERE, "next experiment")
            coming = following(found)
            report(_NEXT, "controller")
            check, no_check = (
                _control(found) if self.made_from["options"]["controller"] else (None, "not_asked")
            )
        rig_name, effects_name = f"{case.name}.rig.toml", f"{case.name}.effects.toml"
        effects = effects_text(found) if found.repair else ""
        rig = rig_text(
            case.name, case.rig, found.rig, moved(found, found.deviations), effects_name if effects else ""
        )
        html = case_page(
            CasePage(loaded, found, place, remains, coming, check, no_check, rig, effects),
            lambda f, m: report(_CONTROLLER + (1 - _CONTROLLER) * f, f"drawing {m}"),
        )
        files = {f"{case.name}.html": html.encode(), rig_name: rig.encode()}
        if effects:
            files[effects_name] = effects.encode()
        if coming.proposal is not None and coming.proposal.separates:
            files[f"{case.name}.next.csv"] = coming.csv_text().encode()
        beside = {
            "where": place,
            "remains": remains,
            "completeness": completeness_of(found, remains),
            "next_experiment": {"advice": coming.advice, **codec.plain(coming.proposal or {})},
            "controller": {"skipped": no_check} if check is None else check.document(),
        }
        return self._with_document(loaded, found, beside, files), time.process_time()

    def _of_simulator(self, loaded: SimulatorCase, report: Report) -> tuple[dict[str, bytes], float]:
        name = loaded.case.name
        with naming(f"case {name}"):
            found = self.diagnose(loaded.case, progress=lambda f, m: report(_CONTROLLER * f, m))
            found = with_units(replace(found, doubts=(*loaded.doubts, *found.doubts)), loaded.units)
            coming = following(found)
            place, remains = (
                where_in_records(found.case, found.residuals_refit, found.case.dt_s),
                remains_of(found),
            )
            told = of_case(loaded, telling(loaded.case, time.monotonic() + _TOLD_S))
            files = {}
            if loaded.repaired is not None:
                files[f"{name}.xml"] = loaded.repaired(found, self.out).encode()
            files[f"{name}.html"] = plant_page(
                found, coming, told, loaded.model_error, *files, places=(place, remains)
            ).encode()
        beside = {
            "where": place,
            "remains": remains,
            "completeness": completeness_of(found, remains),
            "next_experiment": {"advice": coming.advice, **codec.plain(coming.repeat or {})},
            "check": told.numbers,
        }
        return self._with_document(loaded, found, beside, files), time.process_time()

    def _with_document(
        self,
        loaded: LoadedCase | SimulatorCase,
        found: Diagnosis,
        beside: Mapping[str, Any],
        files: dict[str, bytes],
    ) -> dict[str, bytes]:
        document = document_of(loaded, found, beside)
        document["made_from"] = self.made_from
        document["files"] = {name: storage.sha256_of_bytes(content) for name, content in files.items()}
        return {**files, f"{loaded.case.name}.json": answer_text(document).encode()}


def _control(found: Diagnosis) -> tuple[ControllerCheck | None, str]:
    """The check, or why there is none: a reason of ours (the page's templates know it) or of the design."""
    if found.verdict == "none":
        return None, "no_gap"
    incomplete = found.completeness.probability < 0.5
    if found.verdict == "unknown" or incomplete or found.detail_verdict == "not_converged":
        return None, "not_explained"
    try:
        return check_controller(found.case, found.rig, found.repair), ""
    except NoControllerError as error:
        return None, str(error)


def rig_text(
    case: str, stated: Rig, repaired: Rig, deviations: Mapping[str, float], effects_file: str
) -> str:
    """A rig file that `Rig.from_toml` reads back as `repaired`.

    The head names every moved value with how far it moved; effects_file is empty where there are no effects.
    """
    moved = []
    for key, tolerances in deviations.items():
        old, new = stated.value(key), repaired.value(key)
        if old != new:
            moved.append((key, old, new, 100 * (new / old - 1) if old else 0.0, tolerances))
    toml = repaired.to_toml()
    return render_text("diagnosis/rig.toml.j2", case=case, moved=moved, effects_file=effects_file, toml=toml)


def effects_text(found: Diagnosis) -> str:
    """The effects as [[effects]] tables, in the spelling of [[source.effects]] in a run configuration."""
    tables = tomlkit.dumps({"effects": [effect.to_dict() for effect in found.repair]})
    cause = not found.partial_model
    return render_text("diagnosis/effects.toml.j2", case=found.case.name, cause=cause, toml=tables)
