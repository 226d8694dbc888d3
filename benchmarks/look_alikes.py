"""How often does an effect get the name of a cause that is on no list?

Diagnosed are workshop cases of the independent rigs, those whose cause is on no list and those with one
effect that is taken off the list before, and MuJoCo cases (`mujoco_cases`) without their effect on the list.
Named is what is present with at least .5; for the counts of `diagnosis/judge/look_alikes.toml` before what it
loses by these (`NamedEffect.acts_alike`) is taken off.
"""

from __future__ import annotations

import tempfile
import tomllib
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, starmap
from pathlib import Path

from benchmarks.harness import Print, main, timed
from benchmarks.mujoco_cases import KINDS, case_of
from diagnosis import PlantCase, diagnose
from diagnosis.judge.verdict import kind_of
from diagnosis.machine.case import Case
from plant.effects import EFFECTS
from validation.blind.generate import generate
from workflow.diagnose.case_files import load_case

SEEDS = {"single": 8101, "unlisted": 8102, "models": 8103}
NAMED, SURE = 0.5, 0.8


@contextmanager
def without(names: list[str]) -> Iterator[None]:
    """The registry without these effects."""
    kept = dict(EFFECTS)
    for name in names:
        del EFFECTS[name]
    try:
        yield
    finally:
        EFFECTS.clear()
        EFFECTS.update(kept)


def of_rigs(kind: str, number: int) -> Iterator[tuple[str, str, list[str], Case]]:
    """Name, cause, effects to be taken off the list, case."""
    with tempfile.TemporaryDirectory() as folder:
        generate(number, SEEDS[kind], Path(folder) / "c", open_cases=True, workshop=True, only=kind)
        for place in sorted((Path(folder) / "c").iterdir()):
            answer = tomllib.loads((place / "answer.toml").read_text(encoding="utf-8"))
            gone = [each["name"] for each in answer.get("effects", [])]
            beyond = [each["name"] for each in answer.get("unlisted", [])]
            yield place.name, " ".join(gone or beyond), gone, load_case(place).case


def of_models(count: int) -> Iterator[tuple[str, str, list[str], PlantCase]]:
    """The same of the first `count` kinds of MuJoCo cases, their effects off the list already."""
    for number in range(count):
        if KINDS[number % len(KINDS)][0] == "none":
            continue
        truth, case = case_of(number, SEEDS["models"])
        effects = tuple(e for e in case.plant.effects if e.name != truth.name)
        exact = {k: t for k, t in case.plant.tolerances.items() if f"wrong_{k}" != truth.name}
        plant = replace(case.plant, effects=effects, tolerances=exact)
        yield case.name, truth.name, [], replace(case, plant=plant)


def run(out: Print, *, single: int = 20, unlisted: int = 16, models: int = 40) -> None:
    rigs = {kind: count for kind, count in (("single", single), ("unlisted", unlisted)) if count}
    machines = {"rigs": chain.from_iterable(starmap(of_rigs, rigs.items())), "models": of_models(models)}
    for machine, every in machines.items():
        stood_in, cases, sure = Counter[str](), 0, 0
        for name, cause, gone, case in every:
            with without(gone), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found, seconds = timed(lambda case=case: diagnose(case))
            effects = [e for e in found.effects if e.name not in ("none", "unknown")]
            there = {e.name: e.presence for e in effects if e.presence + e.acts_alike >= NAMED}
            stood_in.update({kind_of(name) for name in there})
            cases += 1
            sure += max(there.values(), default=0.0) > SURE
            said = ", ".join(f"{name} {p:.3f}" for name, p in there.items()) or found.verdict
            out(f"{name} {cause:24s} -> {said}   ({seconds:.0f} s)")
        if not cases:
            continue
        out(f"named above {SURE}: {sure}")
        named = ", ".join(f"{name} {n}" for name, n in sorted(stood_in.items()))
        out(f"{cases} cases of {machine}; named: {named}")


if __name__ == "__main__":
    main(run)
