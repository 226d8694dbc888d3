"""Files of every kind spoilt at random, by the loops of the tests: each is read, or refused in one line of at
most 300 characters that names the file, within 60 s. Damaged logs go to `look` and `identify`, too: cut,
spliced, under another format's name, zip archives in each other, numbers of any size, NaN.

What would compute is cut off where it begins: this is about files. Binary files have bits turned and bytes
replaced, doubled or taken out; texts values, names, lines and characters changed. Formats that a compiled
library reads take a process each.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from benchmarks.harness import Print, main
from tests.ident import test_hostile_logs as logs
from tests.ident.mutations import DAMAGE, Tally
from tests.workflow import test_hostile_models as models, test_nothing_breaks_it as texts
from tests.workflow.command import FAST_ARM, draw_nothing
from workflow.commands.run import run_from_files


def run(
    out: Print,
    *,
    spoilt: int = 450,
    controllers: int = 600,
    tampered: int = 300,
    binary: int = 600,
    child: int = 100,
    commands: int = 420,
) -> None:
    out(f"{'':52}{'tried':>7}{'refused':>9}{'wrong':>7}   longest line   slowest refusal, CPU s")
    total = Tally()

    def told(kind: str, found: Tally) -> None:
        counts = f"{found.tried:7d}{found.refused:9d}{len(found.wrong):7d}"
        out(f"{kind:<52}{counts}{found.longest:15d}{found.slowest_s:25.2f}")
        if found is total:
            return
        for line in found.wrong:
            out(f"    {line}")
        total.tried += found.tried
        total.refused += found.refused
        total.wrong += found.wrong
        total.longest = max(total.longest, found.longest)
        total.slowest_s = max(total.slowest_s, found.slowest_s)

    with tempfile.TemporaryDirectory(prefix="flexlink-") as name:
        folder = Path(name)
        for log in logs.IN_PROCESS:
            told(f"log: {log}", logs.damaged(log, folder, binary))
        for file in models.WHOLE:
            told(f"model: {file}", models.damaged(file, folder, binary))
        told("controller .json", texts.spoilt_controllers(controllers))
        for log in logs.IN_A_CHILD:
            told(f"log: {log}", logs.damaged(log, folder, child))
        with pytest.MonkeyPatch.context() as patch:
            draw_nothing(patch)
            run_from_files(FAST_ARM, folder / "run")
            with pytest.MonkeyPatch.context() as replay:
                for number, (name, output) in enumerate(texts.outputs_replayed(folder, replay).items(), 96):
                    told(
                        f"directory of {name}, then --resume",
                        texts.tampered(output, folder, tampered, number),
                    )
            texts.cut_computations_off(patch)
            for damage in DAMAGE:
                told(f"log given to a command: {damage}", texts.damaged_logs(damage, folder, commands))
            (folder / "good").mkdir()
            good = texts.good_files(folder / "good")
            for number, kind in enumerate(texts.KINDS):
                told(f"given to a command: {kind}", texts.spoilt_files(good[kind], number, folder, spoilt))
            found = texts.tampered(texts.run_output(folder / "run"), folder, tampered, 99)
            told("directory of run, then --resume or report", found)
    told("all", total)


if __name__ == "__main__":
    main(run, seeds="of the tests")
