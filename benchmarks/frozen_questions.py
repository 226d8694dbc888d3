"""Some eighty questions over everything the product answers, and what is kept of each answer.

An answer is values by kind and name. The kind decides how far a value may move (`frozen_answers.KINDS`):

    said           verdicts, certificates, orders, delays, names of columns and effects
    lines          sentences with numbers: refusals, reasons
    margins        certified margins and worst cases
    model          what a model is: poles, modes, fits, dry friction
    spread         how far it may be off: ellipses, intervals, standard deviations
    sizes          of effects that a diagnosis names
    probabilities  of sets of effects; one that is left out is 0
    gaps           between simulation and machine
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]

Answer = dict[str, dict[str, Any]]
Keys = tuple[str, ...]


@dataclass(frozen=True)
class Question:
    """ask: gives the answer; needs: folders and files that it reads, which not everybody has; slow: asked
    only with --slow."""

    ask: Callable[[], Answer]
    needs: tuple[Path, ...] = ()
    slow: bool = False


def _shared(variable: str, name: str) -> Path:
    return Path(os.environ.get(variable) or ROOT.parent / "shared" / name)


# Measured arms.
DATA = _shared("FLEXLINK_DATA", "data")
# Recorded gap cases.
GAP = _shared("FLEXLINK_GAP", "gap")
# Simulated machines with their truth.
MACHINES = DATA.parent / "machines"


class Kept:
    """An answer as it is gathered: values by name, of one kind after the other."""

    def __init__(self) -> None:
        self.answer: Answer = {}

    def __call__(self, kind: str, **values: Any) -> None:
        self.answer.setdefault(kind, {}).update(values)

    def picked(self, document: Any, rules: Iterable[tuple[str, str]], before: str = "") -> None:
        """Keep the values of a JSON document whose path a rule (pattern, kind) matches; the first decides."""
        for path, value in _flat(document):
            name = before + ".".join(path)
            for pattern, kind in rules:
                if re.fullmatch(pattern, name):
                    self(kind, **{name: value})
                    break


def _flat(document: Any, path: Keys = ()) -> Iterator[tuple[Keys, Any]]:
    """Path and value of everything in a JSON document; entries of a list go by their names, else by their
    numbers."""
    if isinstance(document, Mapping):
        for key, value in document.items():
            yield from _flat(value, (*path, str(key)))
    elif isinstance(document, list | tuple) and not all(isinstance(item, str) for item in document):
        for number, value in enumerate(document):
            named = value if isinstance(value, Mapping) else {}
            name = next((str(named[key]) for key in ("requirement", "name", "case") if key in named), None)
            yield from _flat(value, (*path, name or str(number)))
    else:
        yield path, list(document) if isinstance(document, tuple) else document


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="flexlink-frozen-") as name:
        yield Path(name)


_PROGRESS = re.compile(r"^flexlink: (?:\d+ s: |compiling, once).*\n", re.MULTILINE)


def flexlink(*words: object, folder: Path | None = None) -> tuple[int, str, list[str]]:
    """Exit code, standard output, and the lines on standard error, names of folders left out."""
    from workflow.cli import main

    out = io.StringIO()
    error = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        code = main([str(word) for word in words])
    texts = [out.getvalue(), _PROGRESS.sub("", error.getvalue())]
    for place in filter(None, (folder, DATA, GAP, MACHINES, ROOT)):
        for name in (f"{place}/", f"{os.path.relpath(place)}/"):
            texts = [text.replace(name, "") for text in texts]
    return code, texts[0], texts[1].splitlines()


# Of the numbers of `run --json` and `identify --json`.
_MODEL = (
    (r".*\.(order|integrators|input_delay_samples|feedthrough|is_mode|passed)", "said"),
    (r".*\.closed_loop\.[a-z_]*", "said"),
    (r".*\.intervals\..*\.\d+|.*\.median_radius_percent", "spread"),
    (r".*\.modes\.\d+\.(frequency_Hz|damping)|.*\.(real_poles_per_s|unstable_poles)\..*", "model"),
    (r".*\.fit_validation_percent\..*|.*\.noise_std", "model"),
    (r".*friction.*\.(level|law|excess|speed|viscous|stiffness).*", "model"),
)
_RUN = (
    (r"certificate\.(certified|plants\.\d+\.(stable|nyquist\.half_turns|all_frequencies\.proved))", "said"),
    (r"certificate\.items\..*\.met|design\.(met|outcome)|design\.blocking\.(plant|weight)", "said"),
    (r"certificate\.items\..*\.(achieved|bound)|certificate\.gamma(_bound)?|design\.gamma", "margins"),
    (r"certificate\.plants\.\d+\.(worst_margins\..*|bandwidth_rad_s|worst_peak_sensitivity)", "margins"),
    (r"achievable_performance\.(reached|floor)", "margins"),
    (r"reference_filter\.error_(before|after)", "margins"),
    (r"closed_loop\.(settled_draws|draws|machine)", "said"),
    (r"closed_loop\.achieved\.(overshoot_percent|settling_time_s)", "spread"),
    (r"closed_loop\.friction\.(level|sticking_step|error_at_rest)", "model"),
    (r"sampled_responses\.(gamma|coverage_given)", "spread"),
)


def of_run(summary: Any) -> Answer:
    """What is kept of a run: a `RunSummary`, or the document of --json."""
    document = summary if isinstance(summary, Mapping) else summary.to_document()
    answer = Kept()
    if "certified" in document:
        answer("said", certified=document["certified"])
    answer("lines", verdict=document["verdict"])
    answer.picked(document["numbers"], (*_RUN, *_MODEL))
    return answer.answer


def summary_of_run(config: Any, folder: Path) -> Any:
    """The `RunSummary` of a whole run into a folder."""
    from workflow.kinds import kind_of, summarise
    from workflow.tasks.pipeline import run_pipeline

    return summarise(run_pipeline(config, folder, kind=kind_of(config)), config)


def example(name: str, golden: bool = True) -> Answer:
    """A whole run of an example: its numbers, and which of its margins are off `margins.toml`."""
    from tests.golden import margins
    from workflow.config.run_config import load_config

    os.environ["FLEXLINK_DATA"] = str(DATA)
    config, _ = load_config(ROOT / "examples" / f"{name}.toml")
    with scratch() as folder:
        answer = of_run(summary_of_run(config, folder / "run"))
        off = margins.moved(name, margins.of_run(folder / "run"))
    answer["said"]["off tests/golden/margins.toml"] = sorted(off)
    return answer


# A run that kills itself once a stage is done.
_KILLED = """
import os, signal, sys
from pathlib import Path
from workflow.config.run_config import load_config
from workflow.engine.progress import Progress
from workflow.tasks.pipeline import run_pipeline

class Killing(Progress):
    def finish(self, stage, seconds, *, taken_up):
        if stage == "design":
            os.kill(os.getpid(), signal.SIGKILL)

run_pipeline(load_config(Path(sys.argv[1]))[0], Path(sys.argv[2]), progress=Killing())
"""


# They name times and processes.
_DIFFERS = ("manifest.json", "timings.json", "lock")


def _contents(folder: Path) -> dict[str, bytes]:
    """Contents of a folder's files by their path, but for those that name times."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in _DIFFERS)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def resumed() -> Answer:
    """A run that is killed half-way and taken up again: which of its files have other bytes than those of a
    run that was left alone."""
    from tests.workflow.command import FAST_ARM
    from workflow.config.run_config import load_config
    from workflow.tasks.pipeline import run_pipeline

    config = load_config(FAST_ARM)[0]
    answer = Kept()
    with scratch() as folder:
        answer.answer |= of_run(summary_of_run(config, folder / "whole"))
        call = [sys.executable, "-c", _KILLED, FAST_ARM, folder / "stopped"]
        answer("said", killed=subprocess.run(call, cwd=ROOT, check=False).returncode)
        answer("said", stages_before=sorted(path.name for path in (folder / "stopped" / "stages").iterdir()))
        run_pipeline(config, folder / "stopped", resume=True)
        whole = _contents(folder / "whole")
        taken_up = _contents(folder / "stopped")
    names = sorted(whole.keys() | taken_up.keys())
    answer("said", files=names, other=[name for name in names if whole.get(name) != taken_up.get(name)])
    return answer.answer


# ---- controllers


def random_design(seed: int) -> Answer:
    from benchmarks.random_designs import LOW_EFFORT, random_case, unstable_samples
    from control_design import SpecificationError, certify, synthesise

    plant, posterior, specification = random_case(seed)
    try:
        result = synthesise([plant], specification, LOW_EFFORT, rng=np.random.default_rng(seed))
    except SpecificationError as error:
        return {"lines": {"refused": str(error)}}
    certificate = certify(result.controller, [plant], specification)
    verdict = certificate.plants[0]
    answer = Kept()
    answer("said", outcome=result.outcome.name, certified=certificate.certified, stable=verdict.stable)
    answer("said", proved=verdict.all_frequencies.proved)
    answer("said", unstable=unstable_samples(result.controller, posterior, np.random.default_rng([seed, 2])))
    answer("margins", synthesis=result.gamma, gamma=certificate.gamma, bound=verdict.all_frequencies.gamma)
    answer("margins", **_margins(verdict.worst_margins))
    return answer.answer


def _margins(worst: Any) -> dict[str, float]:
    return {name: getattr(worst, name) for name in ("modulus", "gain_up", "phase_rad", "delay_s")}


def flexible_link(scenario: str) -> Answer:
    from control_design import certify, synthesise, youla_bracket
    from control_design.convex.convex_options import YoulaOptions
    from validation import example_plants

    asked = example_plants.flexible_link_specification(5)
    plant = example_plants.flexible_link(scenario)
    result = synthesise([plant], asked, rng=np.random.default_rng(0))
    certificate = certify(result.controller, [plant], asked)
    answer = Kept()
    answer("said", outcome=result.outcome.name, certified=certificate.certified)
    answer("margins", gamma=certificate.gamma, youla=youla_bracket(plant, asked, YoulaOptions()).ellipse)
    answer("margins", **_margins(certificate.plants[0].worst_margins))
    return answer.answer


def two_joints(case: str) -> Answer:
    from benchmarks.mimo_designs import CASES, judged
    from control_design import MultivariableOptions, certify_multivariable, synthesise_multivariable

    plant, specification = (make() for make in CASES[case])
    options = MultivariableOptions()
    result = synthesise_multivariable(plant, specification, options)
    certificate = certify_multivariable(result.controller, plant, specification)
    answer = Kept()
    verdict = certificate.verdicts[0]
    answer("said", met=certificate.met, stable=verdict.stable)
    answer("margins", synthesis=result.gamma, judge=judged(case, result.controller))
    answer("margins", **{f"bound {name}": value for name, value in verdict.bounds.items()})
    return answer.answer


def joints_run() -> Answer:
    """A whole run for two simulated joints, as small as tests have it."""
    from tests.workflow.test_joints import _JOINTS, _REST, _SOURCE
    from workflow.kinds import load_any

    with scratch() as folder:
        (folder / "two.toml").write_text(_SOURCE + _JOINTS + _REST)
        summary = summary_of_run(load_any(folder / "two.toml")[0], folder / "run")
    answer = Kept()
    answer("said", certified=summary.certified)
    answer("lines", verdict=summary.verdict)
    for path, value in _flat(summary.to_document()["numbers"]):
        if isinstance(value, bool | int | str):
            answer("said", **{".".join(path): value})
        elif isinstance(value, float):
            answer("margins", **{".".join(path): value})
    return answer.answer


# ---- models from logs


def simulated_effects() -> Answer:
    """What each effect adds to the outputs of the paper's link, rms."""
    from plant import parse_effect, simulate
    from tests.plant.test_effects import EXAMPLES, RIG, VOLTAGE

    still = simulate(RIG, VOLTAGE, ()).output
    answer = Kept()
    for name, size in EXAMPLES.items():
        added = simulate(RIG, VOLTAGE, [parse_effect({"name": name, **size})]).output - still
        hub, tip = np.sqrt(np.mean(added**2, axis=0)).tolist()
        answer("model", **{f"{name} hub": hub, f"{name} tip": tip})
    return answer.answer


def planned() -> Answer:
    """`flexlink excite` for the paper's link: what the plan states."""
    limits = "--band 0.5 40 --dt-s 0.005 --duration 60 --voltage 10 --rig paper_link --angle 30"
    with scratch() as folder:
        code, _, lines = flexlink("excite", "--out", folder / "plan", *limits.split(), folder=folder)
        plan = json.loads((folder / "plan" / "plan.json").read_text("utf-8"))
        answer = Kept()
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines))
    for record in plan["records"]:
        answer(
            "model",
            **{f"{record['file']} {key}": record[key] for key in ("peak_V", "rms_V", "peak_angle_deg")},
        )
    return answer.answer


def identified(**options: Any) -> Answer:
    """Weak records of the default arm with dry friction, as in `readme_identify`."""
    from benchmarks.readme_identify import weak_records
    from ident import IdentOptions
    from workflow.config.run_config import SimulatedSource, built_in_config
    from workflow.tasks.log_identification import identify_records

    source = built_in_config()[0].source
    band = options.pop("band_rad_s", None)
    seed = options.pop("seed")
    assert isinstance(source, SimulatedSource)
    options_of_fit = IdentOptions(integrators=1, input_delay_samples=1, **options)
    identified = identify_records(
        weak_records(source, seed), (), options_of_fit, band_rad_s=band, with_plot=False
    )
    answer = Kept()
    answer(
        "said",
        modes=len(identified.about.modes),
        true_modes=sum(map(identified.about.is_mode, identified.about.modes)),
    )
    for k, mode in enumerate(identified.about.modes):
        answer("model", **{f"mode {k} Hz": mode.frequency_Hz, f"mode {k} damping": mode.damping})
        if identified.spread.intervals is not None:
            low, high = identified.spread.intervals.modes[k].frequency_Hz
            answer("spread", **{f"mode {k} from Hz": low, f"mode {k} to Hz": high})
    return answer.answer


def without_friction(torque_Nm: float, seed: int) -> Answer:
    """Level of dry friction and ellipses without it, as in the benchmark of this name."""
    from benchmarks import without_friction as bench
    from workflow.config.run_config import SimulatedSource, built_in_config

    config, _ = built_in_config()
    assert isinstance(config.source, SimulatedSource)
    source = bench.with_friction(config.source, torque_Nm, 16384)
    records = bench.estimation_records(source, seed)
    friction, arms = bench.behind_friction(records, config.channels)
    truth = bench.true_responses(source, bench.OMEGA_RAD_S).T
    answer = Kept()
    answer("model", level=friction.level)
    answer("spread", level_std=friction.level_std)
    for name, arm, true in zip(("hub", "tip"), arms, truth, strict=True):
        judged = bench.judged(arm.response.at(bench.OMEGA_RAD_S), true)
        answer("spread", **{f"{name} {row}": float(judged[row].median()) for row in ("error", "radius")})
        answer("spread", **{f"{name} inside": float(judged["inside"].mean())})
    return answer.answer


def _logs(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if {".csv", ".gz"} & set(path.suffixes))


def drafted(folder_of_logs: Path, keep: Path | None = None) -> Answer:
    """What `flexlink init` makes of logs: every key of the configuration. keep: where that stays."""
    import tomllib

    logs = _logs(folder_of_logs)
    answer = Kept()
    with scratch() as folder:
        config = keep or folder / "my.toml"
        code, _, lines = flexlink("init", *logs, "--out", config, folder=folder_of_logs)
        answer("said", exit=code)
        if code:
            answer("lines", refused=" | ".join(lines))
            return answer.answer
        document = tomllib.loads(config.read_text("utf-8"))
    document["source"]["records"] = [Path(record["path"]).name for record in document["source"]["records"]]
    for path, value in _flat(document):
        answer("sizes" if isinstance(value, float) else "said", **{".".join(path): value})
    return answer.answer


# What says nothing about a log and takes half the time of a run.
_SHORT = {
    "achievable_performance": {"compute": False},
    "closed_loop": {"draws": 2, "conditions": False, "sensitivity": False},
}


def loop_run(folder_of_logs: Path, rows: int | None = None) -> Answer:
    """`flexlink init` and a run of what it drafts, of the first `rows` lines of every log, where stated."""
    import tomlkit

    from workflow.config.run_config import load_config
    from workflow.engine.errors import InputError, StageError

    with scratch() as folder:
        (folder / "logs").mkdir()
        for path in _logs(folder_of_logs):
            part = folder / "logs" / path.name.removesuffix(".gz")
            text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
            part.write_bytes(b"".join(text.splitlines(keepends=True)[:rows]))
        answer = drafted(folder / "logs", keep=folder / "my.toml")
        if answer["said"]["exit"]:
            return answer
        document = tomlkit.parse((folder / "my.toml").read_text("utf-8"))
        for section, values in _SHORT.items():
            document.setdefault(section, tomlkit.table()).update(values)
        (folder / "my.toml").write_text(tomlkit.dumps(document), "utf-8")
        try:
            of_the_run = of_run(summary_of_run(load_config(folder / "my.toml")[0], folder / "run"))
        except (InputError, StageError) as error:
            of_the_run = {"lines": {"refused": str(error).replace(f"{folder}/", "")}}
    return {kind: answer.get(kind, {}) | of_the_run.get(kind, {}) for kind in {**answer, **of_the_run}}


def made_loop(kind: str, seed: int, *, run: bool) -> Answer:
    """What is drafted from logs of a generated machine, or what comes out of a run as well."""
    from benchmarks.closed_loop_machines.logs import machine, write

    with scratch() as folder:
        logs = write(machine(kind, seed, 4), folder / "logs", folder / "truth")
        return (loop_run if run else drafted)(Path(logs[0]).parent)


# ---- causes


def diagnosed(case: Any, truth: Sequence[str] = ()) -> Answer:
    """Verdict, named effects with their sizes, probabilities of sets, gaps."""
    from diagnosis import diagnose

    diagnosis = diagnose(case)
    answer = Kept()
    entries = {e.name: e for e in diagnosis.effects}
    named = diagnosis.combination or diagnosis.partial_model
    answer(
        "said",
        verdict=diagnosis.verdict,
        detail=diagnosis.detail_verdict,
        effects=sorted(diagnosis.combination),
    )
    answer("said", partly=sorted(diagnosis.partial_model), truth=sorted(truth))
    for name in named:
        answer("sizes", **{f"{name} {key}": value for key, value in entries[name].parameters.items()})
    sets = {" + ".join(key) or "none": float(p) for key, p in diagnosis.sets.items() if p >= 0.02}
    answer("probabilities", **sets)
    answer("gaps", before=diagnosis.gap_before, refit=diagnosis.gap_refit, after=diagnosis.gap_after)
    return answer.answer


def shared_case(place: str) -> Answer:
    """The diagnosis of a folder below the shared cases.

    place: the folder, with `:` and the rig file behind it where that is not the usual one.
    """
    import tomllib

    from workflow.diagnose.case_files import load_case

    folder, _, rig = place.partition(":")
    answer = GAP / folder / "answer.toml"
    label = tomllib.loads(answer.read_text("utf-8")) if answer.is_file() else {}
    names = [e["name"] for e in label.get("effects", ())] or [label.get("verdict")]
    return diagnosed(load_case(GAP / folder, rig or None).case, list(filter(None, names)))


def own_case(*effects: Mapping[str, Any], rig: str | None = None) -> Answer:
    """Four short records of the paper's link with these effects."""
    from tests.workflow.diagnosis_examples import write_case
    from workflow.diagnose.case_files import load_case

    with scratch() as folder:
        case = load_case(write_case(folder / "case", *map(dict, effects)), rig).case
        return diagnosed(case, [str(e["name"]) for e in effects])


def diagnosed_by_command() -> Answer:
    """`flexlink diagnose` of four short records: what its document says beside the answer itself."""
    from tests.workflow.diagnosis_examples import write_case

    with scratch() as folder:
        case = write_case(folder / "case", dict(_FRICTION))
        words = case, "--out", folder / "out", "--json", "--quiet"
        code, out, lines = flexlink("diagnose", *words, folder=folder)
    answer = Kept()
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines))
    answer.picked(json.loads(out)["cases"][0] if out else {}, _DOCUMENT)
    return answer.answer


_DOCUMENT = (
    (r"verdict|detail_verdict|decided", "said"),
    (r"(where|controller|completeness)\..*(verdict|place|kind|name|certified)", "said"),
    (r"next_experiment\.(kind|advice)", "said"),
    (r"next_experiment\.(amplitude_V|duration_s|parameters\..*)", "sizes"),
    (r"gap_.*", "gaps"),
)


def checked(case: Path) -> Answer:
    """`flexlink check`: what logs can tell of a model."""
    code, out, lines = flexlink("check", case, "--json", folder=case.parent)
    answer = Kept()
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines), **({"verdict": json.loads(out)["verdict"]} if out else {}))
    for row in json.loads(out)["table"] if out else ():
        answer("lines", **{f"{row['section']} {row['label']}": row["value"]})
    return answer.answer


def mujoco_case(number: int, seed: int = 7352) -> Answer:
    from benchmarks.mujoco_cases import case_of

    truth, case = case_of(number, seed)
    return diagnosed(case, [truth.name])


def real_case(module: str, *arguments: Any) -> Answer:
    """A measured machine as a plant of one's own."""
    import importlib

    return diagnosed(importlib.import_module(f"benchmarks.{module}").case(DATA, *arguments))


def fleet() -> Answer:
    """Three carriages by `flexlink diagnose`, in two processes."""
    from benchmarks.fleet import write_fleet

    with scratch() as folder:
        cases = write_fleet(folder / "cases", 3, samples=150)
        words = *cases, "--out", folder / "out", "--jobs", "2", "--json", "--quiet"
        code, out, lines = flexlink("diagnose", *words, folder=folder)
    answer = Kept()
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines))
    for case in json.loads(out)["cases"] if out else ():
        effects = [e for e in case["effects"] if e["probability"] > 0.5]
        answer("said", **{f"{case['case']} verdict": case["verdict"]})
        answer("sizes", **{f"{case['case']} {k}": v for e in effects for k, v in e["parameters"].items()})
        answer("probabilities", **{f"{case['case']} {e['name']}": e["probability"] for e in effects})
    return answer.answer


def study() -> Answer:
    """Two points by `flexlink study`, in two processes: the table."""
    from tests.workflow.study_examples import TWO_POINTS

    with scratch() as folder:
        (folder / "study.toml").write_text(TWO_POINTS)
        words = "--config", folder / "study.toml", "--jobs", "2", "--out", folder / "out", "--quiet"
        code, _, lines = flexlink("study", *words, folder=folder)
        file = folder / "out" / "table.json"
        answer = Kept()
        table = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines))
    answer.picked(_without_digests(table), _STUDY)
    return answer.answer


_STUDY = (
    (r"points\..*\.(outcome|certified|error|verdict)", "said"),
    (r"points\..*\.numbers\..*", "margins"),
)


def _without_digests(table: Any) -> Any:
    """A point's name ends with the digest of its configuration."""
    return json.loads(re.sub(r"_[0-9a-f]{10}\b", "", json.dumps(table)))


# ---- logs


def forty_logs(*endings: str) -> Answer:
    """What is read from the logs of tests/ident/test_forty_logs.py with these endings: sampling, columns, the
    sums of their magnitudes."""
    from ident import Record
    from tests.ident.test_forty_logs import LOGS

    answer = Kept()
    for name, log in LOGS.items():
        if Path(log.file).suffix[1:] not in endings:
            continue
        with scratch() as folder:
            path = folder / log.file
            path.write_bytes(log.content if isinstance(log.content, bytes) else log.content())
            time, *columns = log.columns
            try:
                record = Record.from_file(path, columns[:1], columns[1:], time=time, **log.options)
            except ValueError as error:
                answer("lines", **{name: str(error).replace(f"{folder}/", "")})
                continue
        signals = zip(
            (*record.input_names, *record.output_names),
            (*record.input_units, *record.output_units) or ("", ""),
            np.hstack([record.input, record.output]).T,
            strict=False,
        )
        in_words = [f"{column} [{unit}] {np.sum(np.abs(values)):.6g}" for column, unit, values in signals]
        line = f"{len(record.input)} rows every {record.dt_s:.6g} s: {', '.join(in_words)}"
        answer("lines", **{name: line + (", repaired" if record.repair else "")})
    return answer.answer


def generated_logs(first: int, count: int) -> Answer:
    """What becomes of logs of the oracle, and the words that say why."""
    from benchmarks.log_oracle import outcome
    from tests.ident.generated_logs import generated

    answer = Kept()
    with scratch() as folder:
        for number in range(first, first + count):
            what, why = outcome(generated(47, number, 1.0), folder)
            answer("said", **{str(number): what})
            answer("lines", **({str(number): " ".join(why.split())} if why else {}))
    return answer.answer


_LOOK = (
    (r"rows|layout\.(separator|decimal|names|units\..*|header|first)", "said"),
    (r"time\.(name|unit|rounded|missing|option)|response\.(points|frequencies|spread|why)", "said"),
    (r"columns\..*\.(unit|refused)", "said"),
    (r"time\.period_s|response\.(low|high)_Hz|columns\..*\.(lowest|highest|step)", "model"),
)


def looked_at(log: Path) -> Answer:
    """`flexlink look` at a log."""
    code, out, lines = flexlink("look", log, "--json", folder=log.parent)
    answer = Kept()
    answer("said", exit=code)
    answer("lines", error=" | ".join(lines))
    if out:
        document = json.loads(out)
        answer("lines", verdict=document["verdict"])
        answer.picked(document["numbers"], _LOOK)
    return answer.answer


_EXACT = {
    "labelled/backlash": False,
    "labelled/none:rig_uncertain.toml": False,
    "labelled/unlisted_effect": False,
    "labelled/faint_viscous_friction:rig_uncertain.toml": False,
    "sealed/case-12": False,
    "sealed/case-06": True,
    "labelled/gravity:rig_uncertain.toml": True,
    "labelled/coulomb_friction_and_tip_payload": True,
    "labelled/coulomb_friction_and_tip_payload:rig_uncertain.toml": True,
}
_WORKSHOP = {
    **dict.fromkeys(("labelled/work-05", "labelled/work-06", "labelled/work-15"), False),
    **dict.fromkeys((f"labelled/work-{k:02d}" for k in (9, 18, 19, 22)), True),
    **dict.fromkeys((f"sealed/case-{k:02d}" for k in (6, 9, 12, 16)), True),
}
_FRICTION = {"name": "coulomb_friction", "torque_Nm": 0.05}
_PAYLOAD = {"name": "tip_payload", "mass_kg": 0.02}
_LOGS = (
    "emps/emps_train.csv",
    "slfr_krauss_2009/swept_sine_amp50_rep1.csv",
    "quanser_2dsfl/lqr_run.csv",
    "daisy_robot_arm/robot_arm.csv",
    "quanser_rfl_frf/frf_repeats.csv",
)


def _questions() -> Iterator[tuple[str, Question]]:
    yield "margins default_arm", Question(partial(example, "default_arm"))
    for name, slow in (("daisy_robot_arm", False), ("slfr_krauss_2009", True)):
        yield f"margins {name}", Question(partial(example, name), (DATA / name,), slow)
    for seed in (0, 2, 3, 7, 9, 13, 20, 25, 32, 49, 145):
        yield f"random design {seed}", Question(partial(random_design, seed))
    for scenario in "ABC":
        yield f"flexible link {scenario}", Question(partial(flexible_link, scenario))
    for case, slow in (("T, full", False), ("T, decentralised", True), ("T, ball x 3", True), ("D", True)):
        yield f"two joints {case}", Question(partial(two_joints, case), slow=slow)
    yield "two joints, a whole run", Question(joints_run)
    yield "simulated effects", Question(simulated_effects)
    yield "planned experiment", Question(planned)
    for name, options in (
        ("orders given", {"seed": 0, "n_real": 1, "n_pairs": 2}),
        ("band 10 600", {"seed": 1, "band_rad_s": (10.0, 600.0)}),
        ("white noise", {"seed": 2, "noise": "white", "n_real": 1, "n_pairs": 2}),
    ):
        yield f"identified with friction, {name}", Question(partial(identified, **options))
    for torque_Nm in (0.0, 0.02, 0.1):
        yield f"without friction {torque_Nm:g} N m", Question(partial(without_friction, torque_Nm, 0))
    for name in ("geared_joint", "hanging_arm", "joint_without_reference", "lagging_drive", "turntable"):
        folder = MACHINES / name
        yield f"loop drafted, {name}", Question(partial(drafted, folder), (folder,))
    folder = MACHINES / "rigid_axis"
    yield "loop run, rigid_axis", Question(partial(loop_run, folder, 1500), (folder,))
    yield "loop drafted, fast 3", Question(partial(made_loop, "fast", 3, run=False))
    for kind, seed in (("belt", 3), ("joint", 3), ("pendulum", 3)):
        yield f"loop run, {kind} {seed}", Question(partial(made_loop, kind, seed, run=True))
    for place, slow in _EXACT.items():
        yield f"exact {place}", Question(partial(shared_case, place), (GAP / place.partition(":")[0],), slow)
    for name, effects in (("friction", (_FRICTION,)), ("payload", (_PAYLOAD,)), ("nothing", ())):
        yield f"exact, four short records: {name}", Question(partial(own_case, *effects))
    yield "diagnose command", Question(diagnosed_by_command)
    for name in ("gap_case", "mujoco_arm/arm.toml"):
        yield f"check {name}", Question(partial(checked, ROOT / "examples" / name))
    for place, slow in _WORKSHOP.items():
        folder = GAP / "workshop" / place
        yield f"workshop {place}", Question(partial(shared_case, f"workshop/{place}"), (folder,), slow)
    for number in (4, 7, 8, 21, 23, 60, 78):
        yield f"MuJoCo case {number}", Question(partial(mujoco_case, number))
    for name, needs, slow, *arguments in (
        ("EMPS", "emps", False, "emps_axis", "passes"),
        ("EMPS in its loop", "emps", False, "emps_axis", "fast", "loop"),
        ("2DSFL stage 1", "quanser_2dsfl", True, "serial_link_stage", 1),
        ("2DSFL stage 2", "quanser_2dsfl", False, "serial_link_stage", 2),
        ("SLFR", "slfr_krauss_2009", False, "ruler_robot"),
    ):
        yield f"real {name}", Question(partial(real_case, *arguments), (DATA / needs,), slow)
    for log in _LOGS:
        yield f"look at {log}", Question(partial(looked_at, DATA / log), (DATA / log,))
    for endings in (("csv",), ("txt", "tsv", "dat", "gz"), ("npz", "mat"), ("xlsx", "xls"), ("parquet", "h5"),
                    ("mcap", "db3", "bag")):  # fmt: skip
        yield f"forty logs, {' '.join(endings)}", Question(partial(forty_logs, *endings))
    for first in (0, 10):
        yield f"generated logs from {first}", Question(partial(generated_logs, first, 10))
    yield "resumed run", Question(resumed)
    yield "study of two points", Question(study)
    yield "fleet of three", Question(fleet)


QUESTIONS: dict[str, Question] = dict(_questions())
