"""The controller as it runs: discrete state space with saturation, rate limit, anti-windup and one sample of
delay."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import control
import numpy as np
import scipy.io
import scipy.linalg

from control_design.plants.ellipses import Complex, Real, readonly_real
from control_design.plants.plant_set import frequency_response

_FORMAT = "flexlink-controller-1"


@dataclass(frozen=True, eq=False)
class Controller:
    """u = K (r - y): x+ = A x + B e + M (u_limited - u), u = C x + D e, all SISO.

    A (n, n), B (n, 1), C (1, n), D (1, 1); dt_s > 0. input_limit, rate_limit: saturation (both signs) and
    largest change per second of the command, or None. anti_windup_gain M (n, 1): back-calculation in observer
    form; the controller state then follows A - M C while the command is limited, so M must make that stable;
    None = `observer_gain(A, B, C, D)`. computational_delay_samples: the command computed from the measurement
    at t_k is applied from t_{k + delay} on.
    """

    A: Real
    B: Real
    C: Real
    D: Real
    dt_s: float
    computational_delay_samples: int = 1
    input_limit: float | None = None
    rate_limit: float | None = None
    anti_windup_gain: Real | None = None
    name: str = "controller"

    def __post_init__(self) -> None:
        for name in ("A", "B", "C", "D"):
            object.__setattr__(self, name, readonly_real(getattr(self, name)))
        n = self.A.shape[0]
        shapes = {name: getattr(self, name).shape for name in ("A", "B", "C", "D")}
        if shapes != {"A": (n, n), "B": (n, 1), "C": (1, n), "D": (1, 1)}:
            raise ValueError(f"controller needs A (n, n), B (n, 1), C (1, n), D (1, 1); got {shapes}")
        for name in ("A", "B", "C", "D"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ValueError(f"controller matrix {name} has a value that is not finite")
        if not (self.dt_s > 0 and np.isfinite(self.dt_s)):
            raise ValueError(f"dt_s must be positive; got {self.dt_s}")
        if not self.computational_delay_samples >= 0:
            raise ValueError(
                f"computational_delay_samples must not be negative; got {self.computational_delay_samples}"
            )
        for name in ("input_limit", "rate_limit"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive or None; got {value}")
        gain = self.anti_windup_gain
        gain = (
            observer_gain(self.A, self.B, self.C, self.D) if gain is None else np.asarray(gain, dtype=float)
        )
        if gain.shape != (n, 1) or not np.all(np.isfinite(gain)):
            raise ValueError(f"anti_windup_gain must be finite and ({n}, 1); got shape {gain.shape}")
        object.__setattr__(self, "anti_windup_gain", readonly_real(gain))
        if n and (self.input_limit is not None or self.rate_limit is not None):
            radius = float(np.max(np.abs(np.linalg.eigvals(self.A - gain @ self.C))))
            if not radius < 1:
                raise ValueError(
                    f"anti_windup_gain leaves a pole of A - M C at radius {radius:.6g}: it would wind up"
                )

    @property
    def order(self) -> int:
        return int(self.A.shape[0])

    @property
    def poles(self) -> Complex:
        """Poles in z, (n,)."""
        if self.order == 0:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def response(self, omega_rad_s: Real, *, with_delay: bool = True) -> Complex:
        """K(e^{j omega dt}), (F,), times z^-delay unless with_delay is False."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        value = frequency_response(self.to_control(), omega)
        if with_delay:
            value = value * np.exp(-1j * omega * self.dt_s * self.computational_delay_samples)
        return value

    def to_control(self, *, include_delay: bool = False) -> control.StateSpace:
        """Linear part as `control.StateSpace`; with include_delay the delay's states come after K's."""
        a, b, c, d = np.array(self.A), np.array(self.B), np.array(self.C), np.array(self.D)
        if include_delay:
            for _ in range(self.computational_delay_samples):
                n = a.shape[0]
                a = np.block([[a, np.zeros((n, 1))], [c, np.zeros((1, 1))]])
                b = np.vstack([b, d])
                c = np.hstack([np.zeros((1, n)), np.ones((1, 1))])
                d = np.zeros((1, 1))
        return control.ss(a, b, c, d, self.dt_s)

    def stepper(self) -> ControllerStepper:
        """A fresh machine-side instance at rest."""
        return ControllerStepper(self)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; `from_dict` restores it exactly (floats are written with all their digits)."""
        assert self.anti_windup_gain is not None
        return {
            "format": _FORMAT,
            "name": self.name,
            "law": "u = C x + D e; x+ = A x + B e + M (u_limited - u); e = reference - measurement",
            "dt_s": self.dt_s,
            "computational_delay_samples": self.computational_delay_samples,
            "input_limit": self.input_limit,
            "rate_limit": self.rate_limit,
            "A": self.A.tolist(),
            "B": self.B.tolist(),
            "C": self.C.tolist(),
            "D": self.D.tolist(),
            "anti_windup_gain": self.anti_windup_gain.tolist(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Controller:
        """Inverse of `to_dict`.

        Raises
        ------
        ValueError
            If it is not a controller of this format, naming the missing key.
        """
        if data.get("format") != _FORMAT:
            raise ValueError(f"not a controller file: format is {data.get('format')!r}, expected {_FORMAT!r}")
        try:
            d = np.array(data["D"], dtype=float).reshape(1, 1)
            a = np.array(data["A"], dtype=float)
            n = a.shape[0] if a.size else 0
            return cls(
                A=a.reshape(n, n),
                B=np.array(data["B"], dtype=float).reshape(n, 1),
                C=np.array(data["C"], dtype=float).reshape(1, n),
                D=d,
                dt_s=float(data["dt_s"]),
                computational_delay_samples=int(data["computational_delay_samples"]),
                input_limit=data["input_limit"],
                rate_limit=data["rate_limit"],
                anti_windup_gain=np.array(data["anti_windup_gain"], dtype=float).reshape(n, 1),
                name=str(data["name"]),
            )
        except KeyError as error:
            raise ValueError(f"controller file lacks the key {error.args[0]!r}") from error

    def to_json(self) -> str:
        """Readable JSON text."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Controller:
        """Inverse of `to_json`; ValueError with one line on bad input."""
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(
                f"controller JSON: {error.msg} at line {error.lineno}, column {error.colno}"
            ) from error
        if not isinstance(data, dict):
            raise ValueError(f"controller JSON must be an object; got {type(data).__name__}")
        return cls.from_dict(data)

    def save_mat(self, file: str | PathLike[str] | BinaryIO) -> None:
        """MATLAB 5 file (path or stream) with A, B, C, D, M, dt_s, limits (inf = none) and the delay."""
        none = float("inf")
        scipy.io.savemat(
            Path(file) if isinstance(file, (str, PathLike)) else file,  # type: ignore[arg-type]  # streams, too
            {
                "A": self.A,
                "B": self.B,
                "C": self.C,
                "D": self.D,
                "anti_windup_gain": self.anti_windup_gain,
                "dt_s": self.dt_s,
                "computational_delay_samples": self.computational_delay_samples,
                "input_limit": none if self.input_limit is None else self.input_limit,
                "rate_limit": none if self.rate_limit is None else self.rate_limit,
                "name": self.name,
            },
        )

    @classmethod
    def load_mat(cls, path: str | PathLike[str]) -> Controller:
        """Inverse of `save_mat`."""
        data = scipy.io.loadmat(Path(path))
        missing = [key for key in ("A", "B", "C", "D", "dt_s") if key not in data]
        if missing:
            raise ValueError(f"{path}: not a controller file, it lacks {missing[0]!r}")
        n = data["D"].size and data["A"].shape[0]

        def limit(key: str) -> float | None:
            value = float(data[key].item())
            return value if np.isfinite(value) else None

        return cls(
            A=data["A"].reshape(n, n),
            B=data["B"].reshape(n, 1),
            C=data["C"].reshape(1, n),
            D=data["D"].reshape(1, 1),
            dt_s=float(data["dt_s"].item()),
            computational_delay_samples=int(data["computational_delay_samples"].item()),
            input_limit=limit("input_limit"),
            rate_limit=limit("rate_limit"),
            anti_windup_gain=data["anti_windup_gain"].reshape(n, 1),
            name=str(data["name"].item()),
        )


class ControllerStepper:
    """One running controller: feed the error at t_k, get the limited command computed at t_k.

    The computational delay belongs to whoever applies the command (`closed_loop.simulate` queues it): a
    real-time loop has it by itself.
    """

    def __init__(self, controller: Controller) -> None:
        assert controller.anti_windup_gain is not None
        self._controller = controller
        self._a, self._b = np.array(controller.A), np.array(controller.B[:, 0])
        self._c, self._d = np.array(controller.C[0]), float(controller.D[0, 0])
        self._m = np.array(controller.anti_windup_gain[:, 0])
        self._limit = np.inf if controller.input_limit is None else controller.input_limit
        rate = np.inf if controller.rate_limit is None else controller.rate_limit
        self._change = rate * controller.dt_s
        self.reset()

    def reset(self) -> None:
        """Back to rest: zero state, previous command zero."""
        self._x = np.zeros(self._controller.order)
        self._last = 0.0
        self.limited = False

    def step(self, error: float) -> float:
        """Command for the error at this sample; `limited` tells whether a limit was active."""
        wanted = float(self._c @ self._x) + self._d * error
        command = min(max(wanted, self._last - self._change), self._last + self._change)
        command = min(max(command, -self._limit), self._limit)
        self.limited = command != wanted
        self._x = self._a @ self._x + self._b * error + self._m * (command - wanted)
        self._last = command
        return command


def observer_gain(A: Real, B: Real, C: Real, D: Real) -> Real:
    """Back-calculation gain M (n, 1) with A - M C stable: a Kalman gain for state noise through B and output
    noise D.

    For D != 0 and a minimum-phase controller the conditioning technique would take M = B/D, which places A -
    M C at the zeros of the controller; a designed controller may have zeros outside the circle, where that
    winds up for ever. The Riccati gain is stable for every observable (A, C) and comes close to it otherwise.
    """
    n = A.shape[0]
    if n == 0:
        return np.zeros((0, 1))
    size = float(np.linalg.norm(B)) ** 2 or 1.0
    state_noise = B @ B.T + 1e-6 * size * np.eye(n)
    scale = float((C @ state_noise @ C.T).item()) or 1.0
    output_noise = np.array([[float(D[0, 0]) ** 2 + 1e-4 * scale]])
    try:
        p = scipy.linalg.solve_discrete_are(A.T, C.T, state_noise, output_noise)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(
            "no anti-windup gain found: the controller has a marginal mode that its output does not show"
        ) from error
    gain = A @ p @ C.T / (C @ p @ C.T + output_noise)
    return np.asarray(gain, dtype=np.float64)
