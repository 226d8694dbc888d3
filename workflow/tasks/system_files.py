"""Discrete systems from files: plants and controllers as matrices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.signal import ss2tf

from control_design.controllers.controller import Controller
from control_design.plants.transfer import of_polynomials, of_roots
from workflow.engine.errors import naming
from workflow.tasks.system_documents import (
    StatedSystem,
    read_document,
    refuse_other_period,
    stated_law,
    stated_system,
)

if TYPE_CHECKING:
    import control


def read_state_space(path: Path, document: Mapping[str, Any]) -> control.StateSpace:
    """The system of a file as `stated_system` reads it. Raises InputError."""
    return _state_space(stated_system(path, document))


def _state_space(stated: StatedSystem) -> control.StateSpace:
    # Here, since python-control loads matplotlib: most pages describe runs that read no system.
    import control

    if stated.polynomials is not None:
        return of_polynomials(*stated.polynomials, stated.dt_s)
    if stated.roots is not None:
        return of_roots(*stated.roots, stated.dt_s)
    assert stated.matrices is not None
    matrices = (stated.matrices[name] for name in "ABCD")
    return control.ss(*matrices, stated.dt_s, remove_useless_states=False)


def read_law(path: Path, dt_s: float, delay_samples: int = 0) -> Controller:
    """The controller of a file, from error to command.

    Parameters
    ----------
    path : Path
        controller.json of a run, or what `stated_system` reads.
    dt_s : float
        Sampling time that it has to have [s].
    delay_samples : int
        Of the computation, where the file does not say it.

    Raises
    ------
    InputError
        One line: no controller, or another sampling time.
    """
    document = read_document(path)
    law = stated_law(path, document)
    if isinstance(law, StatedSystem):
        system = _state_space(law)
        late = np.ravel(document.get("computational_delay_samples", delay_samples))[0]
        with naming(str(path)):
            law = Controller(
                system.A,
                system.B,
                system.C,
                system.D,
                system.dt,
                computational_delay_samples=late,
                name=path.stem,
            )
    refuse_other_period(path, law.dt_s, dt_s)
    return law


def read_controller(path: Path, dt_s: float) -> tuple[list[float], list[float]]:
    """Numerator and denominator in z, highest power first, of the controller of a file, with its delay.

    dt_s: sampling time that it has to have [s]. Raises InputError, see `read_law`.
    """
    law = read_law(path, dt_s).to_control(include_delay=True)
    if not law.nstates:
        return [float(law.D[0, 0])], [1.0]
    numerator, denominator = ss2tf(law.A, law.B, law.C, law.D)
    return numerator[0].tolist(), denominator.tolist()
