"""What a specification says of the controller's structure in an engineer's parameters, and its parts.

`structure = "pid"` (or p, pi, pd) asks for Kp (1 + 1/(Ti s) + Td s/(Tf s + 1)), times `notches`, times a
`low_pass`. Each number that is given is fixed; the synthesis chooses what is left. s stands for
(2/dt)(z - 1)/(z + 1), the trapezoidal rule; frequencies of notches and low-pass are those of the discrete
controller itself (`controllers.parts`).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Protocol

from pydantic import Field, model_validator

from control_design.controllers.parts import (
    LowPassPart,
    NotchPart,
    Part,
    PidPart,
    damping_of_width,
    tustin_corner,
    width_of_damping,
)
from ident.data.settings import Settings

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

PID_STRUCTURES = ("p", "pi", "pd", "pid")

# Relative difference of two fixed frequencies up to which they are the same notch, stated twice.
_SAME_FREQUENCY = 1e-6
# Decibels of a factor of ten in amplitude.
_DECIBELS = 20.0


class Fixed(Settings):
    """Numbers of the PID that are fixed; what is left out is chosen by the synthesis."""

    kp: float | None = Field(
        default=None, allow_inf_nan=False, description="Kp of p, pi, pd, pid, input unit per measured unit"
    )
    ti_s: _Positive | None = Field(default=None, description="Ti of pi and pid, s")
    td_s: _Positive | None = Field(default=None, description="Td of pd and pid, s")
    tf_s: _Positive | None = Field(
        default=None, description="Tf of pd and pid, s: filter of the derivative, half a period at least"
    )


class Notch(Settings):
    """One notch; what is left out is chosen by the synthesis."""

    frequency_hz: _Positive | None = Field(default=None, description="middle, where it is deepest, Hz")
    depth_db: _Positive | None = Field(
        default=None, description="gain beside the notch over that in its middle, dB: positive"
    )
    width_hz: _Positive | None = Field(
        default=None,
        description="width between the frequencies at which half of the notch's power is taken off (-3 dB of "
        "a deep notch), Hz",
    )
    damping: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="in place of width_hz: damping ratio of its poles; its zeros have it over the depth",
    )

    @model_validator(mode="after")
    def _one_width(self) -> Notch:
        """Return self; ValueError where width and damping are both given."""
        if self.width_hz is not None and self.damping is not None:
            raise ValueError("give width_hz or damping of a notch, not both")
        return self


class LowPass(Settings):
    """The low-pass; what is left out is chosen by the synthesis."""

    frequency_hz: _Positive | None = Field(default=None, description="corner, Hz")
    order: int = Field(default=2, ge=1, le=2, description="1 or 2; of pd and pid, whose D has Tf, 2")
    damping: float | None = Field(
        default=None, gt=0, lt=1, description="damping ratio of its two poles, of order 2; 0.7 is usual"
    )

    @model_validator(mode="after")
    def _has_damping(self) -> LowPass:
        """Return self; ValueError for a damping of first order."""
        if self.order == 1 and self.damping is not None:
            raise ValueError("a low_pass of order 1 has no damping: leave it out, or take order = 2")
        return self


class Structured(Protocol):
    """What these functions read of a specification."""

    @property
    def structure(self) -> Literal["biquads", "p", "pi", "pd", "pid"]:
        """The structure that is asked for."""

    @property
    def fixed(self) -> Fixed:
        """Numbers of the PID that are fixed."""

    @property
    def notches(self) -> tuple[Notch, ...]:
        """In any order."""

    @property
    def low_pass(self) -> LowPass | None:
        """None without one."""


def refuse_contradictions(spec: Structured) -> None:
    """Refuse parameters of a structure that the specification has not, and contradictions between them.

    Parameters
    ----------
    spec : Structured

    Raises
    ------
    ValueError
        One line that names the key.
    """
    is_pid = spec.structure in PID_STRUCTURES
    has_derivative = spec.structure in ("pd", "pid")
    given = {
        "fixed.kp": (spec.fixed.kp is not None, is_pid),
        "fixed.ti_s": (spec.fixed.ti_s is not None, spec.structure in ("pi", "pid")),
        "fixed.td_s": (spec.fixed.td_s is not None, has_derivative),
        "fixed.tf_s": (spec.fixed.tf_s is not None, has_derivative),
        "notches": (bool(spec.notches), is_pid),
        "low_pass": (spec.low_pass is not None, is_pid),
    }
    for key, (is_given, is_part) in given.items():
        if is_given and not is_part:
            raise ValueError(
                f"{key} is given, but a controller of structure {spec.structure!r} has none: leave it out "
                f"or take structure = {'pi' if key == 'fixed.ti_s' else 'pid'!r}"
            )
    if spec.fixed.kp == 0:
        raise ValueError("fixed.kp must not be 0")
    if spec.low_pass is not None and spec.low_pass.order == 1 and has_derivative:
        raise ValueError(
            f"low_pass of order 1 beside Tf: structure {spec.structure!r} has a filter of first order, Tf; "
            "take order = 2"
        )
    stated = sorted(notch.frequency_hz for notch in spec.notches if notch.frequency_hz is not None)
    for lower, upper in pairwise(stated):
        if upper - lower <= _SAME_FREQUENCY * upper:
            raise ValueError(
                f"two notches at one frequency, {lower:.6g} Hz: state one, as deep as both together"
            )


def order_of_structure(spec: Structured) -> int:
    """Number of states of a structure p, pi, pd or pid with its notches and low-pass."""
    order = {"p": 0, "pi": 1, "pd": 1, "pid": 2}[spec.structure] + 2 * len(spec.notches)
    if spec.low_pass is not None:
        order += spec.low_pass.order
    return order


def refuse_sampling(spec: Structured, dt_s: float) -> None:
    """Refuse fixed parameters that a controller of this period cannot have.

    Parameters
    ----------
    spec : Structured
    dt_s : float
        Period of the controller, s, positive.

    Raises
    ------
    ValueError
        One line: a corner from Nyquist on, a notch wider than its frequency allows, or a derivative filter
        faster than half a sample, whose pole in z is negative: the command would alternate.
    """
    nyquist_hz = 0.5 / dt_s
    at_rate = f"half of the controller's rate, {nyquist_hz:.6g} Hz"
    for number, notch in enumerate(spec.notches, 1):
        frequency_hz = notch.frequency_hz
        if frequency_hz is None:
            if notch.width_hz is not None and not notch.width_hz < nyquist_hz / 2:
                raise ValueError(
                    f"notch {number}: width_hz = {notch.width_hz:.6g} must be below a quarter of the "
                    f"controller's rate, {nyquist_hz / 2:.6g} Hz"
                )
            continue
        if not frequency_hz < nyquist_hz:
            raise ValueError(f"notch {number}: frequency_hz = {frequency_hz:.6g} must be below {at_rate}")
        if notch.width_hz is None:
            continue
        # Where the damping ratio of its poles would be 1.
        widest_hz = width_of_damping(1.0, tustin_corner(frequency_hz, dt_s), dt_s)
        if not notch.width_hz < widest_hz:
            raise ValueError(
                f"notch {number}: width_hz = {notch.width_hz:.6g} is too wide for a notch at "
                f"{frequency_hz:.6g} Hz: less than {widest_hz:.6g}"
            )
    corner_hz = None if spec.low_pass is None else spec.low_pass.frequency_hz
    if corner_hz is not None and not corner_hz < nyquist_hz:
        raise ValueError(f"low_pass: frequency_hz = {corner_hz:.6g} must be below {at_rate}")
    tf_s = spec.fixed.tf_s
    if tf_s is not None and not tf_s >= dt_s / 2:
        raise ValueError(
            f"fixed.tf_s = {tf_s:.6g} s is faster than the sample: at least {dt_s / 2:.6g} s, half of the "
            f"controller's period, below which the command alternates"
        )


def parts_of(spec: Structured, dt_s: float, scale_rad_s: float) -> tuple[Part, ...]:
    """Parts of a cascade: the PID, the low-pass, and the notches, those of which nothing is fixed last.

    Parameters
    ----------
    spec : Structured
        Of a structure p, pi, pd or pid, that `refuse_sampling` has passed.
    dt_s : float
        Period of the controller, s.
    scale_rad_s : float
        Frequency that is 1 in the cascade, rad/s.
    """
    half_sample = dt_s * scale_rad_s / 2.0

    def scaled(time_s: float | None) -> float | None:
        """A time in units of 1/scale."""
        return None if time_s is None else time_s * scale_rad_s

    def corner(frequency_hz: float | None) -> float | None:
        """A frequency in Hz as one of the Tustin plane, in units of the scale."""
        return None if frequency_hz is None else tustin_corner(frequency_hz, dt_s) / half_sample

    structure = spec.structure
    assert structure != "biquads"
    pid = PidPart(
        structure=structure,
        kp=spec.fixed.kp,
        ti=scaled(spec.fixed.ti_s),
        td=scaled(spec.fixed.td_s),
        tf=scaled(spec.fixed.tf_s),
        shortest_filter=half_sample,
    )
    parts: list[Part] = [pid]
    if spec.low_pass is not None:
        low_pass = spec.low_pass
        parts.append(
            LowPassPart(low_pass.order, corner(low_pass.frequency_hz), low_pass.damping, half_sample)
        )
    notches = []
    for notch in spec.notches:
        width_tan = None
        damping = notch.damping
        if notch.width_hz is not None:
            width_tan = tustin_corner(notch.width_hz, dt_s)
            if notch.frequency_hz is not None:
                damping = damping_of_width(notch.width_hz, tustin_corner(notch.frequency_hz, dt_s), dt_s)
                width_tan = None
        depth = None if notch.depth_db is None else 10.0 ** (notch.depth_db / _DECIBELS)
        notches.append(NotchPart(corner(notch.frequency_hz), damping, width_tan, depth, half_sample))
    # An order below is tried without the last ones, which then have to be free.
    notches.sort(key=lambda notch: notch.is_free)
    return (*parts, *notches)
