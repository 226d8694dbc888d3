"""A study's files.

    study.toml           the user's file, byte for byte
    study.json           base with every default filled in, its input files; a resumed study is held to them
    plants/<key>/        run directories with records, model and ellipses, shared by points
    points/<name>/       one run directory per point, without a page (`flexlink report` writes it)
    table.csv .json      one row per point; nothing in them depends on when or where a point was computed
    study.html, pareto.svg

One process writes here; workers hand over bytes. A point is finished when its manifest says so and its files
match what they would be made from now, so a killed study goes on where it stood.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.run_directory import RunDirectory, first_difference
from workflow.engine.store import Store
from workflow.study.points import PLANT_STAGES, POINT_STAGES, Base, Point
from workflow.study.task import Done
from workflow.study.toml_text import toml_text
from workflow.tasks.pipeline import stage_input_hash
from workflow.tasks.results import RunResults
from workflow.tasks.stages import Stage
from workflow.tasks.summary import summarise

LAYOUT_VERSION = 1


@dataclass(frozen=True)
class StudyDirectory(Store):
    """Where a study is kept. Make one with `begin`."""

    what = "study"
    manifest_name = "study.json"
    folders = ("points", "plants")
    own_files = ("study.html", "table.csv", "table.json", "pareto.svg", "study.toml")

    @classmethod
    def begin(
        cls, path: Path, *, text: str, base: Base, resume: bool, replace: bool = False
    ) -> StudyDirectory:
        """A new or empty directory, with `resume` the study that is there, with `replace` afresh in its
        place.

        Raises InputError: not writable, not empty, holding something else, or begun with another base (axes
        and search may change: points are found again by their content). With `replace` also where the base
        is a run of the study that would be deleted, or another process is writing it.
        """
        study = cls(Path(path))
        document = {
            "layout": LAYOUT_VERSION,
            "base": base.config.to_document(),
            "inputs": dict(base.inputs),
            "stages_taken_over": base.digests,
        }
        if replace:
            study._refuse_own_base(base)
        if study.prepare(resume=resume, replace=replace):
            changed = first_difference(storage.read_json(study.manifest_path), document)
            if changed:
                raise InputError(
                    f"{path}: cannot resume, the base changed at {changed}; choose another --out or start "
                    "afresh with --replace"
                )
        storage.write_text(study.path / "study.toml", text)
        storage.write_json(study.manifest_path, document)
        return study

    def _refuse_own_base(self, base: Base) -> None:
        if base.run is not None and self.path.resolve() in base.run.path.resolve().parents:
            raise InputError(
                f"{self.path}: --replace would delete the base, {base.run.path}; choose another --out"
            )

    def discard_if_empty(self) -> None:
        """Take back what `begin` wrote if neither a plant nor a point is there: a corrected base may come."""
        if not (any(self.plants_path.iterdir()) or any(self.points_path.iterdir())):
            self.discard()

    @property
    def plants_path(self) -> Path:
        return self.path / "plants"

    @property
    def points_path(self) -> Path:
        return self.path / "points"

    @property
    def page_path(self) -> Path:
        return self.path / "study.html"

    def plant(self, point: Point) -> RunDirectory:
        """The run directory of the plant that a point shares."""
        return RunDirectory(self.plants_path / point.plant_key[:16])

    def point(self, point: Point) -> RunDirectory:
        """The run directory of a point."""
        return RunDirectory(self.points_path / point.name)

    def has_plant(self, point: Point) -> bool:
        """Whether the plant of a point is there, made from what it would be made from now."""
        assert point.config is not None
        run, source = self.plant(point), point.inputs or {}
        return _matches(run, point.config, source, PLANT_STAGES, skip=point.given)

    def has_point(self, point: Point) -> bool:
        """Whether a point is finished, with the plant that stands in the study."""
        assert point.config is not None
        run, plant = self.point(point), self.plant(point)
        same = all(
            _digest(run, stage) is not None and _digest(run, stage) == _digest(plant, stage)
            for stage in PLANT_STAGES
        )
        return same and _matches(run, point.config, point.inputs or {}, POINT_STAGES)

    def save_plant(self, point: Point, given: Mapping[str, bytes], done: Done) -> None:
        """Keep records, model and ellipses."""
        run = self.plant(point)
        _write(run, point, given, done)
        run.record_status("identified")

    def save_point(self, point: Point, done: Done) -> None:
        """Keep a finished point, with the plant's stages beside its own: a run like any other."""
        run = self.point(point)
        _write(run, point, self.plant_files(point), done)
        assert point.config is not None
        certified = summarise(RunResults(run), point.config).certified
        run.record_status("complete" if certified else "complete, not certified")

    def plant_files(self, point: Point) -> dict[str, bytes]:
        """The stage files of the plant that a point shares, by file name."""
        return self.plant(point).stage_files(stage.name for stage in PLANT_STAGES)


def _write(run: RunDirectory, point: Point, given: Mapping[str, bytes], done: Done) -> None:
    assert point.config is not None
    document: dict[str, Any] = point.config.to_document()
    begun = RunDirectory.begin(
        run.path,
        config_text=f"# {point.name}\n\n{toml_text(document)}",
        config=document,
        seed=point.config.run.seed,
        inputs=point.inputs or {},
        resume=True,
    )
    for name, content in {**given, **done.files}.items():
        storage.write_bytes(begun.stages_path / name, content)
        # A stage may change its kind of file: a closed loop that was skipped has no arrays.
        stem, suffix = os.path.splitext(name)
        other = begun.stages_path / f"{stem}{'.npz' if suffix == '.json' else '.json'}"
        other.unlink(missing_ok=True)
    for name, seconds in done.seconds.items():
        begun.record_stage(name, seconds, done.hashes[name])


def _matches(
    run: RunDirectory,
    config: RunConfig,
    inputs: Mapping[str, str],
    stages: tuple[Stage, ...],
    skip: tuple[str, ...] = (),
) -> bool:
    if not run.manifest_path.is_file():
        return False
    for stage in stages:
        if _digest(run, stage) is None:
            return False
        if stage.name in skip:
            continue
        if any(run.stage_file(name) is None for name in stage.after):
            return False
        if not run.is_done(stage.name, stage_input_hash(stage, config, run, inputs)):
            return False
    return True


def _digest(run: RunDirectory, stage: Stage) -> str | None:
    return None if run.stage_file(stage.name) is None else run.stage_digest(stage.name)
