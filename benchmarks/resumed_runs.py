"""Runs that are cut after each of their stages and resumed: do they end with the bytes of a run left alone?

Five kinds of records of one loop (logs with dead time, with dry friction, made in closed loop; a simulated
arm with a reference filter; `flexlink run LOG`, which drafts its configuration) and one of two joints. For
each kind a run is left alone. Then it is copied once for each stage, as an interruption after that stage
leaves it: later stages, page, controller and model are gone. The copy is resumed from its directory alone.
Every file is compared byte by byte, but for the manifest, which names times.

Besides, a study that takes the run's directory as its base, against one on the run's configuration, both with
another setting of the identification: their tables are compared but for the names of points, which tell what
they were taken over from.

All of it runs in one process: compiled code and the same code from its cache may round otherwise.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness import Print, main
from workflow.commands.logs import Reading
from workflow.commands.run import run_from_files, simulate_to_csv
from workflow.engine import storage
from workflow.engine.run_directory import KEPT_FILES, RunDirectory
from workflow.kinds import kind_of, load_any
from workflow.study.settings import load_study
from workflow.study.work import run_study

# Of a run: the seconds of its stages and the status stand there.
_NAMES_TIMES = ("manifest.json", "lock")

_MACHINE = """
[source]
kind = "simulated"
encoder_step_rad = 0.0003835
effects = [
    {{ name = "viscous_friction", coefficient_Nms = 0.02 }},
    {effect}
]
{loop}

[[source.records]]
name = "first"
excitation = {{ kind = "prbs", amplitude_V = 6.0, samples = 2500, hold_samples = 4 }}

[[source.records]]
name = "second"
role = "validation"
excitation = {{ kind = "prbs", amplitude_V = 5.0, samples = 1200, hold_samples = 3 }}
"""
_LOOP = "loop = { proportional_V_per_rad = 8.0, derivative_Vs_per_rad = 0.4, reference_rad_per_V = 0.05 }"
_LOGS = """
[source]
kind = "files"
time = "time_s"
{references}
records = [
    {{ path = "logs/01_first.csv" }},
    {{ path = "logs/02_second.csv", role = "validation" }},
]
"""
# Of what the data decide nothing is stated, and little effort is asked for: the bytes are what counts.
_CHANNEL = """
[[channels]]
input = "voltage_V"
output = "hub_angle_rad"
{channel}

[specification]
bandwidth_rad_s = 2.0
modulus_margin = 0.4
input_limit = 24.0
controller_order = 3

[synthesis]
starts = 2
agreeing_starts = 1
exchange_rounds = 1
dense_points = 800
grid_points = 60

[certificate]
joint_draws = 100

[closed_loop]
draws = 2
conditions = false

[achievable_performance]
grid_points = 60
dense_points = 800
"""
_FILTER = """
[reference_filter]
model = { numerator = [9.0], denominator = [1.0, 6.0, 9.0] }
"""
_JOINTS = """
[source]
kind = "two_joint_arm"
samples = 3000
points = [{ name = "bent", elbow_rad = 1.6 }]

[[joints]]
input = "shoulder_V"
output = "shoulder_rad"
bandwidth_rad_s = 3.0
effort_limit = 100.0
input_limit = 24.0

[[joints]]
input = "elbow_V"
output = "elbow_rad"
bandwidth_rad_s = 5.0
effort_limit = 100.0
input_limit = 24.0

[identification]
n_real = 3
n_pairs = 2

[design]
controller_order = 4
"""
_STUDY = """
[study]
base = "{base}"

[[axes]]
key = "{key}"
values = {values}
"""
_MAX_PAIRS = ("channels[0].identification.max_pairs", "[4]")


def _config(folder: Path, text: str) -> Path:
    """The configuration as a file in a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _with_logs(
    effect: str, *, loop: str = "", references: str = "", channel: str = ""
) -> Callable[[Path], Path]:
    """What writes logs of the simulated arm with an effect, and a configuration of a run on them."""

    def write(folder: Path) -> Path:
        machine = _config(folder / "machine", _MACHINE.format(effect=effect, loop=loop))
        simulate_to_csv(machine, folder / "logs")
        return _config(folder, _LOGS.format(references=references) + _CHANNEL.format(channel=channel))

    return write


@dataclass(frozen=True)
class Kind:
    """A kind of run. write: what puts its configuration (and logs) into a folder; drafted: the run is of the
    logs, and drafts its own configuration; axis: key and values of the study, a setting of the
    identification."""

    name: str
    write: Callable[[Path], Path]
    drafted: bool = False
    axis: tuple[str, str] = _MAX_PAIRS
    counted: bool = True  # among the five kinds of one loop

    def run(self, config: Path, out: Path) -> None:
        """A run that is left alone."""
        if self.drafted:
            columns = Reading(time="time_s", input_name="voltage_V", output_name="hub_angle_rad")
            run_from_files(None, out, [config.parent / "logs" / "01_first.csv"], columns)
        else:
            run_from_files(config, out)


_DELAY = '{ name = "input_delay", delay_s = 0.03 }'
_FRICTION = '{ name = "coulomb_friction", torque_Nm = 0.02 }'
KINDS = (
    Kind("dead time", _with_logs(_DELAY)),
    Kind("friction", _with_logs(_FRICTION, channel='uncertainty = { response = "without friction" }')),
    Kind("closed loop", _with_logs(_DELAY, loop=_LOOP, references='references = ["reference_rad"]')),
    Kind(
        "simulated arm, filter",
        lambda folder: _config(
            folder, _MACHINE.format(effect=_DELAY, loop="") + _CHANNEL.format(channel="") + _FILTER
        ),
    ),
    Kind("drafted of a log", _with_logs(_FRICTION), drafted=True),
    Kind(
        "two joints",
        lambda folder: _config(folder, _JOINTS),
        axis=("identification.level", "[0.9]"),
        counted=False,
    ),
)


def cut_after(whole: Path, cut: Path, kept: tuple[str, ...]) -> None:
    """A copy of a run as an interruption leaves it once the stages `kept` are done."""
    shutil.copytree(whole, cut)
    run = RunDirectory(cut)
    for path in run.stages_path.iterdir():
        if path.stem not in kept:
            path.unlink()
    for path in (run.report_path, *run.figures_path.iterdir(), *(cut / name for name in KEPT_FILES)):
        path.unlink(missing_ok=True)
    manifest = run.manifest()
    stages = {name: entry for name, entry in manifest["stages"].items() if name in kept}
    storage.write_json(run.manifest_path, {**manifest, "stages": stages, "status": "interrupted"})


def differing_files(first: Path, second: Path) -> list[str]:
    """Names of files that are in one of two runs only, or have other bytes there."""

    def contents(folder: Path) -> dict[str, bytes]:
        files = (path for path in folder.rglob("*") if path.is_file() and path.name not in _NAMES_TIMES)
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}

    before = contents(first)
    after = contents(second)
    return sorted(name for name in before | after if before.get(name) != after.get(name))


def study_table(folder: Path, base: Path, axis: tuple[str, str]) -> list[dict[str, object]]:
    """Rows of a study with one point, without what names the place of the point."""
    folder.mkdir()
    key, values = axis
    text = _STUDY.format(base=base, key=key, values=values)
    (folder / "study.toml").write_text(text, encoding="utf-8")
    run_study(load_study(folder / "study.toml"), folder / "out", jobs=1)
    rows = json.loads((folder / "out" / "table.json").read_text("utf-8"))["points"]
    return [{name: value for name, value in row.items() if name != "name"} for row in rows]


def run(out: Print, *, only: str = "") -> None:
    differ = 0
    cuts = 0
    studies_differ = 0
    studies = 0
    for kind in KINDS:
        if only and only != kind.name:
            continue
        started_s = time.process_time()
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            config = kind.write(folder)
            whole = folder / "alone" / "run"
            kind.run(config, whole)
            if kind.drafted:
                config = whole / "config.toml"
            settings, _ = load_any(config)
            stages = [stage.name for stage in kind_of(settings).stages]
            for number, stage in enumerate(stages, start=1):
                cut = folder / f"cut {number}" / "run"
                cut_after(whole, cut, tuple(stages[:number]))
                run_from_files(None, cut, resume=True)
                other = differing_files(whole, cut)
                if kind.counted:
                    cuts += 1
                    differ += bool(other)
                out(f"{kind.name}, cut after {stage}: {', '.join(other) or 'the same bytes'}")
            on_run = study_table(folder / "on the run", whole, kind.axis)
            on_file = study_table(folder / "on the file", config, kind.axis)
            studies += 1
            studies_differ += on_run != on_file
            out(f"{kind.name}, study on the run's directory: {'the same' if on_run == on_file else 'OTHER'}")
        out(f"{kind.name}: {time.process_time() - started_s:.0f} s of CPU")
        out()
    out(f"runs of one loop, cut and resumed, that differ: {differ} of {cuts}")
    differing = f"{studies_differ} of {studies}"
    out(f"studies on a run's directory that differ from one on its configuration: {differing}")


if __name__ == "__main__":
    main(run)
