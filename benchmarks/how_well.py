"""Writes docs/how_well.md from the stored results: `python -m benchmarks.how_well`."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

from benchmarks import workshop_series
from benchmarks.harness import RESULTS

PAGE = RESULTS.parents[1] / "docs" / "how_well.md"
HEAD = """# How well does it work?

Every number is read from a file in `benchmarks/results`. The first line of that file has the command, seeds
and commit. `python -m benchmarks.how_well` writes this page. "Weakest" is the row of that file that stands
worst: a machine, a size or a case. See also [limits of the method](limits_of_the_method.md).
"""


@dataclass(frozen=True)
class Row:
    """One question. pattern: on the text of results/`file`.txt; answer: takes its groups.

    parts: finds every row of the file that the answer sums up, its number first; the one that stands worst
    (the lowest, or with `largest` the highest) is told as `weakest`, which takes its groups. Of names alone
    it takes the one that is there most often, and how often.
    """

    question: str
    file: str
    pattern: str
    answer: str
    parts: str = ""
    weakest: str = ""
    largest: bool = False

    def line(self) -> str:
        text = (RESULTS / f"{self.file}.txt").read_text(encoding="utf-8")
        values = re.search(self.pattern, text, re.DOTALL | re.MULTILINE)
        if values is None:
            raise ValueError(f"{self.file}.txt has no line that answers: {self.question}")
        sentence = self.answer.format(*values.groups())
        return f"| {self.question} | {sentence} | {self._weakest(text)} | `{self.file}` |"

    def _weakest(self, text: str) -> str:
        if not self.parts:
            return "–"
        rows = [row.groups() for row in re.finditer(self.parts, text, re.DOTALL | re.MULTILINE)]
        if not rows:
            raise ValueError(f"{self.file}.txt has no rows behind: {self.question}")

        if not rows[0][0][0].isdigit():
            return self.weakest.format(*Counter(name for (name,) in rows).most_common(1)[0])

        def size(row: tuple[str, ...]) -> float:
            """A share where two numbers stand: right of asked."""
            right, _, asked = row[0].partition(" of ")
            return float(right) / float(asked or 1)

        return self.weakest.format(*(max if self.largest else min)(rows, key=size))


# One machine a line: at how many per cent of the frequencies its ellipses hold the truth, and its name.
BY_MACHINE = r"^(?=\w+: exit [^\n]*?ellipses (\d+)%)(\w+):"

SECTIONS = {
    "Logs": (
        Row(
            "Generated logs of all kinds, contents known to who wrote them: misread without a word",
            "log_oracle",
            r"^(\d+) logs\nright +(\d+) .*?^asked +(\d+) (?!.*without a word)",
            "0 of {}; {} read right, {} asked",
            r"^asked +\d+ +([\d.]+)%",
            "{} % are refused until an option says what they hold",
        ),
    ),
    "Identification": (
        Row(
            "Error of the response, 1 to 100 rad/s, arm with a double integrator, nothing known (median)",
            "identification_p1",
            r"^P1, double.*?^GOBF, nothing known +\S+ +\S+ +(\S+)"
            r".*?^OE 4/4 \(Steig\S+ start\) +\S+ +\S+ +(\S+)",
            "{} of the response; output error with the true order: {}",
            r"^GOBF, nothing known +(\S+) +(\S+)",
            "0.1 to 600 rad/s: {}, in one run of ten above {}",
            largest=True,
        ),
        Row(
            "The same where two integrators and the relative degree are known",
            "identification_p1",
            r"^P1, double.*?^GOBF, known\S* rel\. degree 2, 2 integr\. +\S+ +\S+ +(\S+)",
            "{} of the response",
            r"known wrongly: two integrators +\S+ +\S+ +(\S+)",
            "two claimed where there is one: {}",
        ),
        Row(
            "Pole search: runs that end within 0.2 % of the best cost",
            "pole_search_p2",
            r"^as delivered +(\d+)/(\d+) +\S+ +(\d+).*?^the paper's coordinates +(\d+)/",
            "{} of {} with {} evaluations (median); in the paper's coordinates {}",
            r"^as delivered +\S+ +\S+ +\d+ +(\d+)",
            "{} evaluations in the longest",
        ),
        Row(
            "True response inside the 95 % ellipses, linear arm with noise",
            "coverage_p2",
            r"^fixed plant.*?  tangent\n    coverage[\d. ]+reach.*?overall ([\d.]+).*?^  covariance, n = 4\n"
            r".*?overall ([\d.]+)",
            "{} % of frequencies; classical covariance of an order-4 fit: {} %",
            r"^(?=[a-z][^\n]*: \d+ runs;.*?  tangent\n.*?worst ([\d.]+))([a-z][^,(\n]*\b)",
            "{} % at one frequency ({})",
        ),
        Row(
            "Two motors and two sensors of a two-link arm: error of the worst channel, median; beside N4SID",
            "several_outputs",
            r"^links:.*?shared poles[^:]*: +[\d.]+ +([\d.]+).*?nfoursid[^:]*: +[\d.]+ +([\d.]+)",
            "{} % of the gain up to 200 rad/s; {} %",
            r"^  shared poles +rms error %, median, by channel: +[\d.]+ +([\d.]+)",
            "{} % on rigid links with joints that give",
            largest=True,
        ),
        Row(
            "The same: 95 % ball holds the response matrix",
            "several_outputs",
            r"^links:.*?ball holds.*?all ([\d.]+)",
            "{} % of frequencies",
            r"([\d.]+); all [\d.]+; radius",
            "{} % in the highest band",
        ),
        Row(
            "First mode under dry friction, as recorded: largest error, and 95 % interval holds the truth",
            "readme_identify",
            r"response: as recorded.*?largest error: ([\d.]+) %.*?holds the mode: \[(\d+), \d+\] of (\d+)",
            "{} %, but {} of {}: friction is not in these intervals",
            r"response: as recorded.*?largest error: [\d.]+ % and ([\d.]+) %",
            "second mode {} %",
        ),
        Row(
            "The same with the friction identified",
            "readme_identify",
            r"response: without friction.*?largest error: ([\d.]+) %.*?the mode: \[(\d+), \d+\] of (\d+)",
            "{} %, {} of {}",
            r"response: without friction.*?error: [\d.]+ % and ([\d.]+) %.*?mode: \[\d+, (\d+)\] of (\d+)",
            "second mode {} %, {} of {}",
        ),
        Row(
            "Level of dry friction 0.02 N m, identified with the arm",
            "without_friction",
            r"friction 0\.02 N m: level error ([\d.]+) %, inside its 95 % interval (\d+) %",
            "median error {} %, {} % of intervals hold it",
            r"^friction ([\d.]+) N m: level error ([\d.]+) %, inside its 95 % interval (\d+) %",
            "{1} % at {0} N m (the smallest), {2} %",
        ),
        Row(
            "The same machine: true response inside the 95 % ellipses of its linear arm, by band",
            "without_friction",
            r"^friction 0\.02 N m.*?hub  inside % +([\d.]+).*?tip  inside % +([\d.]+)",
            "below 2 rad/s: hub {} %, tip {} %",
            r"inside %(?: +[\d.]+)* +([\d.]+)$",
            "{} % in the highest band, with friction of 0.1 N m",
        ),
        Row(
            "Six closed-loop machines with known truth: frequencies at which the ellipses hold it",
            "machines_with_truth",
            r".*?".join([r"ellipses (\d+)%"] * 6),
            "{}, {}, {}, {}, {} and {} %",
            BY_MACHINE,
            "`{1}`: {0} %",
        ),
    ),
    "Control": (
        Row(
            "Random designs: certified loops that were unstable",
            "random_designs_1300",
            r"designs (\d+), met (\d+), .*?unstable (\d+),",
            "{2} of {1} certified ({0} designs)",
            r"designs (\d+), met (\d+)",
            "{1} of {0} certified: the others are refused with their active constraint",
        ),
        Row(
            "Logs 2, 4 or 5 times slower than their controller, period stated, found or not known: certified",
            "controller_periods",
            r"^(\d+) machines: (\d+) certified, (\d+) violated",
            "{1} of {0}",
            r"^\d+ machines: \d+ certified, (\d+) violated",
            "{} with a false number",
        ),
        Row(
            "Controllers with limits as compiled C code, constant errors and steps beyond the limit: wrong",
            "limited_controllers",
            r"^wrong: (\d+) of (\d+) laws, in (\d+) runs",
            "{} of {} controllers, {} runs",
            r"^(?:companion|sections|tf2ss|random states|  \w[\w ]*?) +(\d+) of (\d+)$",
            "{} of {}",
            largest=True,
        ),
        Row(
            "Numbers of certificates of controllers made by hand, against eigenvalues: false",
            "controllers_by_hand",
            r"^(\d+) controllers.*?; (\d+) numbers checked\nfalse: (\d+);",
            "{2} of {1} ({0} controllers)",
            r"too careful: (\d+)",
            "{} gain margins more than 0.1 % too careful",
        ),
        Row(
            "Logs of ten kinds of machines under their controllers, with dry friction: `init` and `run` give "
            "a controller, and 20 steps settle on the nonlinear machine",
            "closed_loop_machines",
            r"^all +\| (\d+) of (\d+) \| (\d+) of (\d+) \| (\d+) of (\d+) \|",
            "{0} of {1} with a reference in the logs, {2} of {3} without; {4} of {5} certificates exceeded",
            BY_MACHINE,
            "`{1}`: true response inside its ellipses at {0} % of frequencies",
        ),
        Row(
            "Fresh machines of these kinds, `flexlink run LOG...` with a reference in the logs, two batches",
            "closed_loop_machines_12",
            r"^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)"
            r".*?^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)",
            "{0} of {1}, {4} of {5}; {2} of {3}, {6} of {7} certificates exceeded",
            BY_MACHINE,
            "`{1}`: true response inside its ellipses at {0} % of frequencies",
        ),
        Row(
            "Machines of these kinds drawn after that, each kind twice, in two lots of five kinds",
            "closed_loop_machines_13",
            r"^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)"
            r".*?^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)",
            "{0} of {1}, {4} of {5}; {2} of {3}, {6} of {7} certificates exceeded",
            BY_MACHINE,
            "`{1}`: true response inside its ellipses at {0} % of frequencies",
        ),
        Row(
            "Drawn for release 0.2.0, each kind twice: certified, and 20 of 20 steps settle",
            "closed_loop_machines_15",
            r"^certified and 20 of 20 settle, both lots: (\d+) of (\d+)",
            "{} of {}",
            BY_MACHINE,
            "`{1}`: true response inside its ellipses at {0} % of frequencies",
        ),
        Row(
            "Drawn after release 0.2.0, each kind twice: certified, and 20 of 20 steps settle",
            "closed_loop_machines_32",
            r"^all +\| (\d+) of (\d+) \| - \| (\d+) of (\d+)",
            "{0} of {1}; {2} of {3} certificates exceeded",
            BY_MACHINE,
            "`{1}`: true response inside its ellipses at {0} % of frequencies",
        ),
        Row(
            "Six machines, their logs rounded, thinned, shortened, in other units: certificate or first mode "
            "differs",
            "same_log_otherwise",
            r"^(\d+) of (\d+) flipped",
            "{} of {}",
            r"^(\w+), [^\n]*? FLIPPED;",
            "`{}`: {} of its 8",
        ),
        Row(
            "Peak of the sensitivity on the nonlinear arm against the prediction",
            "closed_loop_sensitivity",
            r"at 0\.2 rad rms: worst -?([\d.]+) %",
            "within {} %",
            r"at \d+\.\d+ +-(\d\.\d+)$",
            "{} % below it where the arm moves 0.02 rad rms: dry friction",
            largest=True,
        ),
        Row(
            "The same, friction 0.005 to 0.1 N m: inside the range that is predicted for the motion",
            "friction_in_the_loop",
            r"from the sticking step on: (\d+ of \d+) = ([\d.]+) %",
            "{0} ({1} %)",
            r"off the linear one, % +-([\d.]+)",
            "at 0.003 rad rms {} % off what a linear loop has",
            largest=True,
        ),
        Row(
            "Landau's flexible transmission, score of the published benchmark",
            "landau_transmission",
            r"direct search: score ([\d.]+), (\d+) parameters, ([\d.]+) s",
            "{} of 100 with {} parameters in {} s",
            r"^  (?=\w+ +[<>]=[^\n]* ([\d.]+)$)(\w+)",
            "`{1}`: {0} % to spare",
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
            r"interval holds the truth: (\d+ of \d+).*?sure and wrong: (\d+ of \d+)",
            "intervals hold {}; sure and wrong {}",
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
            "SLFR, a real flexible arm: probability that friction is present, fitted at 50 and 75; what is "
            "said where it is fitted at 50 alone",
            "real_machine_gaps",
            r"^Fitted at 50 and 75.*?coulomb_friction \(there with (\S+?)\).*?^Fitted at 50,.*?Verdict (\w+)",
            "{}; {}",
        ),
    ),
    "Speed": (
        Row(
            "Identification of one record of 10 000 samples; of 1 000 000 (CPU)",
            "load",
            r"one record +10000 +([\d.]+).*?one record +1000000 +([\d.]+) +(\d+)",
            "{} s; {} s and {} MiB",
            r"samples of one record +(10000000) +([\d.]+) +(\d+)",
            "{} samples: {} s and {} MiB",
        ),
        Row(
            "Study of 100 points (CPU)",
            "load",
            r"study, points +100 +([\d.]+)",
            "{} s",
            r"study, points +(500) +([\d.]+)",
            "{} points: {} s",
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


MISTAKES = (workshop_series.NAMED, "confident and wrong (p > 0.8)")


def page() -> str:
    """The text of docs/how_well.md. Raises ValueError where a results file lacks a number."""
    lines = [HEAD]
    for title, rows in SECTIONS.items():
        lines += [f"## {title}", "| question | measured | weakest | results |", "|---|---|---|---|"]
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
        f"| | all series | last {workshop_series.RECENT} | weakest series |",
        "|---|---|---|---|",
    ]
    for what, words in WORKSHOP.items():
        counted = [answers[what] for answers in series.values() if answers.get(what, (0, 0))[1]]
        worst = (max if what in MISTAKES else min)(counted, key=lambda pair: pair[0] / pair[1])
        lines.append(
            "| {} | {} of {} | {} of {} | {} of {} |".format(words, *every[what], *recent[what], *worst)
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.name}")
