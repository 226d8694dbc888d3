"""The same logs written otherwise: does the answer of `flexlink run LOG...` flip?

    python -m benchmarks.same_log_otherwise [--machines DIR] [--only NAME,NAME] [--ways WAY,WAY]

DIR holds a folder a machine with run*.csv. Every way writes all logs of a machine anew: rounded to 3, 4, 5 or
9 significant decimals of each column's size, every second row, without the last tenth, angles in another unit
(deg, rad), with a temperature and a counter as further columns. An answer is whether the run ends with a
certificate, and the first mode of the model. It flips where the certificate comes or goes, or the mode moves
by more than a tenth.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.harness import Print, flexlink, main
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults

_UNITS = {"deg": ("rad", np.pi / 180), "Grad": ("rad", np.pi / 180), "rad": ("deg", 180 / np.pi)}


def _rounded(decimals: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def way(table: pd.DataFrame) -> pd.DataFrame:
        found = table.copy()
        for name in table.columns[1:]:
            size = 10 ** np.floor(np.log10(np.abs(table[name]).max()))
            found[name] = np.round(table[name] / size, decimals) * size
        return found

    return way


def _in_other_units(table: pd.DataFrame) -> pd.DataFrame:
    found = table.copy()
    for name in table.columns[1:]:
        for unit, (other, factor) in _UNITS.items():
            if name.endswith((f"_{unit}", f"[{unit}]")):
                found[name] = found[name] * factor
                found = found.rename(columns={name: name.replace(unit, other)})
                break
    return found


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


def answer(logs: list[Path], way: str, work: Path) -> tuple[bool, float | None, str]:
    """Whether it is certified, the first mode, Hz, and the last words."""
    for log in logs:
        german = ";" in log.read_text(encoding="utf-8").splitlines()[0]
        sep, point = (";", ",") if german else (",", ".")
        table = WAYS[way](pd.read_csv(log, sep=sep, decimal=point))
        table.to_csv(work / log.name, index=False, sep=sep, decimal=point)
    call = ["run", *map(str, sorted(work.glob("*.csv"))), "--out", str(work / "out"), "--json"]
    code, text, said = flexlink(*call)
    directory = RunDirectory(work / "out")
    if directory.stage_file("identify") is None:
        return False, None, said[-1]
    channel = RunResults(directory).identify.channels[0]
    modes = [mode.frequency_Hz for mode in channel.modes if channel.is_mode(mode)]
    verdict = json.loads(text).get("verdict") if text.startswith("{") else said[-1]
    return code == 0, min(modes, default=None), str(verdict)


def run(out: Print, *, machines: str = "../shared/machines", only: str = "", ways: str = "") -> None:
    """A line a machine and way; then how many flipped."""
    asked = [way for way in WAYS if way == "as it is" or not ways or way in ways.split(",")]
    flips, count = 0, 0
    for folder in sorted(path for path in Path(machines).iterdir() if path.is_dir()):
        if only and folder.name not in only.split(","):
            continue
        first: tuple[bool, float | None, str] | None = None
        for way in asked:
            with tempfile.TemporaryDirectory() as scratch:
                found = answer(sorted(folder.glob("run*.csv")), way, Path(scratch))
            first = first or found
            flipped = found[0] != first[0] or (found[1] is None) != (first[1] is None)
            if found[1] and first[1]:
                flipped |= abs(found[1] / first[1] - 1) > 0.1
            flips, count = flips + flipped, count + (way != "as it is")
            mode = "no mode" if found[1] is None else f"{found[1]:.4g} Hz"
            verdict = "certified" if found[0] else "not certified"
            out(f"{folder.name}, {way}: {verdict}, {mode}{' FLIPPED' if flipped else ''}; {found[2]:.120}")
    out(f"{flips} of {count} flipped")


if __name__ == "__main__":
    main(run)
