"""What `flexlink certify` says of a controller that was there before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from control_design.analysis.certificate import Certificate
from control_design.controllers.controller import Controller
from control_design.controllers.engineers_numbers import engineers_numbers
from workflow.describe.controller import controller_section, crossover_rows
from workflow.describe.facts import Row, Section, said, worded
from workflow.tasks.design_source import DesignSource
from workflow.text.formats import bound, count, si
from workflow.text.sentences.certificate import limited_loops

# Every number of `worst_cases` with its name; of several plants the worst value is shown.
_NAMES = {
    "gamma": "largest weighted worst case",
    "modulus_margin": "modulus margin",
    "gain_margin_dB": "gain margin [dB]",
    "phase_margin_deg": "phase margin [deg]",
    "delay_margin_s": "delay margin [s]",
    "bandwidth_rad_s": "bandwidth [rad/s]",
    "least_mode_damping": "least damping of a mode",
}


def certify_sections(
    sources: Sequence[DesignSource],
    law: Controller,
    certificate: Certificate,
    found: Mapping[str, Mapping[str, Any]],
    held: Mapping[str, Mapping[str, tuple[float, float, str]]],
) -> list[Section]:
    """The certificate of a controller, of several plants the worst value of each number.

    Args:
        sources: The plants.
        law: The controller.
        certificate: Of the controller on these plants.
        found: Worst cases by plant and name.
        held: By plant and name: the value found, that of the baseline, and how it stands.
    """
    origins = ", ".join(f"{source.plant.name}: {source.origin}" for source in sources)
    several = len(sources) > 1
    remarks = [
        worded("", f"{source.plant.name}: {remark}" if several else remark)
        for source in sources
        for remark in source.remarks
    ]
    delay = count(law.computational_delay_samples, "sample")
    states = count(law.order, "state")
    rows = [
        worded("plants", origins),
        *remarks,
        worded("controller", f"{states}, every {si(law.dt_s, 's', 4)}, delay {delay}"),
        *(_worst_row(name, found, held) for name in _NAMES),
        worded("at the limits", limited_loops(certificate)),
    ]
    crossovers = tuple(row for plant in certificate.plants for row in crossover_rows(plant))
    parts = (
        Section("crossovers", crossovers),
        controller_section(engineers_numbers(law), law.computational_delay_samples),
    )
    return [Section("certificate", said(*rows), parts=parts)]


def _worst_row(
    name: str,
    found: Mapping[str, Mapping[str, Any]],
    held: Mapping[str, Mapping[str, tuple[float, float, str]]],
) -> Row:
    """A number on the plant where it is worst, beside the baseline's where there is one."""
    is_margin = name != "gamma"
    worst = min if is_margin else max
    plant = worst(found, key=lambda plant: found[plant][name])
    text = bound(found[plant][name], is_margin)
    if len(found) > 1:
        text += f" ({plant})"
    if name in held.get(plant, {}):
        _, before, stands = held[plant][name]
        text += f"; baseline {bound(before, is_margin)}: {'WORSE' if stands == 'worse' else stands}"
    return worded(_NAMES[name], text)
