"""Fits the coefficients by which a diagnosis beside a model error names effects, and says how good they are.

Cases of known truth are made on every kind of machine, with causes that are on the list of effects and with
causes that are on no list: rigs of the workshop, MuJoCo arms, MuJoCo arms whose effect is taken off the list,
and made machines (`beyond_the_list`). Each is diagnosed, and the features of everything that its search has
fitted are kept, one line of JSON a case in --folder: a run that was killed goes on there, and several with
--no-fit may fill the files of different routes at the same time (the others with a count of 0). Then the
coefficients are fitted (`naming_fit`) and judged by cross-validation. --store writes them to
diagnosis/judge/naming_model.toml, --picture draws what was said against what was right.

Left out are cases that the other judge answers (it knows the noise), and MuJoCo cases of which the nominal
with re-estimated values leaves less than 1.2 model errors: their tolerances hide the cause, and no answer is
wrong. Of a machine that is looked at in windows as well, features are those of the free run. Neglected: which
sets are fitted at the end depends a little on the coefficients in use, by what the judge asks the search for.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from benchmarks.beyond_the_list import LEAST_SHARE, LabelledCase, made_case
from benchmarks.harness import Print, Results, main, timed
from benchmarks.mujoco_cases import KINDS, case_of
from benchmarks.naming_fit import (
    COEFFICIENTS,
    FOLDS,
    SAID,
    TABLES,
    Outcome,
    TrainingCase,
    TrainingSet,
    cross_validated,
    fitted,
    table,
)
from diagnosis import diagnose
from diagnosis.judge import naming_model
from diagnosis.judge.judgement import Judge
from diagnosis.judge.model_error import BesideModelError
from diagnosis.judge.naming_model import NamingModel
from diagnosis.judge.set_features import EffectFeatures, features_of_effects, features_of_sets, share_left
from diagnosis.judge.verdict import explanations_to_judge
from diagnosis.repair.stability import shares_of_sets
from validation.blind.generate import case_name, generate
from workflow.diagnose.case_files import load_case

# Seeds of the routes, none of which any other benchmark or series has.
SEEDS = {"mujoco": 5001, "made": 5002, "workshop": 5003, "mujoco_off_list": 5004}
# MuJoCo cases that there are of a seed.
MUJOCO_CASES = 2 * len(KINDS)
# Where the coefficients are stored.
MODEL_FILE = Path(naming_model.__file__).with_name("naming_model.toml")
# Edges of the ranges of the picture. Most effects are said to be next to certainly absent.
PRESENCE_EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.8, 1.0)
ANSWER_EDGES = (SAID[0][0], *(high for _, high in SAID))
# Why a case is left out.
OTHER_JUDGE = "the other judge answers: noise is known"
HIDDEN = "tolerances hide the cause"


# --- Cases of known truth ---


def workshop_case(seed: int, count: int, number: int) -> LabelledCase:
    """The number-th of `count` cases of independent rigs; another count makes other cases."""
    names = [case_name(k) for k in range(count)]
    # Cases that count as finished are not made.
    finished: dict[str, dict[str, Any]] = {name: {} for name in names if name != names[number]}
    with tempfile.TemporaryDirectory() as folder:
        answers = generate(count, seed, Path(folder), workshop=True, finished=finished)
        case = load_case(Path(folder) / names[number]).case
    answer = answers[number]
    present = tuple(effect["name"] for effect in answer["effects"])
    unlisted = tuple(cause["name"] for cause in answer["unlisted"])
    return LabelledCase("workshop", case, present, unlisted, {})


def mujoco_case(seed: int, number: int) -> LabelledCase:
    """The number-th MuJoCo case in an order that is drawn, so that the first ones are a sample of all.

    Raises
    ------
    ValueError
        If there are fewer.
    """
    order = np.random.default_rng(seed).permutation(MUJOCO_CASES).tolist()
    if not number < len(order):
        raise ValueError(f"there are {len(order)} MuJoCo cases of a seed; ask for no more")
    truth, case = case_of(order[number], seed)
    present = () if truth.effect == "none" else (truth.name,)
    return LabelledCase("mujoco", case, present, (), {})


def mujoco_case_off_list(seed: int, number: int) -> LabelledCase:
    """The number-th MuJoCo case with an effect, which is taken off the list.

    Raises
    ------
    ValueError
        If there are fewer.
    """
    order = np.random.default_rng(seed).permutation(MUJOCO_CASES).tolist()
    order = [k for k in order if KINDS[k % len(KINDS)][0] != "none"]
    if not number < len(order):
        raise ValueError(f"there are {len(order)} MuJoCo cases with an effect of a seed; ask for no more")
    truth, case = case_of(order[number], seed)
    plant = case.plant
    effects = tuple(effect for effect in plant.effects if effect.name != truth.name)
    tolerances = {key: t for key, t in plant.tolerances.items() if f"wrong_{key}" != truth.name}
    case = replace(case, plant=replace(plant, effects=effects, tolerances=tolerances))
    return LabelledCase("mujoco", case, (), (truth.name,), {})


@dataclass(frozen=True)
class Route:
    """A series of cases.

    Attributes
    ----------
    name : str
        Of its file of features.
    count : int
    case : callable
        Number, from 0 -> case.
    """

    name: str
    count: int
    case: Callable[[int], LabelledCase]


def routes(*, workshop: int, mujoco: int, mujoco_off_list: int, made: int) -> tuple[Route, ...]:
    """The four series with so many cases each."""
    rigs = partial(workshop_case, SEEDS["workshop"], workshop)
    return (
        # Which cases a series of the workshop has depends on how many there are.
        Route(f"workshop_{SEEDS['workshop']}_of_{workshop}", workshop, rigs),
        Route(f"mujoco_{SEEDS['mujoco']}", mujoco, partial(mujoco_case, SEEDS["mujoco"])),
        Route(
            f"mujoco_off_list_{SEEDS['mujoco_off_list']}",
            mujoco_off_list,
            partial(mujoco_case_off_list, SEEDS["mujoco_off_list"]),
        ),
        Route(f"made_{SEEDS['made']}", made, partial(made_case, SEEDS["made"])),
    )


# --- Features of a case ---


@contextmanager
def answering_judges() -> Iterator[list[Judge[Any]]]:
    """A list of the judges that have answered since, in their order."""
    judges: list[Judge[Any]] = []
    recorded = Judge.recorded

    def recorded_and_kept(self: Judge[Any], *arguments: Any, **fields: Any) -> Any:
        judges.append(self)
        return recorded(self, *arguments, **fields)

    with mock.patch.object(Judge, "recorded", recorded_and_kept):
        yield judges


def training_case(labelled: LabelledCase) -> TrainingCase | str:
    """What the search of a diagnosis has fitted, in features; or why the case is left out."""
    with answering_judges() as judges, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnose(labelled.case)
    freely = [each for each in judges if isinstance(each, BesideModelError) and not each.search.windows]
    if not isinstance(judges[-1], BesideModelError) or not freely:
        return OTHER_JUDGE

    judge = freely[-1]
    search = judge.search
    weighing = search.case.machine.weighing
    # Nobody knows the true shares of MuJoCo cases. What is left without effects has the cause in it.
    has_cause = labelled.route == "mujoco" and bool(labelled.present or labelled.unlisted)
    if has_cause and share_left(search.nominal_alone) < LEAST_SHARE * weighing.model_error:
        return HIDDEN

    explanations = explanations_to_judge(search, judge.judgement.nominal)
    sets = tuple(
        TrainingSet(
            of_set.log_prior,
            of_set.features,
            of_set.rest_features,
            of_set.repair_share,
            features_of_effects(search, of_set.explanation, explanations),
        )
        for of_set in features_of_sets(search, explanations, shares_of_sets(judge.trials))
    )
    return TrainingCase(
        labelled.route,
        labelled.case.name,
        weighing.listed,
        frozenset(labelled.present),
        weighing.stated,
        bool(labelled.unlisted),
        sets,
    )


def line_of(found: TrainingCase | str) -> str:
    """One line of JSON: a case, or why it is left out."""
    if isinstance(found, str):
        return json.dumps({"left_out": found})
    return json.dumps({"feature_names": TABLES, **asdict(found), "present": sorted(found.present)})


def case_of_line(line: str) -> TrainingCase | str:
    """The inverse of `line_of`.

    Raises
    ------
    ValueError
        If the line has other features than this version.
    """
    stored = json.loads(line)
    if "left_out" in stored:
        return str(stored["left_out"])
    if stored["feature_names"] != {title: list(names) for title, names in TABLES.items()}:
        raise ValueError("made with other features than this version has; delete the file")
    sets = []
    for stored_set in stored["sets"]:
        effects = [
            EffectFeatures(**{**effect, "features": tuple(effect["features"])})
            for effect in stored_set["effects"]
        ]
        sets.append(
            TrainingSet(
                stored_set["log_prior"],
                tuple(stored_set["features"]),
                tuple(stored_set["rest_features"]),
                stored_set["repair_share"],
                tuple(effects),
            )
        )
    return TrainingCase(
        stored["route"],
        stored["name"],
        tuple(stored["listed"]),
        frozenset(stored["present"]),
        stored["model_error_is_stated"],
        stored["has_unlisted"],
        tuple(sets),
    )


def collected(route: Route, folder: Path) -> list[TrainingCase | str]:
    """Cases of a route; those that its file in the folder lacks are made and added to it.

    Raises
    ------
    ValueError
        With file and line, if a line has other features than this version.
    """
    file = folder / f"{route.name}.jsonl"
    lines = file.read_text("utf-8").splitlines(keepends=True) if file.exists() else []
    # A run that was killed may have left half a line.
    whole = [line for line in lines if line.endswith("\n")]
    if whole != lines:
        file.write_text("".join(whole), encoding="utf-8")
    cases = []
    for number, line in enumerate(whole[: route.count]):
        try:
            cases.append(case_of_line(line))
        except ValueError as error:
            raise ValueError(f"{file}, line {number + 1}: {error}") from None
    for number in range(len(cases), route.count):
        labelled = route.case(number)
        case, cpu_s = timed(partial(training_case, labelled))
        with file.open("a", encoding="utf-8") as end:
            end.write(line_of(case) + "\n")
        cases.append(case)
        truth = ", ".join((*labelled.present, *(f"({name})" for name in labelled.unlisted))) or "none"
        result = case if isinstance(case, str) else f"{len(case.sets)} sets"
        print(f"{route.name} {number + 1}: {truth}: {result} ({cpu_s:.1f} s)", flush=True)
    return cases


# --- What is told ---


def by_route_and_truth(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes by the name of their group: "all", each route, and each sort of truth."""
    groups: dict[str, list[Outcome]] = {"all": list(outcomes)}
    for route in sorted({each.case.route for each in outcomes}):
        groups[route] = [each for each in outcomes if each.case.route == route]
    for title, has_effect, has_unlisted in (
        ("nothing is there", False, False),
        ("effects of the list", True, False),
        ("a cause on no list", False, True),
        ("both", True, True),
    ):
        groups[title] = [
            each
            for each in outcomes
            if bool(each.case.present) == has_effect and each.case.has_unlisted == has_unlisted
        ]
    return groups


def coefficients(model: NamingModel) -> dict[str, dict[str, float]]:
    """Table -> name -> value."""
    values = {"set": model.of_set, "effect": model.of_effect, "rest": model.of_rest}
    return {
        title: {name: float(value) for name, value in zip(names, values[title], strict=True)}
        for title, names in TABLES.items()
    }


def model_toml(model: NamingModel, head: str, counts: Mapping[str, int]) -> str:
    """Text of the coefficient file.

    Parameters
    ----------
    model : NamingModel
    head : str
        First line of the results: command, seeds, commit, date.
    counts : mapping
        Route -> number of cases that were fitted to.
    """
    cases = ", ".join(f"{count} {route}" for route, count in counts.items())
    lines = [
        "# Coefficients of `diagnosis.judge.naming_model`, fitted to cases of known truth. Not to be edited.",
        head,
        f"# Cases: {cases}.",
    ]
    for title, values in coefficients(model).items():
        lines += ["", f"[{title}]"]
        for name, value in values.items():
            _, meaning = COEFFICIENTS[title][name]
            lines += [f"# {meaning}", f"{name} = {value:.4f}"]
    return "\n".join(lines) + "\n"


def calibration_picture(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draws which share was right of what was said with a probability, with 95 % intervals.

    They are those of Clopper and Pearson. Neglected: presences of one case are no independent trials.
    """
    answers = [(each.said, each.is_right) for each in outcomes]
    presences = [
        (probability, name in each.case.present)
        for each in outcomes
        for name, probability in each.presence.items()
    ]
    figure = Figure(figsize=(6.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="as said")
    for label, marker, edges, pairs in (
        (f"first answer ({len(answers)})", "o", ANSWER_EDGES, answers),
        (f"presence of an effect ({len(presences)})", "s", PRESENCE_EDGES, presences),
    ):
        probabilities = []
        right = []
        below = []
        above = []
        for low, high in pairwise(edges):
            within = [pair for pair in pairs if low <= pair[0] < high or pair[0] == high == 1]
            if not within:
                continue
            share = float(np.mean([is_right for _, is_right in within]))
            interval = binomtest(sum(is_right for _, is_right in within), len(within)).proportion_ci(0.95)
            probabilities.append(float(np.mean([probability for probability, _ in within])))
            right.append(share)
            below.append(max(share - interval.low, 0.0))
            above.append(max(interval.high - share, 0.0))
        axes.errorbar(probabilities, right, yerr=[below, above], fmt=marker, capsize=3, label=label)
    axes.set_xlabel("probability that was said (1)")
    axes.set_ylabel("share that was right (1), with 95 % interval")
    axes.set_title(f"Names beside a model error: {len(outcomes)} cases, cross-validated")
    # Marks at 0 and 1 are whole.
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(path)


def run(
    out: Print,
    *,
    folder: str = "build/naming",
    workshop: int = 48,
    mujoco: int = 60,
    mujoco_off_list: int = 20,
    made: int = 200,
    fit: bool = True,
    store: bool = False,
    picture: str = "",
) -> None:
    """Make the cases, fit to them, and tell.

    Parameters
    ----------
    out : callable
    folder : str
        Of the features, one file a route.
    workshop, mujoco, mujoco_off_list, made : int
        Cases of each route, those that are left out counted.
    fit : bool
        False: only make the cases.
    store : bool
        Write diagnosis/judge/naming_model.toml.
    picture : str
        File for the calibration; "": none.
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    collected_cases: list[TrainingCase | str] = []
    for route in routes(workshop=workshop, mujoco=mujoco, mujoco_off_list=mujoco_off_list, made=made):
        collected_cases += collected(route, place)
    cases = [each for each in collected_cases if isinstance(each, TrainingCase)]
    counts = Counter(case.route for case in cases)
    out(f"{len(cases)} cases: {', '.join(f'{count} {route}' for route, count in counts.items())}")
    for reason, count in Counter(each for each in collected_cases if isinstance(each, str)).items():
        out(f"left out {count}: {reason}")
    if not fit:
        return

    model = fitted(cases)
    for title, values in coefficients(model).items():
        out()
        for name, value in values.items():
            out(f"{title:6s} {name:26s} {value:8.3f}   {COEFFICIENTS[title][name][1]}")

    outcomes = cross_validated(cases)
    out()
    out(f"Cross-validated, {FOLDS} folds:")
    for line in table(by_route_and_truth(outcomes)):
        out(line)
    if picture:
        calibration_picture(outcomes, Path(picture))
    if store:
        head = out.head if isinstance(out, Results) else "#"
        MODEL_FILE.write_text(model_toml(model, head, counts), encoding="utf-8")
        out()
        out(f"wrote {MODEL_FILE.name}")


if __name__ == "__main__":
    main(run, seeds=", ".join(f"{route} {seed}" for route, seed in SEEDS.items()))
