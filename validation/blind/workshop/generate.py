"""Workshop cases by number: which sort, sensor and loop each is, and its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from validation.blind.workshop.answer import Sort
from validation.blind.workshop.cases import make_case
from validation.blind.workshop.files import write_workshop_case
from validation.blind.workshop.machine import SENSORS, Sensor
from validation.blind.workshop.sizes import listed, unlisted

SHARES: dict[Sort, float] = {"none": 0.25, "single": 0.4, "pair": 0.2, "unlisted": 0.15}


@dataclass(frozen=True)
class WorkshopPlan:
    """closed_loop: wholly. first_effect: tried before others, empty without one."""

    sort: Sort
    sensor: Sensor
    closed_loop: bool
    first_effect: str


def workshop_schedule(n_cases: int, rng: np.random.Generator, only: Sort | None = None) -> list[WorkshopPlan]:
    """Plans with the shares of the sorts; sensors and loops in turn, every effect before one comes twice."""
    if n_cases < 1:
        raise ValueError(f"the number of cases must be at least 1; got {n_cases}")
    mix = SHARES if only is None else {only: 1.0}
    wanted = {sort: share * n_cases for sort, share in mix.items()}
    sorts = [sort for sort, number in wanted.items() for _ in range(int(number + 1e-9))]
    sorts += sorted(wanted, key=lambda sort: -((wanted[sort] + 1e-9) % 1))[: n_cases - len(sorts)]
    places: list[tuple[Sensor, bool]] = [(sensor, loop) for sensor in SENSORS for loop in (False, True)]
    begin = int(rng.integers(len(places)))
    decks: dict[Sort, list[str]] = {}
    plans = []
    for k, sort in enumerate(sorts):
        sensor, closed = places[(begin + k) % len(places)]
        plans.append(
            WorkshopPlan(sort, sensor, closed, _dealt(decks.setdefault(sort, []), sort, sensor, rng))
        )
    return [plans[i] for i in rng.permutation(n_cases)]


def _dealt(deck: list[str], sort: Sort, sensor: Sensor, rng: np.random.Generator) -> str:
    """Next effect of a deck that these sensors can show; a deck without one is filled up."""
    if sort == "none":
        return ""
    pool, every = (
        (unlisted(sensor), unlisted("tip")) if sort == "unlisted" else (listed(sensor), listed("tip"))
    )
    if not set(deck) & set(pool):
        deck += rng.permutation(every).tolist()
    name = next(name for name in deck if name in pool)
    deck.remove(name)
    return name


def write_case(seed: int, index: int, plan: WorkshopPlan, folder: Path) -> dict[str, Any]:
    """The case of this number in its folder; returns its answer."""
    rng = np.random.default_rng([seed, 1, index])
    case = make_case(plan.sort, plan.sensor, plan.closed_loop, plan.first_effect, rng)
    write_workshop_case(case, folder, rng)
    return case.answer
