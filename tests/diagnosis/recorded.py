"""The recorded cases of an independent finite-element rig, read without the project's own readers."""

from __future__ import annotations

import tomllib

import numpy as np

from diagnosis import Case, Experiment
from plant import Rig


def recorded_case(folder, rig="rig.toml"):
    meta = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
    experiments = []
    for entry in meta["experiments"]:
        data = np.loadtxt(folder / entry["file"], delimiter=",", skiprows=1)
        experiments.append(Experiment(entry["file"], entry["role"], data[:, 1], data[:, 2:4], entry["kind"]))
    return Case(folder.name, Rig.from_toml(folder / rig), tuple(experiments))


def answer(folder):
    return tomllib.loads((folder / "answer.toml").read_text(encoding="utf-8"))
