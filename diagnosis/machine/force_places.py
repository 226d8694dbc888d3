"""Where a force that a simulation lacks may act, and how the simulation is run with one there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from diagnosis.machine.machine_protocol import Real


@dataclass(frozen=True)
class ForcePlace:
    """A place of a machine at which a force is added to a simulation.

    Parameters
    ----------
    name : str
        The joint, the hub, or the command to which it is added.
    unit : str
        Unit of what is added: "N m", "N", that of the command; "" where nobody has said it.
    motion : int or None
        Column of the output that moves where the force acts; None where that is not known and is read off
        the response.
    command : int or None
        Column of the input that drives this place; None where there is none.
    """

    name: str
    unit: str = ""
    motion: int | None = None
    command: int | None = None


@dataclass(frozen=True, eq=False)
class ForcedSimulation:
    """A simulation that takes forces at some places beside its commands.

    Parameters
    ----------
    places : (F,) tuple of ForcePlace
        In the order of the columns of the forces.
    simulate : callable
        (parameters, inputs (T, U), forces (T, F) in the places' units) -> outputs (T, Y) as measured,
        without noise. Parameters is name -> value; forces are held over each sample.
    """

    places: tuple[ForcePlace, ...]
    simulate: Callable[..., Real]
