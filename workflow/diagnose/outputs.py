"""One case from numbers to files: diagnosis, where, next experiment, controller, JSON, page, repaired rig."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from diagnosis.diagnosis import Diagnosis, diagnose
from diagnosis.machine.case import Case
from diagnosis.where.where import where
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.controller_check import ControllerCheck, NoControllerError, check_controller
from workflow.diagnose.document import document_of
from workflow.diagnose.following import following
from workflow.diagnose.page import CasePage, case_page
from workflow.diagnose.repaired_rig import effects_text, rig_text
from workflow.engine import codec, storage
from workflow.engine.errors import naming
from workflow.engine.executor import Report

# Shares of a case's time, for the progress bar only.
_ENGINE, _WHERE, _NEXT, _CONTROLLER = 0.75, 0.8, 0.85, 0.9


class Engine:
    """What computes a diagnosis; tests put a quick one in its place."""

    def __call__(self, case: Case, *, progress: Report | None = None) -> Diagnosis:
        return diagnose(case, progress=progress)


@dataclass(frozen=True, eq=False)
class Work:
    """One case to do, here or in a process of its own. controller: whether the controllers are compared."""

    loaded: LoadedCase
    controller: bool
    code_sha256: str
    engine: Engine

    @property
    def made_from(self) -> dict[str, Any]:
        """What the answer depends on: equal entries, equal answer."""
        return {
            "input_sha256": self.loaded.input_sha256,
            "code_sha256": self.code_sha256,
            "options": {"controller": self.controller},
        }

    def run(self, report: Report) -> tuple[dict[str, bytes], float]:
        """File name -> content, and the CPU time of the process so far [s].

        The JSON file names the others' hashes and is to be written last. Raises InputError or StageError, one
        line.
        """
        loaded, case = self.loaded, self.loaded.case
        with naming(f"case {case.name}"):
            found = self.engine(case, progress=lambda f, m: report(_ENGINE * f, m))
            report(_ENGINE, "where")
            place = where(case, found.residuals_refit, found.probabilities)
            remains = where(case, found.residuals_after)
            report(_WHERE, "next experiment")
            coming = following(found)
            report(_NEXT, "controller")
            check, no_check = _control(found) if self.controller else (None, "not_asked")
        rig_name, effects_name = f"{case.name}.rig.toml", f"{case.name}.effects.toml"
        effects = effects_text(case.name, found.repair) if found.repair else ""
        rig = rig_text(case.name, case.rig, found.rig, found.deviations, effects_name if effects else "")
        html = case_page(
            CasePage(loaded, found, place, remains, coming, check, no_check, rig, effects),
            lambda f, m: report(_CONTROLLER + (1 - _CONTROLLER) * f, f"drawing {m}"),
        )
        files = {f"{case.name}.html": html.encode(), rig_name: rig.encode()}
        if effects:
            files[effects_name] = effects.encode()
        if coming.proposal is not None and coming.proposal.separates:
            files[f"{case.name}.next.csv"] = coming.csv_text().encode()
        document = document_of(
            loaded, found, where=place, remains=remains, coming=coming, check=check, no_check=no_check
        )
        document["made_from"] = self.made_from
        document["files"] = {name: storage.sha256_of_bytes(content) for name, content in files.items()}
        files[f"{case.name}.json"] = codec.plain_text(document).encode()
        return files, time.process_time()


def _control(found: Diagnosis) -> tuple[ControllerCheck | None, str]:
    """The check, or why there is none: a reason of ours (the page's templates know it) or of the design."""
    if found.verdict == "none":
        return None, "no_gap"
    if found.verdict == "unknown" or found.detail_verdict == "not_converged":
        return None, "not_explained"
    try:
        return check_controller(found.case, found.rig, found.repair), ""
    except NoControllerError as error:
        return None, str(error)
