"""A whole study as one library call: its points computed, then table and page."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from workflow.config.run_config import AnyConfig, RunConfig
from workflow.describe.summary import RunSummary
from workflow.engine import codec
from workflow.engine.code_version import code_digest
from workflow.engine.errors import InputError, StageError
from workflow.engine.executor import Executor, Failure, workers
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.figures.svg import svg_file
from workflow.kinds import kind_of
from workflow.report.pages import REPORT
from workflow.report.rendering import render_described
from workflow.study.described import study_page, study_summary
from workflow.study.directory import StudyDirectory
from workflow.study.page import StudyView, csv_text, row_of
from workflow.study.points import (
    Base,
    Point,
    PointMaker,
    PointRow,
    load_base,
    shared_stages,
)
from workflow.study.settings import JOINTS_PLOTS, StudyFile
from workflow.study.task import Done, PointTask
from workflow.tasks.results import RunResults
from workflow.tasks.stage import Stage


def run_study(
    file: StudyFile,
    out: Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Compute every point of a study into `out`, then table and page; the table's numbers in the summary.

    Parameters
    ----------
    file : StudyFile
    out : Path
        The study's directory.
    jobs : int, optional
        Processes of this machine; default: one per processor.
    scheduler : str, optional
        Address of a Dask scheduler whose workers compute the points; what these share is computed here.
    resume, replace : bool
        Go on with the study that is there, or delete it first.
    progress : Progress, optional

    Returns
    -------
    RunSummary
        A point that cannot be certified is a result.

    Raises
    ------
    InputError
        One line: something wrong with what the user gave.
    StageError
        Points failed (table and page are written all the same, and a resumed study tries them again), or the
        scheduler was lost.
    """
    study = file.config
    progress = progress or Progress()
    base = load_base(study, file.path, file.base)
    maker = PointMaker(study, file.path, base)
    points = maker.grid()
    processes = jobs or os.cpu_count() or 1
    # A cluster that does not answer is found out before anything is written.
    with ExitStack() as stack:
        here = stack.enter_context(workers(processes, preload=["workflow.study.task"]))
        executor = here if scheduler is None else stack.enter_context(workers(processes, scheduler))
        directory = StudyDirectory(out)
        with directory.writing(resume=resume, replace=replace):
            directory.begin_study(text=file.text, base=base, resume=resume, replace=replace)
            plant_s = sum(stage.expected_s for stage in kind_of(base.config).plant_stages)
            point_s = sum(stage.expected_s for stage in kind_of(base.config).controller_stages)
            points_s = point_s * len(points) / executor.width
            progress.plan([("plant", plant_s), ("points", points_s), ("page", REPORT.expected_s)])
            work = _Work(directory, base, maker.base_point(), executor, here, progress, len(points))
            try:
                work.make_base_plant()
                with progress.stage("points"):
                    rows = work.compute(points)
            except InputError:
                directory.discard_if_empty()
                raise
            with progress.stage("page"):
                summary = _write_up(directory, file, base, rows)

    # Failed points are told at the end: table and page of the others are there.
    broken = [row for row in rows if row.state == "failed"]
    if broken:
        raise StageError(
            f"{len(broken)} of {len(rows)} points failed (table and page are written, --resume tries them "
            f"again); point {broken[0].number}: {broken[0].why}"
        )
    return summary


@dataclass(eq=False)
class _Work:
    """The points of one study on one executor, with the plants they share made before them."""

    directory: StudyDirectory
    base: Base
    base_point: Point
    executor: Executor
    here: Executor
    progress: Progress
    count: int
    broken_plants: dict[str, str] = field(default_factory=dict)
    finished: int = 0
    taken_up: int = 0
    good: int = 0

    def make_base_plant(self) -> None:
        """Identify the plant of the base, unless the study has it. Raises InputError where that fails."""
        is_made = self.directory.has_plant(self.base_point)
        with self.progress.stage("plant", taken_up=is_made):
            if not is_made:
                files: Mapping[str, bytes] = {}
                if self.base.run is not None:
                    files = self.base.run.stage_files(self.base_point.given)
                self._plants([(self.base_point, files)])
            reason = self.broken_plants.get(self.base_point.plant_key)
            if reason is not None:
                raise InputError(f"the base cannot be identified: {reason}")

    def compute(self, points: Sequence[Point | PointRow]) -> list[PointRow]:
        """The rows of the points, in their order.

        What is finished is kept; points that share a controller go to one worker together.
        """
        rows = {point.name: point for point in points if isinstance(point, PointRow)}
        valid = {point.name: point for point in points if isinstance(point, Point)}.values()
        lacking = {point.plant_key: point for point in valid if not self.directory.has_plant(point)}
        self._plants([(point, self._given(point)) for point in lacking.values()])

        # What is known already, and groups of what is to be computed.
        groups: dict[str, list[Point]] = {}
        for point in valid:
            if point.plant_key in self.broken_plants:
                why = self.broken_plants[point.plant_key]
                rows[point.name] = PointRow(point.number, point.name, point.values, "failed", why)
            elif self.directory.has_point(point):
                rows[point.name] = row_of(point, self.directory.point(point))
                self.taken_up += 1
            else:
                groups.setdefault(point.design_key, []).append(point)
        self._report(rows.values())
        stages = kind_of(self.base.config).controller_stages
        work = [_task(group, self.directory.plant_files(group[0]), stages) for group in groups.values()]
        for results in _done(self.executor, list(groups.values()), work):
            for point, done in results:
                if isinstance(done, Failure):
                    rows[point.name] = PointRow(point.number, point.name, point.values, "failed", done.reason)
                else:
                    self.directory.save_point(point, done)
                    rows[point.name] = row_of(point, self.directory.point(point))
            self._report([rows[point.name] for point, _ in results])
        # Two combinations may be the same point: each has its own number.
        return [replace(rows[point.name], number=point.number) for point in points]

    def _plants(self, wanted: Sequence[tuple[Point, Mapping[str, bytes]]]) -> None:
        """Records, models and ellipses, on this machine: the logs are here."""
        if not wanted:
            return
        work = []
        for point, files in wanted:
            stages_with_file = {name.partition(".")[0] for name in files}
            plant_stages = kind_of(self.base.config).plant_stages
            lacking = [stage for stage in plant_stages if stage.name not in stages_with_file]
            work.append(_task([point], files, lacking))
        files_of = {point.name: files for point, files in wanted}
        for ((point, done),) in _done(self.here, [[point] for point, _ in wanted], work):
            if isinstance(done, Failure):
                self.broken_plants[point.plant_key] = done.reason
            else:
                self.directory.save_plant(point, files_of[point.name], done)

    def _given(self, point: Point) -> Mapping[str, bytes]:
        """What a plant begins with: stages of a given run, else those it shares with the base's plant."""
        if self.base.run is not None:
            return self.base.run.stage_files(point.given)
        if point.config.run.seed != self.base_point.config.run.seed or point.inputs != self.base_point.inputs:
            return {}
        shared = shared_stages(point.config, self.base_point.config)
        return self.directory.plant(self.base_point).stage_files(shared)

    def _report(self, rows: Collection[PointRow]) -> None:
        self.finished += len(rows)
        self.good += sum(row.good for row in rows)
        message = f"{self.finished} of {self.count}, {self.good} certified"
        # The time left follows from the points computed now; those kept took none.
        share = (self.finished - self.taken_up) / max(self.count - self.taken_up, 1)
        self.progress.update("points", min(share, 1.0), message)


def _task(points: Sequence[Point], given: Mapping[str, bytes], stages: Sequence[Stage]) -> PointTask:
    return PointTask(tuple(points), given, tuple(stage.name for stage in stages), code_digest())


def _done(
    executor: Executor, groups: Sequence[Sequence[Point]], tasks: Sequence[PointTask]
) -> Iterator[list[tuple[Point, Done | Failure]]]:
    """What became of the points of each task, as they finish."""
    for index, result in executor.run(tasks):
        points = groups[index]
        # A task that failed as a whole is the failure of each of its points.
        result_of_point = [result] * len(points) if isinstance(result, Failure) else result
        yield list(zip(points, result_of_point, strict=True))


def _write_up(directory: StudyDirectory, file: StudyFile, base: Base, rows: Sequence[PointRow]) -> RunSummary:
    """Table, picture and page: all of them or none."""
    study = file.config
    if "pareto" not in study.model_fields_set and not isinstance(base.config, RunConfig):
        study = study.model_copy(update={"pareto": JOINTS_PLOTS})
    # What the page is called and where it comes from.
    title = study.study.title or base.config.run.title or base.config.run.name
    where = str(base.run.path) if base.run is not None else study.study.base or "the built-in arm"
    view = StudyView(
        title, study, file.text, where, rows, _units(directory, base.config, rows), base.left_out
    )
    directory.link_numbers(rows)
    page = render_described(study_page(view))
    files = {f"{name}.svg": svg_file(made, page.looks) for name, made in page.pictures.items()}
    files["table.csv"] = csv_text(study.axes, rows, view.fronts).encode()
    files["table.json"] = codec.plain_text(view.document).encode()
    files["study.html"] = page.html.encode()
    directory.write(files)
    return study_summary(view, str(directory.path / "study.html"))


def _units(directory: StudyDirectory, config: AnyConfig, rows: Sequence[PointRow]) -> dict[str, str]:
    """Units that the rig decides, from the records of any finished point; those of joints differ by joint."""
    runs = (RunDirectory(directory.points_path / row.name) for row in rows)
    run = next((run for run in runs if run.stage_file("records") is not None), None)
    if run is None or not isinstance(config, RunConfig):
        return {}
    control = config.control_channel
    units = RunResults(run).records.records[0].units
    return {
        "peak_command": units.get(control.input, ""),
        "disturbance_peak": units.get(control.output, ""),
    }
