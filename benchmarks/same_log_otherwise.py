"""The same logs written otherwise: does the answer of `flexlink run LOG...` flip?

    python -m benchmarks.same_log_otherwise [--machines DIR] [--only NAME,NAME] [--ways WAY,WAY]

DIR holds a folder a machine with run*.csv. Every way writes all logs of a machine anew: rounded to 3, 4, 5 or
9 significant decimals of each column's size, every second row, without the last tenth, angles in another unit
(deg, rad), with a temperature and a counter as further columns. An answer is whether the run ends with a
certificate, and the first mode of the model. It flips where the certificate comes or goes, or the mode moves
by more than a tenth. Counted a second time is what flips by the first mode that the run calls one: whose
interval of the damping says that it swings, as in the run's answer and page. A pair that stands for what lies
above the band of the logs is none.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from benchmarks.harness import Print, flexlink, main
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults

# Largest change of a frequency that is still the same mode: a tenth, far above what noise leaves open of one.
_SAME_MODE = 0.1
_UNITS = {"deg": ("rad", np.pi / 180), "Grad": ("rad", np.pi / 180), "rad": ("deg", 180 / np.pi)}


def _rounded(decimals: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def way(table: pd.DataFrame) -> pd.DataFrame:
        rounded = table.copy()
        for name in table.columns[1:]:
            size = 10 ** np.floor(np.log10(np.abs(table[name]).max()))
            rounded[name] = np.round(table[name] / size, decimals) * size
        return rounded

    return way


def _in_other_units(table: pd.DataFrame) -> pd.DataFrame:
    converted = table.copy()
    for name in table.columns[1:]:
        for unit, (other, factor) in _UNITS.items():
            if name.endswith((f"_{unit}", f"[{unit}]")):
                converted[name] = converted[name] * factor
                converted = converted.rename(columns={name: name.replace(unit, other)})
                break
    return converted


def _with_more_columns(table: pd.DataFrame) -> pd.DataFrame:
    rng = np.random.default_rng(len(table))
    warm = 25 + 5 * np.linspace(0, 1, len(table)) + 0.02 * rng.standard_normal(len(table))
    return table.assign(motor_temp_C=np.round(warm, 2), frame=np.arange(len(table)))


WAYS: dict[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "as it is": lambda table: table,
    **{f"{n} decimals": _rounded(n) for n in (3, 4, 5, 9)},
    "half the rate": lambda table: table.iloc[::2],
    "a tenth shorter": lambda table: table.iloc[: len(table) * 9 // 10],
    "other units": _in_other_units,
    "more columns": _with_more_columns,
}


class Answer(NamedTuple):
    """certified; mode_Hz: of the model's first pair that can be a mode, told_Hz: of the first whose interval
    says that it is one, None without; words: the last ones."""

    certified: bool
    mode_Hz: float | None
    told_Hz: float | None
    words: str


def answer(logs: list[Path], way: str, work: Path) -> Answer:
    """What `flexlink run` answers to logs that are written in a way."""
    for log in logs:
        german = ";" in log.read_text(encoding="utf-8").splitlines()[0]
        sep, point = (";", ",") if german else (",", ".")
        table = WAYS[way](pd.read_csv(log, sep=sep, decimal=point))
        table.to_csv(work / log.name, index=False, sep=sep, decimal=point)
    call = ["run", *map(str, sorted(work.glob("*.csv"))), "--out", str(work / "out"), "--json"]
    code, text, lines = flexlink(*call)
    directory = RunDirectory(work / "out")
    if directory.stage_file("identify") is None:
        return Answer(False, None, None, lines[-1])
    results = RunResults(directory)
    channel = results.identify.channels[0]
    modes = [mode.frequency_Hz for mode in channel.modes if channel.is_mode(mode)]
    told_modes = modes
    if directory.stage_file("uncertainty") is not None:
        intervals = results.uncertainty.channels[0].intervals
        if intervals is not None:
            known = zip(channel.modes, intervals.modes, strict=True)
            told_modes = [
                mode.frequency_Hz for mode, interval in known if channel.is_mode(mode) and interval.told
            ]
    verdict = json.loads(text).get("verdict") if text.startswith("{") else lines[-1]
    return Answer(code == 0, min(modes, default=None), min(told_modes, default=None), str(verdict))


def flips(first: Answer, found: Answer, *, told: bool) -> bool:
    """Whether the certificate or the first mode differ; told: of the modes whose intervals tell them."""
    before = first.mode_Hz
    after = found.mode_Hz
    if told:
        before = first.told_Hz
        after = found.told_Hz
    if found.certified != first.certified or (after is None) != (before is None):
        return True
    return bool(before and after and abs(after / before - 1) > _SAME_MODE)


def _named(mode_Hz: float | None) -> str:
    return "no mode" if mode_Hz is None else f"{mode_Hz:.4g} Hz"


def run(out: Print, *, machines: str = "../shared/machines", only: str = "", ways: str = "") -> None:
    """A line a machine and way; then how many flipped."""
    asked = [way for way in WAYS if way == "as it is" or not ways or way in ways.split(",")]
    flipped = 0
    flipped_told = 0
    count = 0
    for folder in sorted(path for path in Path(machines).iterdir() if path.is_dir()):
        if only and folder.name not in only.split(","):
            continue
        first: Answer | None = None
        for way in asked:
            with tempfile.TemporaryDirectory() as scratch:
                of_way = answer(sorted(folder.glob("run*.csv")), way, Path(scratch))
            first = first or of_way
            by_model = flips(first, of_way, told=False)
            by_told = flips(first, of_way, told=True)
            flipped = flipped + by_model
            flipped_told = flipped_told + by_told
            count += way != "as it is"
            verdict = "certified" if of_way.certified else "not certified"
            modes = _named(of_way.mode_Hz)
            if of_way.told_Hz != of_way.mode_Hz:
                modes += f" (told: {_named(of_way.told_Hz)})"
            mark = " FLIPPED" * by_model + " (by told modes not)" * (by_model and not by_told)
            out(f"{folder.name}, {way}: {verdict}, {modes}{mark}; {of_way.words:.120}")
    out(f"{flipped} of {count} flipped; {flipped_told} by the modes that intervals tell")


if __name__ == "__main__":
    main(run)
