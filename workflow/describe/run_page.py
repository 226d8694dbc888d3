"""The page of a run: what it begins with, and its sections in their order."""

from __future__ import annotations

from workflow.describe.certificate import margins_page, unchecked_page
from workflow.describe.closed_loop import closed_loop_page
from workflow.describe.design import design_page
from workflow.describe.facts import FirstScreen, PageSection
from workflow.describe.first_screen import first_screen
from workflow.describe.identification import identification_page
from workflow.describe.records import distortion_page, records_page, reproduce_page, rig_page
from workflow.describe.uncertainty import uncertainty_page
from workflow.figures.subjects import RunView


def page_of_run(view: RunView, *, is_design: bool = False) -> tuple[FirstScreen, list[PageSection]]:
    """First screen and sections of the page of a run of one loop.

    Args:
        view: The run.
        is_design: The page is of `flexlink design`; it stands away from the run's files and names none.
    """
    sections = [
        margins_page(view, is_design=is_design),
        closed_loop_page(view),
        unchecked_page(view.results),
        design_page(view),
        identification_page(view),
        uncertainty_page(view),
        records_page(view),
        distortion_page(view.control),
        rig_page(view.config.notes),
        reproduce_page(view, is_design=is_design),
    ]
    return first_screen(view), sections
