"""How often does an effect get the name of a cause that is on no list?

Workshop cases of the independent rigs are diagnosed: those whose cause is on no list, and those with one
effect, which is taken off the list before. Named is what is present with at least .5; for the counts of
`diagnosis/imperfect/look_alikes.toml` before what it loses by these (`NamedEffect.acts_alike`) is taken off.
"""

from __future__ import annotations

import tempfile
import tomllib
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.harness import Print, main, timed
from diagnosis import diagnose
from plant.effects import EFFECTS
from validation.blind.generate import generate
from workflow.diagnose.case_files import load_case

SEEDS = {"single": 8101, "unlisted": 8102}
NAMED, SURE = 0.5, 0.8


@contextmanager
def without(names: list[str]) -> Iterator[None]:
    """The registry without these effects."""
    kept = dict(EFFECTS)
    for name in names:
        del EFFECTS[name]
    try:
        yield
    finally:
        EFFECTS.clear()
        EFFECTS.update(kept)


def run(out: Print, *, single: int = 20, unlisted: int = 16) -> None:
    stood_in, cases, sure = Counter[str](), 0, 0
    for kind, number in {"single": single, "unlisted": unlisted}.items():
        with tempfile.TemporaryDirectory() as folder:
            generate(number, SEEDS[kind], Path(folder) / "c", open_cases=True, workshop=True, only=kind)
            for place in sorted((Path(folder) / "c").iterdir()):
                answer = tomllib.loads((place / "answer.toml").read_text(encoding="utf-8"))
                gone = [each["name"] for each in answer.get("effects", [])]
                beyond = [each["name"] for each in answer.get("unlisted", [])]
                with without(gone), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found, seconds = timed(lambda place=place: diagnose(load_case(place).case))
                there = {
                    e.name: e.presence
                    for e in found.effects
                    if e.name in EFFECTS and e.presence + e.acts_alike >= NAMED
                }
                stood_in.update([*there])
                cases += 1
                sure += max(there.values(), default=0.0) > SURE
                said = ", ".join(f"{name} {p:.3f}" for name, p in there.items()) or found.verdict
                out(f"{place.name} {' '.join(gone or beyond):24s} -> {said}   ({seconds:.0f} s)")
    out(f"named above {SURE}: {sure}")
    out(f"{cases} cases; named: " + ", ".join(f"{name} {n}" for name, n in sorted(stood_in.items())))


if __name__ == "__main__":
    main(run)
