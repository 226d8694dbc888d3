"""Answers to a fixed subset of cases, frozen, and told beside those of another version.

Labelled and sealed cases of the shared folder (with the truth, where that is told) and three real machines.
Per case: CPU, simulations, the answer with its size, and the probabilities of sets. `--against NAME` tells
where benchmarks/results/NAME.txt says otherwise; what a constant or a move of
the search earns is seen with `--change "module:NAME=value ..."` and `--without "Scan LookAlike"`.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import emps_axis, ruler_robot, serial_link_stage
from benchmarks.harness import RESULTS, Print, data_folder, main, timed
from diagnosis import Diagnosis, diagnose
from diagnosis.machine.machine_protocol import CaseOfMachine
from diagnosis.search import moves
from workflow.diagnose.case_files import load_case

# Folder below the shared cases, with the rig file where it is not the usual one: without a model error, with.
SHARED = {
    "exact": (
        "labelled/backlash",
        "labelled/coulomb_friction_and_tip_payload",
        "labelled/coulomb_friction_and_tip_payload:rig_uncertain.toml",
        "labelled/faint_viscous_friction:rig_uncertain.toml",
        "labelled/none:rig_uncertain.toml",
        "labelled/unlisted_effect",
        "labelled/gravity:rig_uncertain.toml",
        "sealed/case-06",
        "sealed/case-12",
    ),
    "workshop": (
        "workshop/labelled/work-05",
        "workshop/labelled/work-06",
        "workshop/labelled/work-09",
        "workshop/labelled/work-15",
        "workshop/labelled/work-18",
        "workshop/labelled/work-19",
        "workshop/labelled/work-22",
        "workshop/sealed/case-06",
        "workshop/sealed/case-09",
        "workshop/sealed/case-12",
        "workshop/sealed/case-16",
    ),
}
REAL: dict[str, tuple[Callable[[Path], CaseOfMachine], tuple[str, ...]]] = {
    "EMPS": (lambda folder: emps_axis.case(folder, "passes"), ("coulomb_friction", "constant_offset")),
    "EMPS in its loop": (
        lambda folder: emps_axis.case(folder, "fast", "loop"),
        ("coulomb_friction", "constant_offset"),
    ),
    "2DSFL stage 1": (lambda folder: serial_link_stage.case(folder, 1), ()),
    "2DSFL stage 2": (lambda folder: serial_link_stage.case(folder, 2), ()),
    "SLFR": (ruler_robot.case, ()),
}
# Changes of a probability, and of a size relative to it, that are told.
TOLD, TOLD_SIZE = 0.1, 0.02


def cases(only: str) -> Iterator[tuple[str, CaseOfMachine, tuple[str, ...]]]:
    """Name, case, effects that are there (none where nobody says)."""
    data = data_folder("emps", "quanser_2dsfl", "slfr_krauss_2009")
    gap = Path(os.environ.get("FLEXLINK_GAP", data.parent / "gap"))
    for kind, places in SHARED.items():
        for place in places:
            folder, _, rig = place.partition(":")
            if re.search(only, f"{kind} {place}"):
                answer = gap / folder / "answer.toml"
                told = tomllib.loads(answer.read_text("utf-8")) if answer.is_file() else {}
                names = tuple(e["name"] for e in told.get("effects", ())) or (told.get("verdict"),)
                yield f"{kind} {place}", load_case(gap / folder, rig or None).case, tuple(filter(None, names))
    for name, (make, truth) in REAL.items():
        if re.search(only, f"real {name}"):
            yield f"real {name}", make(data), truth


def answer(found: Diagnosis, truth: tuple[str, ...], cpu_s: float) -> dict[str, Any]:
    """What is frozen of an answer."""
    entries = {e.name: e for e in found.effects}
    sets = {" + ".join(key) or "none": round(p, 3) for key, p in found.sets.items() if p >= 0.02}
    wanted = " + ".join(sorted(truth))
    named = found.combination or found.partial_model
    return {
        "cpu_s": round(cpu_s, 1),
        "simulations": found.simulations,
        "answer": " + ".join(sorted(found.combination)) or found.verdict,
        "truth": wanted,
        "p_truth": sets.get(wanted, 0.0),
        "gap": [round(g, 3) for g in (found.gap_before, found.gap_refit, found.gap_after)],
        "sizes": {n: {k: float(f"{v:.4g}") for k, v in entries[n].parameters.items()} for n in named},
        "sets": dict(sorted(sets.items(), key=lambda item: -item[1])),
    }


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """In words."""
    told = []
    if before["answer"] != after["answer"]:
        told.append(f"answer {before['answer']} -> {after['answer']}")
    for key in {**before["sets"], **after["sets"]}:
        old, new = (which["sets"].get(key, 0.0) for which in (before, after))
        if abs(new - old) >= TOLD:
            told.append(f"{key} {old:.2f} -> {new:.2f}")
    for name in before["sizes"].keys() & after["sizes"].keys():
        for key, old in before["sizes"][name].items():
            new = after["sizes"][name][key]
            if abs(new - old) > TOLD_SIZE * abs(old):
                told.append(f"{name} {key} {old:.3g} -> {new:.3g}")
    if after["gap"][2] > (1 + TOLD_SIZE) * before["gap"][2]:
        told.append(f"gap after {before['gap'][2]} -> {after['gap'][2]}")
    return told


def frozen(name: str) -> dict[str, dict[str, Any]]:
    """Answers of a results file."""
    lines = (RESULTS / f"{name}.txt").read_text("utf-8").splitlines()
    parts = (line.partition(": {") for line in lines)
    return {case: json.loads("{" + rest) for case, found, rest in parts if found}


def run(out: Print, *, only: str = "", against: str = "", change: str = "", without: str = "") -> None:
    for name in without.split():
        getattr(moves, name).proposed = lambda *told: []
    for module, name, value in re.findall(r"(\S+):(\w+)=(\S+)", change):
        setattr(importlib.import_module(module), name, eval(value, {"np": np}))
    before = frozen(against) if against else {}
    cpu: dict[str, list[float]] = {}
    for name, case, truth in cases(only):
        found, cpu_s = timed(lambda case=case: diagnose(case))
        now = answer(found, truth, cpu_s)
        cpu.setdefault(name.split()[0], []).append(cpu_s)
        out(f"{name}: {json.dumps(now)}")
        if name in before:
            cpu_before = before[name]["cpu_s"]
            for words in (*differences(before[name], now), f"CPU {cpu_before} -> {cpu_s:.1f} s"):
                out(f"    {words}")
    for kind, times in cpu.items():
        out(f"{kind}: CPU median {np.median(times):.1f} s, sum {sum(times):.0f} s")


if __name__ == "__main__":
    main(run)
