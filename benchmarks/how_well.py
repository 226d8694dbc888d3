"""Writes docs/how_well.md from the stored results: `python -m benchmarks.how_well`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from benchmarks import workshop_series
from benchmarks.harness import RESULTS

PAGE = RESULTS.parents[1] / "docs" / "how_well.md"
HEAD = """# How well does it work?

Every number is read from a file in `benchmarks/results`. The first line of that file has the command, seeds
and commit. `python -m benchmarks.how_well` writes this page. See also [limits of the
method](limits_of_the_method.md).
"""


@dataclass(frozen=True)
class Row:
    """One question. pattern: on the text of results/`file`.txt; answer: takes its groups."""

    question: str
    file: str
    pattern: str
    answer: str

    def line(self) -> str:
        text = (RESULTS / f"{self.file}.txt").read_text(encoding="utf-8")
        found = re.search(self.pattern, text, re.DOTALL | re.MULTILINE)
        if found is None:
            raise ValueError(f"{self.file}.txt has no line that answers: {self.question}")
        return f"| {self.question} | {self.answer.format(*found.groups())} | `{self.file}` |"


SECTIONS = {
    "Logs": (
        Row(
            "Generated logs of all kinds, contents known to who wrote them: misread without a word",
            "log_oracle",
            r"^(\d+) logs\nright +(\d+) .*?^asked +(\d+) (?!.*without a word)",
            "0 of {}; {} read right, {} asked",
        ),
    ),
    "Identification": (
        Row(
            "Error of the response, 1 to 100 rad/s, arm with a double integrator, nothing known (median)",
            "identification_p1",
            r"^P1, double.*?^GOBF, nothing known +\S+ +\S+ +(\S+)"
            r".*?^OE 4/4 \(Steig\S+ start\) +\S+ +\S+ +(\S+)",
            "{} of the response; output error with the true order: {}",
        ),
        Row(
            "The same where two integrators and the relative degree are known",
            "identification_p1",
            r"^P1, double.*?^GOBF, known\S* rel\. degree 2, 2 integr\. +\S+ +\S+ +(\S+)",
            "{} of the response",
        ),
        Row(
            "Pole search: runs that end within 0.2 % of the best cost",
            "pole_search_p2",
            r"^as delivered +(\d+)/(\d+) +\S+ +(\d+).*?^the paper's coordinates +(\d+)/",
            "{} of {} with {} evaluations (median); in the paper's coordinates {}",
        ),
        Row(
            "True response inside the 95 % ellipses, linear arm with noise",
            "coverage_p2",
            r"^fixed plant.*?  tangent\n    coverage[\d. ]+reach.*?overall ([\d.]+).*?^  covariance, n = 4\n"
            r".*?overall ([\d.]+)",
            "{} % of frequencies; classical covariance of an order-4 fit: {} %",
        ),
        Row(
            "Two motors and two sensors of a two-link arm: error of the worst channel, median; beside N4SID",
            "several_outputs",
            r"^links:.*?shared poles[^:]*: +[\d.]+ +([\d.]+).*?nfoursid[^:]*: +[\d.]+ +([\d.]+)",
            "{} % of the gain up to 200 rad/s; {} %",
        ),
        Row(
            "The same: 95 % ball holds the response matrix",
            "several_outputs",
            r"^links:.*?ball holds.*?all ([\d.]+)",
            "{} % of frequencies",
        ),
        Row(
            "First mode under dry friction, as recorded: largest error, and 95 % interval holds the truth",
            "readme_identify",
            r"response: as recorded.*?largest error: ([\d.]+) %.*?holds the mode: \[(\d+), \d+\] of (\d+)",
            "{} %, but {} of {}: friction is not in these intervals",
        ),
        Row(
            "The same with the friction identified",
            "readme_identify",
            r"response: without friction.*?largest error: ([\d.]+) %.*?the mode: \[(\d+), \d+\] of (\d+)",
            "{} %, {} of {}",
        ),
        Row(
            "Level of dry friction 0.02 N m, identified with the arm",
            "without_friction",
            r"friction 0\.02 N m: level error ([\d.]+) %, inside its 95 % interval (\d+) %",
            "median error {} %, {} % of intervals hold it",
        ),
    ),
    "Control": (
        Row(
            "Random designs: certified loops that were unstable",
            "random_designs",
            r"designs (\d+), met (\d+), .*?unstable (\d+),",
            "{2} of {1} certified ({0} designs)",
        ),
        Row(
            "Numbers of certificates of controllers made by hand, against eigenvalues: false",
            "controllers_by_hand",
            r"^(\d+) controllers.*?; (\d+) numbers checked\nfalse: (\d+);",
            "{2} of {1} ({0} controllers)",
        ),
        Row(
            "Logs of ten kinds of machines under their controllers, with dry friction: `init` and `run` give "
            "a controller, and 20 steps settle on the nonlinear machine",
            "closed_loop_machines",
            r"^all +\| (\d+) of (\d+) \| (\d+) of (\d+) \| (\d+) of (\d+) \|",
            "{0} of {1} with a reference in the logs, {2} of {3} without; {4} of {5} certificates exceeded",
        ),
        Row(
            "Fresh machines of these kinds, `flexlink run LOG...` with a reference in the logs, two batches",
            "closed_loop_machines_12",
            r"^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)"
            r".*?^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)",
            "{0} of {1}, {4} of {5}; {2} of {3}, {6} of {7} certificates exceeded",
        ),
        Row(
            "Machines of these kinds drawn after that, each kind twice, in two lots of five kinds",
            "closed_loop_machines_13",
            r"^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)"
            r".*?^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)",
            "{0} of {1}, {4} of {5}; {2} of {3}, {6} of {7} certificates exceeded",
        ),
        Row(
            "Six machines, their logs rounded, thinned, shortened, in other units: certificate or first mode "
            "differs",
            "same_log_otherwise",
            r"^(\d+) of (\d+) flipped",
            "{} of {}",
        ),
        Row(
            "Peak of the sensitivity on the nonlinear arm against the prediction",
            "closed_loop_sensitivity",
            r"at 0\.2 rad rms: worst -?([\d.]+) %",
            "within {} %",
        ),
        Row(
            "Landau's flexible transmission, score of the published benchmark",
            "landau_transmission",
            r"direct search: score ([\d.]+), (\d+) parameters, ([\d.]+) s",
            "{} of 100 with {} parameters in {} s",
        ),
    ),
    "Diagnosis": (
        Row(
            "1000 machines on two workers of a cluster, one killed: files that differ from a local run; "
            "memory",
            "fleet",
            r"^far: exit 0, 1000 cases, \d+ s, parent (\d+) MB\n(\d+) files, (\d+) differ",
            "{2} of {1}; {0} MB in the command that waits",
        ),
        Row(
            "MuJoCo arms of one and two joints, one effect each: first answer right; false alarms",
            "mujoco_cases",
            r"first answer right: (\d+ of \d+).*?false alarms: (\d+ of \d+)",
            "{}; {}",
        ),
        Row(
            "EMPS, a real axis: error of mass, friction and offset against the published values",
            "real_machine_gaps",
            r"values: mass_kg \S+ \(([^)]*)\).*?coulomb_N \S+ \(([^)]*)\); offset_N \S+ \(([^)]*)\)",
            "{}, {}, {}",
        ),
        Row(
            "The same: probability that friction is present, and an offset (threshold not stated)",
            "real_machine_gaps",
            r"coulomb_friction \(there with (\S+?)\).*?constant_offset \(there with (\S+?)\)",
            "{}; {}",
        ),
        Row(
            "SLFR, a real flexible arm: probability that friction is present, fitted at 50 and 75; at 50",
            "real_machine_gaps",
            r"^Fitted at 50 and 75.*?coulomb_friction \(there with (\S+?)\)"
            r".*?^Fitted at 50,.*?coulomb_friction \(there with (\S+?)\)",
            "{}; {}",
        ),
    ),
    "Speed": (
        Row(
            "Identification of one record of 10 000 samples; of 1 000 000 (CPU)",
            "load",
            r"one record +10000 +([\d.]+).*?one record +1000000 +([\d.]+) +(\d+)",
            "{} s; {} s and {} MiB",
        ),
        Row(
            "Study of 100 points (CPU)",
            "load",
            r"study, points +100 +([\d.]+)",
            "{} s",
        ),
    ),
}
# Of the sealed workshop cases: what is counted, in the words of the page.
WORKSHOP = {
    workshop_series.WHOLE: "verdict and set of effects right",
    "top-1, every single effect": "a single effect named",
    "two effects, exact set": "both of two effects named",
    workshop_series.NAMED: "an effect named though nothing was wrong",
    "unknown: precision": '"none of the candidate effects" said rightly',
    "95 % intervals cover": "95 % intervals that hold the parameter",
    "confident and wrong (p > 0.8)": "wrong with more than 80 %",
}


def page() -> str:
    """The text of docs/how_well.md. Raises ValueError where a results file lacks a number."""
    lines = [HEAD]
    for title, rows in SECTIONS.items():
        lines += [f"## {title}", "| question | measured | results |", "|---|---|---|"]
        lines += [*(row.line() for row in rows), ""]
    series = workshop_series.all_series()
    every = workshop_series.together(series.values())
    recent = workshop_series.together(list(series.values())[-workshop_series.RECENT :])
    lines += [
        "## Diagnosis of sealed machines",
        "Machines and logs as a workshop hands them over, from a simulator that shares no code with the",
        f"diagnosis. Each of {len(series)} series was diagnosed once, with the code of its day.",
        "`flexlink blind --workshop` makes more.",
        "",
        f"| | all series | last {workshop_series.RECENT} |",
        "|---|---|---|",
    ]
    for what, words in WORKSHOP.items():
        lines.append("| {} | {} of {} | {} of {} |".format(words, *every[what], *recent[what]))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.name}")
