"""A study's files.

    study.toml           the user's file, byte for byte
    study.json           what the base states, its input files; a resumed study is held to them
    plants/<key>/        run directories with records, model and ellipses, shared by points
    points/<name>/       one run directory per point, without a page (`flexlink report` writes it)
    points/<number>      a link to it, by its number in the table
    table.csv .json      one row per point; nothing in them depends on when or where a point was computed
    study.html, pareto.svg

One process writes here; workers hand over bytes. A point is finished when its files match what they would be
made from now.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from workflow.engine.errors import InputError
from workflow.engine.run_directory import RunDirectory
from workflow.engine.store import Store
from workflow.kinds import kind_of
from workflow.study.points import Base, Combination, Point
from workflow.study.task import Done
from workflow.tasks.pipeline import stage_input_hash
from workflow.tasks.stage import PLANT, Stage

# 2: the base is what was stated, without defaults, as in run directories of layout 10. A study of another
# layout is not resumed.
LAYOUT_VERSION = 2


@dataclass(frozen=True)
class StudyDirectory(Store):
    """Where a study is kept. Make one with `begin_study`."""

    what = "study"
    manifest_name = "study.json"
    folders = ("points", "plants")
    first_files = ("study.toml",)
    own_files = ("study.html", "table.csv", "table.json", "pareto.svg")

    def begin_study(self, *, text: str, base: Base, resume: bool, replace: bool = False) -> Self:
        """Begin or resume the study, which is held to its base: axes may change, as points are found again by
        their content.

        Parameters
        ----------
        text : str
            The study file, kept as study.toml.
        base : Base
        resume, replace : bool
            See `Store.begin`.

        Raises
        ------
        InputError
            One line: see `Store.begin`; also with `replace` where the base is a run of the study that would
            be deleted.
        """
        if replace and base.run is not None and self.path.resolve() in base.run.path.resolve().parents:
            raise InputError(
                f"{self.path}: --replace would delete the base, {base.run.path}; choose another --out"
            )
        document = {
            "layout": LAYOUT_VERSION,
            "base": base.config.to_document(),
            "inputs": dict(base.inputs),
            "stages_taken_over": base.digests,
        }
        first = {"study.toml": text.encode()}
        self.begin(document, first, resume=resume, replace=replace).write(first)
        return self

    @property
    def points_path(self) -> Path:
        return self.path / "points"

    def plant(self, point: Point) -> RunDirectory:
        """The run directory of the plant that a point shares."""
        # 64 bits of the hash tell the plants of any study apart, and keep paths short.
        return RunDirectory(self.path / "plants" / point.plant_key[:16])

    def point(self, point: Point) -> RunDirectory:
        """The run directory of a point."""
        return RunDirectory(self.points_path / point.name)

    def has_plant(self, point: Point) -> bool:
        """Whether the plant of a point is there, made from what it would be made from now."""
        return _matches(self.plant(point), point, kind_of(point.config).plant_stages, skip=point.given)

    def has_point(self, point: Point) -> bool:
        """Whether a point is finished, with the plant that stands in the study."""
        run = self.point(point)
        finished = _matches(run, point, kind_of(point.config).controller_stages)
        return finished and run.stage_files(PLANT) == self.plant_files(point)

    def save_plant(self, point: Point, given: Mapping[str, bytes], done: Done) -> None:
        """Keep records, model and ellipses."""
        run = self.plant(point)
        _write(run, point, given, done)
        run.record_status("identified")

    def save_point(self, point: Point, done: Done) -> None:
        """Keep a finished point, with the plant's stages beside its own: a run like any other."""
        run = self.point(point)
        _write(run, point, self.plant_files(point), done)
        results = kind_of(point.config).results(run)
        holds = results.certified and results.settles
        run.record_status("complete" if holds else "complete, not certified")

    def link_numbers(self, points: Iterable[Combination]) -> None:
        """Every point that is there under its number as well; numbers of an earlier call are gone."""
        for entry in self.points_path.iterdir():
            if entry.is_symlink() and entry.name.isdigit():
                entry.unlink()
        for point in points:
            link = self.points_path / str(point.number)
            # A copied study has folders.
            if (self.points_path / point.name).is_dir() and not link.exists():
                link.symlink_to(point.name, target_is_directory=True)

    def plant_files(self, point: Point) -> dict[str, bytes]:
        """The stage files of the plant that a point shares, by file name."""
        return self.plant(point).stage_files(PLANT)


def _write(run: RunDirectory, point: Point, given: Mapping[str, bytes], done: Done) -> None:
    """Write a run of the study from stage files by name."""
    run.begin_run(
        config_text=f"# {point.name}\n\n{point.config.to_toml()}",
        config=point.config.to_document(),
        seed=point.config.run.seed,
        inputs=point.inputs,
        resume=True,
    )
    for name, file in {**given, **done.files}.items():
        run.write_stage(*os.path.splitext(name), file)
    for name, seconds in done.seconds.items():
        run.record_stage(name, seconds, done.hashes[name])


def _matches(run: RunDirectory, point: Point, stages: tuple[Stage, ...], skip: tuple[str, ...] = ()) -> bool:
    """Whether the stages are there, made from what they would be made from now (but for those to skip)."""
    needed = {name for stage in stages for name in (stage.name, *stage.after)}
    if not run.manifest_path.is_file():
        return False
    if any(run.stage_file(name) is None for name in needed):
        return False
    for stage in stages:
        if stage.name in skip:
            continue
        made_from = stage_input_hash(stage, point.config, run, point.inputs)
        if not run.is_done(stage.name, made_from):
            return False
    return True
