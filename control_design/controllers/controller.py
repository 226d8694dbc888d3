"""The controller as it runs: a discrete state space with limits, anti-windup, delay and friction
feed-forward.

`Controller` is the law with everything that a machine needs beside its matrices: saturation and rate limit of
the command, what an active limit does to the states, the computational delay, and a feed-forward that gives
back what dry friction takes off the command. It answers for analysis (`response`, `to_control`) and converts
units (`in_units`). `ControllerStepper` runs it sample by sample, in the same order of operations as the C
code. `FrictionFeedforward` is the friction's part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from control_design.controllers.anti_windup import anti_windup_gain, anti_windup_radius
from control_design.controllers.engineers_numbers import ControllerNumbers, engineers_numbers
from control_design.controllers.law import Law
from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.plant_set import delayed
from ident.data.arrays import lock
from ident.data.keywords import clear_constructor, refuse_rate

if TYPE_CHECKING:
    import control

    # Whoever has one loop reads a number, whoever has several a tuple.
    Limit = Any
else:
    Limit = float | tuple[float | None, ...] | None


@clear_constructor
@dataclass(frozen=True, eq=False)
class Controller(Law):
    """Controller u = K (r - y) of Y errors and U commands: x+ = A x + B e + M (u_limited - u), u = C x + D e.

    Parameters
    ----------
    A, B, C, D : (n, n), (n, Y), (U, n), (U, Y) array
        Finite. The law that a processor runs, `K_without_delay`: the machine adds the computational delay.
        Margins and certificates are about `K_with_delay` = z^-computational_delay_samples K_without_delay.
    dt_s : float
        Sampling period in seconds, positive.
    computational_delay_samples : int
        From measurement to command; whole, not negative. By default 1: a real-time loop writes its command
        one sample after it has read the sensor.
    input_limit : float, tuple of them, or None
        Saturation of the command, both signs, in its units, positive; with U > 1 a tuple of U, None for an
        actuator without.
    rate_limit : float, tuple of them, or None
        Largest change of the command per second, likewise.
    anti_windup_gain : (n, U) array or None
        M: what an active limit does to the states, with A - M C stable; None takes that of `anti_windup`.
    name : str
        Stands in files and errors.
    feedforward : FrictionFeedforward or None
        Joins u before it is limited; for one loop only.
    signals : str
        Columns and units of error and command, in words.
    gain_unit : str
        Unit of command over error, "V/rad"; "" where it is not known.

    Raises
    ------
    ValueError
        For matrices, limits, delay or gain that do not fit, or a gain that would wind up.

    Examples
    --------
    >>> law = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[2.0]], dt_s=0.01, input_limit=24.0)
    >>> law.order
    1
    >>> law.engineers_numbers().rows()
    [('PI', 'Kp = 1.975, Ti = 0.395 s')]
    """

    kind = "controller"
    equations = (
        "u = C x + D e; x+ = A x + B e + M (u_limited - u); e = reference - measurement. A, B, C, D: "
        "K_without_delay, the machine adds the delay; the margins are those of K_with_delay"
    )

    computational_delay_samples: int = 1
    input_limit: Limit = None
    rate_limit: Limit = None
    anti_windup_gain: Real | None = None
    name: str = "controller"
    feedforward: FrictionFeedforward | None = None
    signals: str = field(default="", metadata={"since": 8})
    gain_unit: str = field(default="", metadata={"since": 11})

    def __post_init__(self) -> None:
        """Check limits and delay, and find the anti-windup gain where none is stated (ValueError, see the
        class; where no gain is found it is raised by `anti_windup_gain`)."""
        super().__post_init__()
        delay = self.computational_delay_samples
        if not (delay >= 0 and int(delay) == delay):
            raise ValueError(f"computational_delay_samples must not be negative, and whole; got {delay}")
        object.__setattr__(self, "computational_delay_samples", int(delay))
        for name in ("input_limit", "rate_limit"):
            object.__setattr__(self, name, self._checked_limit(name))
        if self.feedforward is not None and self.D.size > 1:
            raise ValueError("a friction feed-forward is for one loop; got a controller of several")

        # The gain: as given, or one that suits the limits.
        gain = self.anti_windup_gain
        if gain is None:
            gain = self.gain_for_limits()
        object.__setattr__(self, "anti_windup_gain", np.asarray(gain, dtype=float))
        lock(self, "anti_windup_gain")
        assert self.anti_windup_gain is not None
        shape = (self.order, self.D.shape[0])
        if self.anti_windup_gain.shape != shape or not np.all(np.isfinite(self.anti_windup_gain)):
            raise ValueError(
                f"anti_windup_gain must be finite and {shape}; got shape {self.anti_windup_gain.shape}"
            )

        # One that leaves the states a mode that grows while a limit is active is refused.
        if self.order and self.limited_commands.any():
            radius = anti_windup_radius(self.A, self.C, self.anti_windup_gain)
            if not radius < 1:
                raise ValueError(
                    f"anti_windup_gain leaves a pole of A - M C at radius {radius:.6g}: it would wind up"
                )

    def _checked_limit(self, name: str) -> Limit:
        """The limit of that name as a number or None, for a sequence as a tuple of these, one for each
        command. Raises ValueError for a wrong number of values, or one that is not positive (nan among
        them; infinite ones pass), float's own error for what is no number."""
        value = getattr(self, name)
        inputs = self.D.shape[0]
        is_sequence = isinstance(value, tuple | list) or np.ndim(value) > 0
        limits: tuple[float | None, ...]
        if is_sequence:
            limits = tuple(None if limit is None else float(limit) for limit in value)
            wrong_count = len(limits) != inputs
        else:
            limits = (None if value is None else float(value),)
            wrong_count = value is not None and inputs > 1
        if wrong_count:
            raise ValueError(f"{name} needs one value for each of {inputs} actuators; got {value!r:.80}")
        if not all(limit is None or limit > 0 for limit in limits):
            raise ValueError(f"{name} must be positive or None; got {value}")
        return limits if is_sequence else limits[0]

    def gain_for_limits(self, slower: float = 1.0) -> Real:
        """Anti-windup gain (n, U) that suits the limits; zero for commands without one.

        slower : the factor of `anti_windup.anti_windup_gain` by which the states follow a limit more slowly,
        positive. Raises ValueError where no gain makes A - M C stable.
        """
        gain = np.zeros((self.order, self.D.shape[0]))
        limited = self.limited_commands
        if limited.any():
            try:
                gain[:, limited] = anti_windup_gain(
                    self.A, self.B, self.C[limited], self.D[limited], slower=slower
                )
            except ValueError:
                if limited.all():
                    raise
                # A mode that only commands without a limit show: it cannot wind up, but A - M C needs a gain
                # for them as well.
                return anti_windup_gain(self.A, self.B, self.C, self.D, slower=slower)
        return gain

    @property
    def limited_commands(self) -> Boolean:
        """Whether each command has a saturation or a rate limit, (U,); an infinite limit is none."""
        smaller_limit = np.minimum(self.limits("input_limit"), self.limits("rate_limit"))
        return np.asarray(np.isfinite(smaller_limit))

    @classmethod
    def proportional(cls, gain: float, dt_s: float, **settings: Any) -> Controller:
        """Controller u = gain e without states at a period dt_s in seconds; settings are further fields.

        Raises ValueError as the class does, for a gain or a period that is not finite among others, and for
        a period that is rather a rate in Hz.
        """
        refuse_rate(dt_s)
        no_states = np.zeros((0, 0))
        no_input = np.zeros((0, 1))
        no_output = np.zeros((1, 0))
        return cls(no_states, no_input, no_output, np.array([[gain]]), dt_s, **settings)

    def response(self, omega_rad_s: Real, *, with_delay: bool = True) -> Complex:
        """K(e^{j omega dt}) at omega (F,) in rad/s: (F,) complex, of several errors or commands (F, U, Y).

        With its computational delay, `K_with_delay`, unless with_delay is False. Limits and feed-forward do
        not count. At a pole on the circle (an integrator's at 0) numpy's LinAlgError.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        value = super().response(omega)
        if with_delay:
            delay = np.exp(-1j * omega * self.dt_s * self.computational_delay_samples)
            if value.ndim == 3:
                delay = delay[:, None, None]
            value = value * delay
        return value

    def limits(self, name: str) -> Real:
        """Limits of every actuator (U,), infinite where there is none, in units of the command or in these
        per second; name: "input_limit" or "rate_limit" (AttributeError for a name that is no field)."""
        value = getattr(self, name)
        limits = value if isinstance(value, tuple) else (value,) * self.D.shape[0]
        return np.array([np.inf if limit is None else limit for limit in limits], dtype=np.float64)

    def in_units(self, error: Real, command: Real) -> Controller:
        """Controller of the same machine with its signals in other units.

        error : (Y,) array, old error over new one. command : (U,) array, old command over new one. Factors
        may be negative: a signal that counts the other way. A command of 0 and NaN make matrices that the
        class refuses (ValueError); an error of 0 passes, as a controller that sees nothing of it.
        """
        limits: dict[str, Any] = {}
        for name in ("input_limit", "rate_limit"):
            scaled = []
            for limit in self.limits(name) / np.abs(command):
                scaled.append(None if limit == np.inf else float(limit))
            limits[name] = tuple(scaled) if isinstance(getattr(self, name), tuple) else scaled[0]
        feedforward = self.feedforward
        if feedforward is not None:
            # Friction is a command that goes with the sign of the reference's speed.
            reference_factor = abs(float(error[0]))
            friction_factor = float(np.sign(error[0]) / command[0])
            feedforward = FrictionFeedforward(
                level=friction_factor * feedforward.level,
                width=feedforward.width / reference_factor,
                lag_s=feedforward.lag_s,
                excess=friction_factor * feedforward.excess,
                fall=feedforward.fall / reference_factor,
            )
        assert self.anti_windup_gain is not None
        return replace(
            self,
            B=self.B * error,
            C=self.C / command[:, None],
            D=self.D * error / command[:, None],
            anti_windup_gain=self.anti_windup_gain * command,
            feedforward=feedforward,
            **limits,
        )

    def to_control(self, *, include_delay: bool = False) -> control.StateSpace:
        """Linear part as `control.StateSpace`, named after what it is.

        Parameters
        ----------
        include_delay : bool
            False: `K_without_delay` = C (z I - A)^-1 B + D, which the C code runs. Its margins are better
            than those of the loop. True: `K_with_delay`, which margins and certificates are about; the
            delay's states come after those of A. Without computational delay both are the same, and named
            `K`.
        """
        delay = self.computational_delay_samples
        system = delayed(super().to_control(), delay if include_delay else 0)
        if delay == 0:
            system.name = "K"
        else:
            system.name = "K_with_delay" if include_delay else "K_without_delay"
        return system

    def named_systems(self) -> dict[str, dict[str, Any]]:
        """`K_without_delay` and `K_with_delay` of `to_control` for files: each a dictionary of the matrices
        A, B, C, D and of dt_s in seconds."""
        systems = {
            "K_without_delay": self.to_control(),
            "K_with_delay": self.to_control(include_delay=True),
        }
        described: dict[str, dict[str, Any]] = {}
        for name, system in systems.items():
            described[name] = {matrix: np.asarray(getattr(system, matrix)) for matrix in "ABCD"}
            described[name]["dt_s"] = self.dt_s
        return described

    def engineers_numbers(self) -> ControllerNumbers | None:
        """The law of one loop as Kp, Ti, Td, Tf, notches and low-passes, or as leads, lags and other factors,
        without the computational delay; None where it has none (see `controllers.engineers_numbers`)."""
        return engineers_numbers(self)

    def to_dict(self) -> dict[str, Any]:
        """As of `Law`, with the law of one loop in an engineer's numbers beside it, under `engineers_numbers`
        (null where it has none). Reading ignores them."""
        plain = super().to_dict()
        if self.D.size == 1:
            numbers = self.engineers_numbers()
            plain["engineers_numbers"] = None if numbers is None else numbers.to_dict()
        return plain

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Controller that `to_dict` wrote; a file may lack feed-forward, signals, unit and `named_systems`.
        Raises ValueError for what is no such file, naming the key."""
        values = data.get("feedforward")
        feedforward = None
        if values is not None:
            try:
                feedforward = FrictionFeedforward(**values)
            except TypeError as error:
                raise ValueError(
                    f"feedforward needs level, width, lag_s, excess and fall; got {values!r:.80}"
                ) from error
        return super().from_dict({"signals": "", "gain_unit": "", **data, "feedforward": feedforward})

    def stepper(self) -> ControllerStepper:
        """A running instance of the controller, at rest; each call gives another one."""
        return ControllerStepper(self)


class ControllerStepper:
    """One running controller: it takes the error at t_k and gives the limited command computed at t_k.

    Of several loops it takes the errors (Y,) and gives the commands (U,), each limited by itself, without a
    friction feed-forward. The computational delay belongs to whoever applies the command
    (`closed_loop.simulate` queues it): a real-time loop has it by itself.
    """

    def __init__(self, controller: Controller) -> None:
        """A stepper of the controller at rest."""
        self._controller = controller
        self._feedforward = controller.feedforward
        self._limit = controller.limits("input_limit")
        self._largest_change = controller.limits("rate_limit") * controller.dt_s
        self.reset()

    def reset(self) -> None:
        """Go back to rest: states, previous command and previous reference are zero."""
        self._states = np.zeros(self._controller.order)
        self._last_command = np.zeros(self._controller.D.shape[0])
        self._last_reference = 0.0
        self._smoothed_friction = 0.0
        self.limited = np.zeros(self._last_command.size, dtype=bool)

    def step(self, error: Any, reference: float = 0.0) -> Any:
        """Command for the error at this sample: a number for a number, (U,) for errors (Y,).

        Parameters
        ----------
        error : float or (Y,) array
            Reference minus measurement; another length is numpy's ValueError. One that is not finite gives
            NaN, whatever the limits, which the states keep until `reset`.
        reference : float
            The set point, which the feed-forward (if any) looks at; it rested at zero before. One that is not
            finite makes the smoothed friction NaN until `reset`.

        Notes
        -----
        Afterwards `limited` (U,) tells where a limit was active.
        """
        law = self._controller
        errors = np.atleast_1d(np.asarray(error, dtype=np.float64))
        assert law.anti_windup_gain is not None
        if self._feedforward is not None:
            moved = reference - self._last_reference
            friction = 0.0
            if moved:
                friction = float(self._feedforward.friction(np.asarray(moved), law.dt_s))
            self._smoothed_friction += self._feedforward.share(law.dt_s) * (
                friction - self._smoothed_friction
            )
        self._last_reference = reference
        # An error that is infinite or NaN becomes NaN in every command: errors - errors is zero for all
        # others.
        not_a_number = np.sum(errors - errors)
        wanted = law.C @ self._states + law.D @ errors + not_a_number + self._smoothed_friction
        # Compared as the code in C compares, also what is not a number: the rate limit first, then the
        # saturation.
        command = wanted
        for low, high in (
            (self._last_command - self._largest_change, self._last_command + self._largest_change),
            (-self._limit, self._limit),
        ):
            raised = np.where(command < low, low, command)
            command = np.where(command > high, high, raised)
        self.limited = command != wanted
        limit_excess = command - wanted
        self._states = law.A @ self._states + law.B @ errors + law.anti_windup_gain @ limit_excess
        self._last_command = command
        if np.ndim(error):
            return command
        return float(command[0])


@dataclass(frozen=True)
class FrictionFeedforward:
    """Friction at the reference's speed, smoothed, as late as the loop follows: it joins the command.

    Parameters
    ----------
    level : float
        Coulomb's friction in units of the command; negative where a positive command moves the output down.
    width : float
        Pre-sliding deflection, in units of the reference, positive.
    lag_s : float
        Delay of the closed loop towards standstill in seconds, positive.
    excess : float
        Stribeck's excess at standstill, in units of the command, of the sign of `level`.
    fall : float
        Speed over which the excess falls by a factor of e, in units of the reference per second, positive.

    Raises
    ------
    ValueError
        For level and excess of different signs, other values that are not positive, or not finite.

    Notes
    -----
    At the reference's speed v it is sign(v) (level + excess exp(-|v|/fall)). The sign turns round while the
    speed goes through +-width/lag_s, at which the reference moves by `width` while the loop answers. It
    passes a first-order lag of lag_s, p+ = p + share (friction - p). There is no feedback in it: poles and
    margins stay, and it dies out at rest. Neglected: friction that depends on position or load; motion that
    something other than the reference causes; a reference that comes in steps longer than a sample.
    """

    level: float
    width: float
    lag_s: float
    excess: float = 0.0
    fall: float = 1.0

    def __post_init__(self) -> None:
        """Take numpy scalars, which JSON and C write otherwise, as numbers of Python, and check all
        values."""
        for name, value in vars(self).items():
            if isinstance(value, np.generic):
                object.__setattr__(self, name, value.item())
        one_sign = self.level * self.excess >= 0
        positive = min(self.width, self.lag_s, self.fall) > 0
        if not (one_sign and positive and np.all(np.isfinite(list(vars(self).values())))):
            raise ValueError(
                f"a friction feed-forward needs level, excess of one sign, width, lag_s, fall > 0; got {self}"
            )

    def share(self, dt_s: float) -> float:
        """Share, 0 to 1, of its way that the lag goes in a sample of dt_s seconds (positive, not checked),
        1 - exp(-dt_s/lag_s)."""
        return float(-np.expm1(-dt_s / self.lag_s))

    def turn(self, dt_s: float) -> float:
        """Motion of the reference in a sample of dt_s seconds, in its units, from which on the sign of its
        speed counts in full; dt_s positive (not checked)."""
        return self.width * dt_s / self.lag_s

    def friction(self, moved: Real, dt_s: float) -> Real:
        """Friction (T,) before the lag, in units of the command, for the motion (T,) of the reference in each
        sample of dt_s > 0 seconds; NaN for a motion that is NaN."""
        strength = self.level + self.excess * np.exp(-np.abs(moved) / (self.fall * dt_s))
        smooth_sign = np.minimum(np.maximum(moved / self.turn(dt_s), -1.0), 1.0)
        return np.asarray(smooth_sign * strength)

    def signal(self, reference: Real, dt_s: float) -> Real:
        """What joins the command, (T,) in its units, for a reference (T,) that rested at zero before, sampled
        every dt_s seconds; NaN from the first sample on that is NaN."""
        # Imported here: every command would wait for it.
        from scipy.signal import lfilter

        share = self.share(dt_s)
        friction = self.friction(np.diff(reference, prepend=0.0), dt_s)
        return np.asarray(lfilter([share], [1.0, share - 1.0], friction))
