"""Case folders in the format of the gap cases; answers go wherever the caller says, never into a folder.

    python -m validation.blind.generate --cases 100 --seed 7 --out DIR --open

writes open cases for development: DIR/<case>/answer.toml and rig_exact.toml lie beside the records then.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomlkit
import typer

from validation.blind.cases import BlindCase, make_case, schedule
from validation.blind.rigs import rig_toml
from validation.blind.workshop.cases import (
    WorkshopCase,
    WorkshopPlan,
    make_case as make_workshop_case,
    workshop_schedule,
)
from validation.blind.workshop.files import write_workshop_case
from workflow.engine.errors import StageError
from workflow.engine.executor import Failure, Report, workers
from workflow.engine.storage import write_text

Answer = dict[str, Any]
Plan = tuple[Any, bool, str] | WorkshopPlan


def case_name(index: int) -> str:
    return f"case_{index + 1:04d}"


def write_case(case: BlindCase, folder: Path) -> None:
    """rig.toml, case.toml and experiments/*.csv; the answer is not among them."""
    (folder / "experiments").mkdir(parents=True, exist_ok=True)
    write_text(folder / "rig.toml", rig_toml(case.stated, case.tolerances))
    lines = [f'case = "{folder.name}"']
    for record in case.records:
        plan = record.plan
        rows = ["time_s,voltage_V,hub_angle_rad,tip_m"]
        dt = case.stated["sampling"]["dt_s"]
        for k, (volt, (hub, tip)) in enumerate(
            zip(record.voltage_V.tolist(), record.measured.tolist(), strict=True)
        ):
            rows.append(f"{k * dt:.3f},{round(volt, 4):.6g},{hub:.6g},{tip:.6g}")
        write_text(folder / "experiments" / f"{plan.name}.csv", "\n".join(rows) + "\n")
        lines += [
            "",
            "[[experiments]]",
            f'file = "experiments/{plan.name}.csv"',
            f'kind = "{plan.kind}"',
            f'role = "{plan.role}"',
            f"samples = {record.voltage_V.size}",
            f"closed_loop = {'true' if plan.feedback else 'false'}",
            f'description = "{plan.description}"',
        ]
    write_text(folder / "case.toml", "\n".join(lines) + "\n")


def folder_hash(folder: Path) -> str:
    """SHA-256 over names and contents of every file of a case, so that none is exchanged afterwards."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(f"{path.relative_to(folder).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def answer_toml(answer: Mapping[str, Any]) -> str:
    """Text of an answer file as the labelled cases have it (the true rig goes into a file of its own)."""
    shown = {key: value for key, value in answer.items() if key not in ("true_rig", "sha256")}
    return str(tomlkit.dumps(shown))


@dataclass(frozen=True)
class _Case:
    """One case to be made, wherever that is."""

    seed: int
    out: Path
    open_cases: bool
    index: int
    plan: Plan

    def run(self, report: Report) -> Answer:
        """Its answer; its folder is written."""
        plan = self.plan
        folder = self.out / case_name(self.index)
        rng = np.random.default_rng([self.seed, 1, self.index])
        case: BlindCase | WorkshopCase
        if isinstance(plan, WorkshopPlan):
            case = make_workshop_case(plan, rng)
            write_workshop_case(case, folder, rng)
        else:
            case = make_case(*plan, rng)
            write_case(case, folder)
        answer = {"case": folder.name, **case.answer}
        if self.open_cases:
            write_text(folder / "rig_exact.toml", rig_toml(answer["true_rig"]))
            write_text(folder / "answer.toml", answer_toml(answer))
        return {**answer, "sha256": folder_hash(folder)}


def generate(
    n_cases: int,
    seed: int,
    out: Path,
    *,
    jobs: int = 1,
    open_cases: bool = False,
    only: Any = None,
    workshop: bool = False,
    finished: Mapping[str, Answer] | None = None,
    keep: Callable[[Answer], None] | None = None,
) -> list[Answer]:
    """Write the cases of a seed below `out` and return their answers; the same seed gives the same bytes.

    Parameters
    ----------
    n_cases, seed : int
    out : Path
        Made where it is absent.
    jobs : int
        Processes.
    open_cases : bool
        Write answers and exact rigs beside the records.
    only : str, optional
        One sort of cases.
    workshop : bool
        Workshop cases instead of the usual ones.
    finished : mapping of str to dict, optional
        Answers of cases that are there already, by name: they are not drawn again.
    keep : callable, optional
        Called with every answer as soon as its case is written.

    Raises
    ------
    StageError
        One line: a case could not be made.
    """
    out.mkdir(parents=True, exist_ok=True)
    answers = dict(finished or {})
    drawn = np.random.default_rng([seed, 0, n_cases])
    plans: list[Plan] = [*(workshop_schedule if workshop else schedule)(n_cases, drawn, only)]
    tasks = [
        _Case(seed, out, open_cases, k, plan) for k, plan in enumerate(plans) if case_name(k) not in answers
    ]
    with workers(jobs, preload=[__spec__.name]) as processes:
        for _, answer in processes.run(tasks):
            if isinstance(answer, Failure):
                raise StageError(answer.reason)
            answers[answer["case"]] = answer
            if keep:
                keep(answer)
    return [answers[name] for name in sorted(answers)]


def main(
    cases: Annotated[int, typer.Option(min=1)],
    seed: Annotated[int, typer.Option(min=0)],
    out: Annotated[Path, typer.Option(help="Directory, new or empty.")],
    jobs: Annotated[int, typer.Option(min=1)] = 1,
    open_cases: Annotated[
        bool, typer.Option("--open", help="Write answers and exact rigs beside the records.")
    ] = False,
    workshop: Annotated[bool, typer.Option("--workshop", help="Imperfect machines, awkward logs.")] = False,
) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise typer.BadParameter("need an empty directory")
    generate(cases, seed, out, jobs=jobs, open_cases=open_cases, workshop=workshop)


if __name__ == "__main__":
    typer.run(main)
