"""Systems of other packages as plants and controllers: of python-control, scipy.signal, models of `ident`.

`state_space` takes what has poles, `measured_response` what was measured at frequencies. Both refuse in one
line, with what to do, what no design in discrete time can use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from control_design.plants.transfer import of_polynomials
from ident.data.keywords import WrongArgumentError, refuse_rate

if TYPE_CHECKING:
    import control

    from ident.data.frequency_uncertainty import FrequencyUncertainty

# Classes of several inputs and outputs, which have functions of their own. By name: importing them here would
# close a circle.
_OF_SEVERAL_SIGNALS = ("MatrixPosterior", "MultivariablePlant")


def is_measured(system: object) -> TypeGuard[control.FrequencyResponseData]:
    """Return whether a system is a measured response of python-control (frd), which has no poles."""
    # Imported here and below, because it brings a plotting library with it.
    import control

    return isinstance(system, control.FrequencyResponseData)


def state_space(system: Any, what: str = "the system", *, several: bool = False) -> control.StateSpace:
    """Return a system as a discrete state space.

    Parameters
    ----------
    system : object
        Of python-control (ss, tf, zpk) or scipy.signal (dlti), or anything with `to_control()`.
    what : str
        Its name in a refusal.
    several : bool
        Any number of inputs and outputs is taken, of a state space; otherwise one of each.

    Returns
    -------
    control.StateSpace
        With dt in seconds; a state space as it is.

    Raises
    ------
    WrongArgumentError
        A ValueError: a system in continuous time or without a sampling time, with several inputs or outputs,
        or with more zeros than poles; a measured response (frd), which has no poles; and anything else.
    """
    import control

    if hasattr(system, "to_control"):
        system = system.to_control()
    if is_measured(system):
        raise WrongArgumentError(
            f"{what} is a frequency response (frd), which has no poles: identify it with "
            "flexlink.identify_frf, or give a model beside it, UncertainPlant(model, uncertainty=frd)"
        )
    if type(system).__module__.startswith("scipy.signal") and hasattr(system, "to_ss"):
        matrices = system.to_ss()
        system = control.ss(
            matrices.A, matrices.B, matrices.C, matrices.D, matrices.dt or 0, remove_useless_states=False
        )
    kind = type(system).__name__
    if kind in _OF_SEVERAL_SIGNALS:
        raise WrongArgumentError(
            f"{what} is a {kind}, of several inputs and outputs: use flexlink.synthesise_multivariable and "
            "flexlink.certify_multivariable"
        )
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise WrongArgumentError(
            f"{what} is a {kind}; expected a discrete system of python-control: "
            "control.ss(A, B, C, D, dt_s) or control.tf(num, den, dt_s)"
        )
    is_state_space = isinstance(system, control.StateSpace)
    _refuse(system, what, several=several and is_state_space)
    # A state space may be in any unit of time; polynomials are typed, and then with a rate for a period.
    if is_state_space:
        return system
    refuse_rate(system.dt)
    try:
        return of_polynomials(system.num[0][0], system.den[0][0], system.dt)
    except ValueError as error:
        raise WrongArgumentError(f"{what} {error}") from None


def measured_response(system: control.FrequencyResponseData, what: str = "the frd") -> FrequencyUncertainty:
    """Return an frd of python-control as a response (F,) without uncertainty, its frequencies ascending.

    what: its name in a refusal. Raises WrongArgumentError as `state_space` for several signals and a system
    without a sampling time.
    """
    # Here, because ellipses load numerical libraries that a log which is refused does not need.
    from ident.data.frequency_uncertainty import FrequencyUncertainty

    _refuse(system, what)
    order = np.argsort(system.omega, kind="stable")
    omega = np.asarray(system.omega)[order]
    centre = np.asarray(system.frdata[0, 0])[order]
    return FrequencyUncertainty(omega, centre, np.zeros((omega.size, 2, 2)), float(system.dt))


def _refuse(system: Any, what: str, *, several: bool = False) -> None:
    """Refuse another number of signals than one (unless several), and a system without a sampling time."""
    if not several and (system.ninputs, system.noutputs) != (1, 1):
        raise WrongArgumentError(
            f"{what} has {system.ninputs} inputs and {system.noutputs} outputs; take one channel: "
            "system[output, input], as system[0, 0]; or design for all with "
            "flexlink.synthesise_multivariable(flexlink.MultivariablePlant(name, system), ...)"
        )
    # True is a discrete system that says no sampling time, and equal to 1.
    is_unspecified = system.dt is None or isinstance(system.dt, bool)
    if is_unspecified:
        raise WrongArgumentError(
            f"{what} has no sampling time in seconds (dt = {system.dt}), which discrete time needs: "
            "state it, system.dt = dt_s"
        )
    if system.dt == 0:
        if is_measured(system):
            mend = "state the sampling time of the records: control.frd(response, omega, dt_s)"
        else:
            mend = "sample it: control.sample_system(system, dt_s, 'zoh')"
        raise WrongArgumentError(f"{what} is in continuous time, flexlink works in discrete time: {mend}")
