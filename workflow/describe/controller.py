"""A controller in an engineer's numbers, and the crossovers of its loop."""

from __future__ import annotations

import math

from control_design.analysis.certificate import PlantVerdict
from control_design.controllers.engineers_numbers import ControllerNumbers
from workflow.describe.facts import Block, Heading, Row, Section, Table, said, worded
from workflow.text.formats import both_frequencies, count, decibels, frequency, margin, sentence, si


def controller_section(numbers: ControllerNumbers | None, delay_samples: int, signals: str = "") -> Section:
    """Factors of a controller.

    Args:
        numbers: None: it has no such factors.
        delay_samples: Computational delay.
        signals: Columns and units of its files, where they are not plain.
    """
    if numbers is None:
        return Section("controller")
    delay = "none"
    if delay_samples:
        delay = (
            f"{count(delay_samples, 'sample')}, not in these numbers: the machine adds it (K_without_delay "
            "of the files; margins are those of K_with_delay)"
        )
    return Section(
        "controller",
        said(
            worded("structure", numbers.structure),
            *(worded(name, values) for name, values in numbers.rows()),
            worded("computational delay", delay),
            worded("units", signals),
        ),
    )


def pid_row(numbers: ControllerNumbers | None) -> Row | None:
    """A PID in one line; None for another controller."""
    if numbers is None or numbers.pid is None:
        return None
    return worded("controller", "; ".join(f"{name} {values}" for name, values in numbers.rows()))


def crossover_rows(plant: PlantVerdict) -> tuple[Row, ...]:
    """Every gain crossover with phase and delay margin, every phase crossover with its gain margin."""
    if plant.crossovers is None:
        return ()
    rows = []
    for each in plant.crossovers.gain:
        phase = margin(math.degrees(each.phase_margin_rad), 4)
        delay = margin(1000 * each.delay_margin_s, 4)
        text = f"{frequency(each.omega_rad_s, 4)}: phase margin {phase} deg, delay margin {delay} ms"
        rows.append(worded("gain crossover", text))
    for crossing in plant.crossovers.phase:
        may = "rise by" if crossing.gain_margin > 1 else "fall to"
        gain = decibels(crossing.gain_margin, crossing.gain_margin > 1)
        rows.append(worded("phase crossover", f"{frequency(crossing.omega_rad_s, 4)}: gain may {may} {gain}"))
    return tuple(rows)


def crossover_table(plant: PlantVerdict) -> list[Block]:
    """Every crossover of the loop of a plant for a page; nothing where there is none."""
    crossovers = plant.crossovers
    if crossovers is None or not (crossovers.gain or crossovers.phase):
        return []
    rows = []
    for each in crossovers.gain:
        phase = margin(math.degrees(each.phase_margin_rad))
        found = f"phase margin {phase} deg, delay margin {margin(1000 * each.delay_margin_s)} ms"
        rows.append(("gain", both_frequencies(each.omega_rad_s), found))
    for crossing in crossovers.phase:
        rises = crossing.gain_margin > 1
        gain = f"gain may {'rise by' if rises else 'fall to'} {decibels(crossing.gain_margin, rises)}"
        rows.append(("phase", both_frequencies(crossing.omega_rad_s), gain))
    head = ("crossover", "at [rad/s (Hz)]", "margin")
    caption = f"{plant.plant}: every crossover at the centres of the ellipses."
    if any(each.phase_margin_rad < 0 for each in crossovers.gain):
        caption += " A negative phase margin: so much lead brings the loop to -1."
    return [Table(head, tuple(rows), caption)]


def controller_blocks(
    numbers: ControllerNumbers | None, delay_samples: int, signals: str = ""
) -> list[Block]:
    """The controller in an engineer's numbers for a page; nothing where it has no such factors."""
    if numbers is None:
        return []
    law = "Factors in series, each of static gain 1"
    if numbers.pid is not None:
        law = "Kp (1 + 1/(Ti s) + Td s/(Tf s + 1)), notches and low-passes in series"
    delay = "There is no computational delay."
    if delay_samples:
        delay = "These are the numbers of K_without_delay."
    units = f" {sentence(signals)}" if signals else ""
    caption = (
        f"{law}; s = (2/dt)(z - 1)/(z + 1), dt = {si(numbers.dt_s, 's', 6)}. Frequencies are those of the "
        f"discrete controller. {delay}{units} Files hold all digits "
        "(engineers_numbers in controller.json, constants in controller.h)."
    )
    return [
        Heading(f"The controller in numbers: {numbers.structure}", "numbers-of-the-controller"),
        Table(("factor", "values"), tuple(numbers.rows()), caption),
    ]
