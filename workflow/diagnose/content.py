"""What the page of one case is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from diagnosis.diagnosis import Diagnosis
from diagnosis.where.where_records import Where
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.controller_check import ControllerCheck
from workflow.diagnose.following import Following


@dataclass(frozen=True, eq=False)
class CasePage:
    """Everything the page is made of; the documents stand in the JSON file as well.

    where: of the gap that is left when the stated values are moved within their tolerances; remains: of what
    the effects leave. check is None where there was nothing to compare, control says why.
    """

    loaded: LoadedCase
    found: Diagnosis
    where: Where
    remains: Where
    next_experiment: Following
    control: Mapping[str, Any]
    check: ControllerCheck | None
    rig_text: str
    effects_text: str

    @property
    def models(self) -> tuple[str, ...]:
        """Models to compare: values are moved where there are tolerances, effects where any were found."""
        moved = ("refit",) if self.found.deviations else ()
        return ("stated", *moved, *(("repaired",) if self.found.combination else ()))
