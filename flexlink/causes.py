"""Why simulation and machine disagree."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from diagnosis import diagnosis as chain
from diagnosis.answer import Diagnosis
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.own_plant import PlantCase
from diagnosis.search.loop import Progress
from flexlink.keywords import front_door
from ident.data.keywords import WrongArgumentError

__all__ = ["Case", "Diagnosis", "Experiment", "diagnose", "load_case"]


@front_door
def diagnose(
    case: Any,
    *,
    progress: Progress | None = None,
    rng: np.random.Generator | None = None,
    time_limit_s: float = np.inf,
) -> Diagnosis:
    """Find the effect that explains the model error of a rig or of your own simulation.

    Takes about ten seconds for records of a few thousand samples.

    Parameters
    ----------
    case : Case or diagnosis.PlantCase
        `load_case` reads either; "Your own plant" describes the second.
    progress : callable, optional
        Called with the share done (0 to 1) and what is being done.
    rng : numpy.random.Generator, optional
        Of interval draws; without it one case has one answer.
    time_limit_s : float
        Seconds after which nothing more is tried; the answer says what was not.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        Records that do not fit to the rig or the simulation; one line says where.

    Examples
    --------
    >>> rig, rubbing = flexlink.paper_link(), flexlink.effect("coulomb_friction", torque_Nm=0.05)
    >>> def measured(name, role, amplitude_V):
    ...     voltage = flexlink.prbs(8, 4, amplitude_V, 600)
    ...     run = flexlink.simulate(rig, voltage, [rubbing], rng=default_rng(int(amplitude_V)))
    ...     return flexlink.Experiment(name, role, run.voltage_V, run.output)
    >>> case = flexlink.Case("arm", rig, (measured("a", "estimation", 6.0), measured("b", "held_out", 4.0)))
    >>> found = flexlink.diagnose(case)
    >>> found.verdict, found.effects[0].name
    ('effect', 'coulomb_friction')
    """
    try:
        return chain.diagnose(case, progress=progress, rng=rng, time_limit_s=time_limit_s)
    # A case is not checked by its type: what has a case's attributes will do.
    except AttributeError:
        if hasattr(case, "machine"):
            raise
    raise WrongArgumentError(
        f"diagnose: case is of type {type(case).__name__}, expected a flexlink.Case; "
        "flexlink.load_case(place) reads one from a folder"
    )


@front_door
def load_case(place: str | os.PathLike[str], rig: str | None = None) -> Case | PlantCase:
    """Read a case as `flexlink diagnose` does (docs/case_files.md, docs/simulators.md).

    Parameters
    ----------
    place : path
        A folder with `case.toml`, or such a TOML file. A file that names a simulator's model must be named
        itself.
    rig : str, optional
        Another rig file than the one that the case file names.

    Returns
    -------
    Case or diagnosis.PlantCase
        The second for a simulator's model.

    Raises
    ------
    ValueError
        In one line: the file and what is wrong in it.

    Examples
    --------
    >>> case = flexlink.load_case("examples/gap_case")
    >>> case.name, [experiment.role for experiment in case.experiments].count("held_out")
    ('gap_case', 1)
    """
    from workflow.diagnose.command import load_any_case

    return load_any_case(Path(place), rig).case
