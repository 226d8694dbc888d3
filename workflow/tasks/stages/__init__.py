"""The stages of a run before its page, in order.

What each leaves behind is a type of `workflow.tasks.results`.
"""

from __future__ import annotations

from workflow.tasks.stages import (
    achievable_performance,
    certify,
    closed_loop,
    design,
    identify,
    records,
    reference_filter,
    uncertainty,
)
from workflow.tasks.stages.base import Stage, StageInput

__all__ = ["STAGES", "Stage", "StageInput"]

STAGES: tuple[Stage, ...] = (
    Stage("records", (), records.settings, records.make_records, expected_s=1.0),
    Stage("identify", ("records",), identify.settings, identify.identify_channels, expected_s=2.0),
    Stage(
        "uncertainty",
        ("records", "identify"),
        uncertainty.settings,
        uncertainty.find_uncertainty,
        expected_s=2.0,
    ),
    Stage("design", ("identify", "uncertainty"), design.settings, design.design_controller, expected_s=15.0),
    Stage(
        "achievable_performance",
        ("identify", "uncertainty"),
        achievable_performance.settings,
        achievable_performance.find_achievable,
        expected_s=2.5,
    ),
    Stage(
        "certify",
        ("identify", "uncertainty", "design"),
        certify.settings,
        certify.certify_controller,
        expected_s=1.0,
    ),
    Stage(
        "reference_filter",
        ("identify", "uncertainty", "design", "certify"),
        reference_filter.settings,
        reference_filter.design_filter,
        expected_s=0.1,
    ),
    Stage(
        "closed_loop",
        ("records", "identify", "uncertainty", "design", "certify", "reference_filter"),
        closed_loop.settings,
        closed_loop.run_closed_loop,
        expected_s=5.0,
    ),
)
