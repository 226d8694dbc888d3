"""The controller as it runs: discrete state space with saturation, rate limit, anti-windup, one sample of
delay, and what dry friction takes off the command given back from the reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from control_design.controllers.anti_windup import anti_windup_gain, anti_windup_radius
from control_design.controllers.law import Law
from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.plant_set import delayed
from ident.data.arrays import lock

if TYPE_CHECKING:
    import control

    Limit = Any  # whoever has one loop reads a number
else:
    Limit = float | tuple[float | None, ...] | None


@dataclass(frozen=True, eq=False)
class Controller(Law):
    """u = K (r - y): x+ = A x + B e + M (u_limited - u), u = C x + D e, of Y errors and U commands.

    A (n, n), B (n, Y), C (U, n), D (U, Y); dt_s > 0. input_limit, rate_limit: saturation (both signs) and
    largest change per second of the command, or None; with U > 1 a tuple of these. anti_windup_gain M (n, U):
    what an active limit does to the states, A - M C stable; None takes that of `anti_windup`.
    computational_delay_samples: from measurement to command. feedforward: joins u before it is limited, or
    None. signals: the columns and units of error and command, in words.

    A, B, C, D are `K_without_delay`, the law that a processor runs: the machine adds the computational delay.
    Margins and certificates are about `K_with_delay` = z^-computational_delay_samples K_without_delay.
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

    def __post_init__(self) -> None:
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
            found = self.anti_windup_gain.shape
            raise ValueError(f"anti_windup_gain must be finite and {shape}; got shape {found}")

        # One that leaves the states a mode that grows while a limit is active is refused.
        if self.order and self.limited_commands.any():
            radius = anti_windup_radius(self.A, self.C, self.anti_windup_gain)
            if not radius < 1:
                raise ValueError(
                    f"anti_windup_gain leaves a pole of A - M C at radius {radius:.6g}: it would wind up"
                )

    def _checked_limit(self, name: str) -> Limit:
        """A limit as a number or None, of several commands as a tuple of them. Raises ValueError."""
        value = getattr(self, name)
        inputs = self.D.shape[0]
        several = isinstance(value, tuple | list) or np.ndim(value) > 0
        if not several:
            if value is not None and inputs > 1:
                raise ValueError(f"{name} needs one value for each of {inputs} actuators; got {value!r:.80}")
            each: tuple[float | None, ...] = (None if value is None else float(value),)
        else:
            each = tuple(None if limit is None else float(limit) for limit in value)
            if len(each) != inputs:
                raise ValueError(f"{name} needs one value for each of {inputs} actuators; got {value!r:.80}")
        if not all(limit is None or limit > 0 for limit in each):
            raise ValueError(f"{name} must be positive or None; got {value}")
        return each if several else each[0]

    def gain_for_limits(self, slower: float = 1.0) -> Real:
        """Anti-windup gain (n, U) that suits the limits: of the commands that have one, zero without.

        slower: as of `anti_windup.anti_windup_gain`. Raises ValueError where there is none.
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
                # A mode that only commands without a limit show: it cannot wind up, but A - M C needs them.
                return anti_windup_gain(self.A, self.B, self.C, self.D, slower=slower)
        return gain

    @property
    def limited_commands(self) -> Boolean:
        """Whether a command has a limit, (U,)."""
        return np.asarray(np.isfinite(np.minimum(self.limits("input_limit"), self.limits("rate_limit"))))

    @classmethod
    def proportional(cls, gain: float, dt_s: float, **settings: Any) -> Controller:
        """u = gain e, without states; further settings as fields."""
        return cls(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[gain]]), dt_s, **settings)

    def response(self, omega_rad_s: Real, *, with_delay: bool = True) -> Complex:
        """K(e^{j omega dt}), (F,) or (F, U, Y), times z^-delay unless with_delay is False."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        value = super().response(omega)
        if with_delay:
            late = np.exp(-1j * omega * self.dt_s * self.computational_delay_samples)
            value = value * (late if value.ndim == 1 else late[:, None, None])
        return value

    def limits(self, name: str) -> Real:
        """input_limit or rate_limit of every actuator (U,), infinite where there is none."""
        value = getattr(self, name)
        each = value if isinstance(value, tuple) else (value,) * self.D.shape[0]
        return np.array([np.inf if one is None else one for one in each], dtype=np.float64)

    def in_units(self, error: Real, command: Real) -> Controller:
        """The same in other units: old = error (Y,) * new, old = command (U,) * new, of either sign."""
        given, own = self.feedforward, dict[str, Any]()
        for name in ("input_limit", "rate_limit"):
            most = tuple(None if one == np.inf else float(one) for one in self.limits(name) / np.abs(command))
            own[name] = most if isinstance(getattr(self, name), tuple) else most[0]
        if given is not None:
            size, worth = abs(float(error[0])), float(np.sign(error[0]) / command[0])
            given = FrictionFeedforward(
                worth * given.level, given.width / size, given.lag_s, worth * given.excess, given.fall / size
            )
        assert self.anti_windup_gain is not None
        return replace(
            self,
            B=self.B * error,
            C=self.C / command[:, None],
            D=self.D * error / command[:, None],
            anti_windup_gain=self.anti_windup_gain * command,
            feedforward=given,
            **own,
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
        """`K_without_delay` and `K_with_delay` of `to_control` for files: each as A, B, C, D and dt_s [s]."""
        systems = {
            "K_without_delay": self.to_control(),
            "K_with_delay": self.to_control(include_delay=True),
        }
        return {
            name: {matrix: np.asarray(getattr(system, matrix)) for matrix in "ABCD"} | {"dt_s": self.dt_s}
            for name, system in systems.items()
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Inverse of `to_dict`, as of `Law`; a file may lack feed-forward, signals and `named_systems`."""
        given = data.get("feedforward")
        try:
            made = None if given is None else FrictionFeedforward(**given)
        except TypeError as error:
            raise ValueError(
                f"feedforward needs level, width, lag_s, excess and fall; got {given!r:.80}"
            ) from error
        return super().from_dict({"signals": "", **data, "feedforward": made})

    def stepper(self) -> ControllerStepper:
        """A fresh machine-side instance at rest."""
        return ControllerStepper(self)


class ControllerStepper:
    """One running controller: feed the error at t_k, get the limited command computed at t_k; of several
    commands the errors (Y,) and commands (U,), each limited by itself, without a friction feed-forward.

    The computational delay belongs to whoever applies the command (`closed_loop.simulate` queues it): a
    real-time loop has it by itself.
    """

    def __init__(self, controller: Controller) -> None:
        self._k, self._given = controller, controller.feedforward
        self._limit = controller.limits("input_limit")
        self._change = controller.limits("rate_limit") * controller.dt_s
        self.reset()

    def reset(self) -> None:
        """Back to rest: zero state, previous command zero."""
        self._x, self._last = np.zeros(self._k.order), np.zeros(self._k.D.shape[0])
        self._reference, self._smoothed = 0.0, 0.0
        self.limited = np.zeros(self._last.size, dtype=bool)

    def step(self, error: Any, reference: float = 0.0) -> Any:
        """Command for the error at this sample, a number for a number; `limited` (U,) tells where a limit was
        active.

        reference: the set point, which the feed-forward (if any) looks at; it rested at zero before. An error
        that is not finite gives NaN, whatever the limits; states keep it until `reset`.
        """
        k, errors = self._k, np.atleast_1d(np.asarray(error, dtype=np.float64))
        assert k.anti_windup_gain is not None
        if self._given is not None:
            moved = reference - self._reference
            friction = float(self._given.friction(np.asarray(moved), k.dt_s)) if moved else 0.0
            self._smoothed += self._given.share(k.dt_s) * (friction - self._smoothed)
        self._reference = reference
        wanted = k.C @ self._x + k.D @ errors + np.sum(errors - errors) + self._smoothed
        command = wanted  # compared as the code in C compares, also what is not a number
        for low, high in (
            (self._last - self._change, self._last + self._change),
            (-self._limit, self._limit),
        ):
            command = np.where(command > high, high, np.where(command < low, low, command))
        self.limited = command != wanted
        self._x = k.A @ self._x + k.B @ errors + k.anti_windup_gain @ (command - wanted)
        self._last = command
        return command if np.ndim(error) else float(command[0])


@dataclass(frozen=True)
class FrictionFeedforward:
    """Friction at the reference's speed v, smoothed, as late as the loop follows.

    sign(v) (level + excess exp(-|v| / fall)), Coulomb's and Stribeck's; the sign turns round while the speed
    goes through +-width / lag_s, at which the reference moves by the pre-sliding deflection `width` while the
    loop answers. Through a first-order lag of lag_s, the delay of the closed loop towards standstill, it
    joins the command: p+ = p + share (friction - p). No feedback: poles and margins stay, and it dies out at
    rest.

    level, excess in units of the command, both below 0 where a positive command moves the output down; width
    > 0 of the reference, fall > 0 of the reference per second, lag_s > 0. Neglected: friction that depends on
    position or load; motion that something other than the reference causes; a reference that comes in steps
    longer than a sample.
    """

    level: float
    width: float
    lag_s: float
    excess: float = 0.0
    fall: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.generic):  # whose truths are not those of Python
                object.__setattr__(self, name, value.item())
        good = self.level * self.excess >= 0 and min(self.width, self.lag_s, self.fall) > 0
        if not (good and np.all(np.isfinite(list(vars(self).values())))):
            raise ValueError(
                f"a friction feed-forward needs level, excess of one sign, width, lag_s, fall > 0; got {self}"
            )

    def share(self, dt_s: float) -> float:
        """Of its way that the lag goes in a sample."""
        return float(-np.expm1(-dt_s / self.lag_s))

    def turn(self, dt_s: float) -> float:
        """Motion of the reference in a sample from which on its sign is whole."""
        return self.width * dt_s / self.lag_s

    def friction(self, moved: Real, dt_s: float) -> Real:
        """At the motion (T,) of the reference in each sample, before the lag."""
        strength = self.level + self.excess * np.exp(-np.abs(moved) / (self.fall * dt_s))
        return np.asarray(np.minimum(np.maximum(moved / self.turn(dt_s), -1.0), 1.0) * strength)

    def signal(self, reference: Real, dt_s: float) -> Real:
        """What joins the command, (T,), for a reference (T,) that rested at zero before."""
        from scipy.signal import lfilter  # here: every command would wait for it

        share = self.share(dt_s)
        friction = self.friction(np.diff(reference, prepend=0.0), dt_s)
        return np.asarray(lfilter([share], [1.0, share - 1.0], friction))
