"""One loop or several joints: the one place where a file or a run directory says which kind of run it is.

Whoever runs one loop passes here and goes on; the room of several joints is entered from here alone, and only
once a configuration has [[joints]].
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflow.config.run_config import AnyConfig, RunConfig, SimulationConfig, loaded
from workflow.engine.documents import read_toml
from workflow.engine.run_directory import RunDirectory

if TYPE_CHECKING:
    from ident.data.record import Record
    from workflow.describe.summary import RunSummary
    from workflow.tasks.results import AnyResults
    from workflow.tasks.stage import RunKind, Stage


def load_any(path: Path) -> tuple[AnyConfig, str]:
    """Configuration of one loop or of several joints, and its text. Raises InputError: file, dotted key and
    what was expected in one line."""
    if "joints" in read_toml(path)[1]:
        from workflow.joints import JointsConfig

        return loaded(JointsConfig, path)
    return loaded(RunConfig, path)


def load_simulation(path: Path) -> AnyConfig | SimulationConfig:
    """A whole configuration, or one of [run] and [source] alone. Raises InputError as `load_any`."""
    if read_toml(path)[1].keys() <= SimulationConfig.model_fields.keys():
        return loaded(SimulationConfig, path)[0]
    return load_any(path)[0]


def config_of_any(run: RunDirectory) -> AnyConfig:
    """The configuration that a run was begun with. Raises InputError where it is damaged."""
    document = run.config_document()
    source = str(run.path / "config.json")
    if "joints" in document:
        from workflow.joints import JointsConfig

        return JointsConfig.from_document(document, source=source)
    return RunConfig.from_document(document, source=source)


def kind_of(config: AnyConfig) -> RunKind:
    """The stages of a run with this configuration."""
    if isinstance(config, RunConfig):
        from workflow.tasks.stages import ONE_LOOP

        return ONE_LOOP
    from workflow.joints import SEVERAL_JOINTS

    return SEVERAL_JOINTS


def simulated(config: AnyConfig | SimulationConfig, called: str) -> list[Record]:
    """The records of a configuration whose records are not files.

    called: what a complaint calls the configuration. Raises InputError (one line) that names the entry.
    """
    if isinstance(config, RunConfig | SimulationConfig):
        from workflow.tasks.simulated_rig import simulated_records

        return simulated_records(config, called)
    from workflow.joints import JointsConfig, simulated_points

    assert isinstance(config, JointsConfig)
    return simulated_points(config, called)


def page_of(config: AnyConfig, also: Iterable[str] = ()) -> Stage:
    """The stage that writes the page of a run. also: kinds of file for its pictures beside SVG."""
    stage: Stage
    write: Any
    if isinstance(config, RunConfig):
        from workflow.report.pages import REPORT, write_page

        stage = REPORT
        write = write_page
    else:
        from workflow.joints import JOINTS_REPORT, write_joints_page

        stage = JOINTS_REPORT
        write = write_joints_page
    return replace(stage, run=partial(write, also=also)) if also else stage


def summarise(results: AnyResults, config: AnyConfig) -> RunSummary:
    """What a run says whose stages are all there; results: those of its kind."""
    # Which kind of results they are follows from the configuration.
    of_its_kind: Any = results
    if isinstance(config, RunConfig):
        from workflow.describe.run import summarise as summarise_loop

        return summarise_loop(of_its_kind, config)
    from workflow.joints import JointsConfig, summarise_joints

    assert isinstance(config, JointsConfig)
    return summarise_joints(of_its_kind, config)
