"""Cases of independent rigs: recorded ones, read without the project's own readers, and simulated ones."""

import tomllib

import numpy as np

from diagnosis import Case, Experiment
from diagnosis.fit.descent import Fit
from diagnosis.fit.nominal import prior_cost
from diagnosis.fit.records import FittedStart, StartColumns
from plant import Rig, prbs
from validation.blind.rigs import rig_toml
from validation.blind.truth import Truth


def recorded_case(folder, rig="rig.toml", without=()):
    """without: beginnings of names of records that are left out."""
    meta = tomllib.loads((folder / "case.toml").read_text(encoding="utf-8"))
    experiments = []
    for entry in meta["experiments"]:
        if entry["file"].startswith(tuple(f"experiments/{name}" for name in without)):
            continue
        data = np.loadtxt(folder / entry["file"], delimiter=",", skiprows=1)
        experiments.append(Experiment(entry["file"], entry["role"], data[:, 1], data[:, 2:4], entry["kind"]))
    return Case(folder.name, Rig.from_toml(folder / rig), tuple(experiments))


def simulated_case(folder, table, records, rng, *, samples=900, register=7, stated=None, tolerances=None):
    """A case by the blind protocol's simulator, which shares no code with the model that is diagnosed.

    records: role, effects, samples each value of the voltage is held, largest voltage; stated: the rig's
    values as its makers know them, where they are not the true ones in `table`.
    """
    file = folder / "rig.toml"
    file.write_text(rig_toml(table if stated is None else stated, tolerances or {}), encoding="utf-8")
    experiments = []
    for k, (role, effects, hold, amplitude_V) in enumerate(records):
        machine = Truth(table, effects)
        voltage = prbs(register, hold, amplitude_V, samples, rng)
        measured = machine.record(voltage).measured(rng.standard_normal((samples, 2)) * machine.noise)
        experiments.append(Experiment(f"{k}", role, voltage, measured, "prbs"))
    return Case("simulated", Rig.from_toml(file), tuple(experiments))


def end_of_fit(candidates, coordinates, left, jacobian, deviations=()):
    """Under white noise, made by hand: what is left (N,), its derivatives (N, P + A)."""
    d = np.array(deviations, dtype=float)
    loss, prior = 0.5 * float(left @ left + prior_cost(d)), 0.5 * float(prior_cost(d))
    start, weights = FittedStart(np.zeros((1, 0)), np.zeros(0)), np.ones(left.size)
    columns = StartColumns(np.zeros((left.size, 0)), (), np.zeros((0, 0)))
    x = np.concatenate([np.zeros(0), *coordinates])
    return Fit(tuple(candidates), d, x, start, left, weights, jacobian, columns, loss, prior, True)
