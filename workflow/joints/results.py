"""What the steps of a run for several joints leave behind: a model with its ball for every operating point,
the controller, its certificate, the loop at every point."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from control_design.analysis.multivariable_certificate import MultivariableCertificate
from control_design.plants.multivariable import MultivariablePlant, ResponseBall
from control_design.plants.weights import RationalWeight
from ident.basis.mimo_model import MimoModel
from ident.checks.validation import FreshFit
from ident.data.finding import Finding
from ident.uncertainty.matrix_response import MatrixUncertainty
from workflow.joints.config import JointsConfig
from workflow.tasks.results import AnyResults, StageResult

Real = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointModel:
    """What the records of one operating point say, for Y outputs and U inputs.

    Attributes
    ----------
    name : str
        Of the operating point.
    model : MimoModel
    noise_std : (Y,) array
        Standard deviation of each output's noise.
    fit_percent : (records, Y) array
    rank_one : tuple of bool
        Whether each mode has one shape.
    Lo : (Y, P) array
        Left factor of the uncertainty ball (`ResponseBall`).
    Li_a, Li_b, Li_c, Li_d : arrays
        Its right factor as a state space.
    radius : float
        Of the ball.
    shown : MatrixUncertainty
        Balls at the frequencies of the pictures.
    warnings : tuple of Finding
    later : tuple of int
        Samples by which each input acts later than in model and ball. Their sizes do not change with it.
    fresh : tuple of tuples of FreshFit
        For every record that was kept back, how the model simulates each output.
    """

    name: str
    model: MimoModel
    noise_std: Real
    fit_percent: Real
    rank_one: tuple[bool, ...]
    Lo: Real
    Li_a: Real
    Li_b: Real
    Li_c: Real
    Li_d: Real
    radius: float
    shown: MatrixUncertainty
    warnings: tuple[Finding, ...] = ()
    later: tuple[int, ...] = ()
    fresh: tuple[tuple[FreshFit, ...], ...] = field(default=(), metadata={"since": 9})

    @property
    def shaped(self) -> bool:
        """Every mode has one shape."""
        return all(moved is not None for _, _, moved in self.modes)

    @property
    def states(self) -> int:
        """Order of the state space."""
        return len(self.model.state_space()[0])

    def plant(self, gain_error: float) -> MultivariablePlant:
        """The plant that design and certificate see.

        gain_error: share by which the gain of each input may be off, 0 for none.
        """
        # Imported here: it brings a plotting library with it.
        import control

        Li = control.ss(
            self.Li_a, self.Li_b, self.Li_c, self.Li_d, self.model.dt_s, remove_useless_states=False
        )
        gains = (gain_error,) * len(self.model.input_names) if gain_error else ()
        off = tuple(RationalWeight(numerator=(gain,), denominator=(1.0,)) for gain in gains)
        nominal = self.model.to_control()
        if any(self.later):
            chains = [
                control.ss(np.eye(n, k=-1), np.eye(n, 1), np.eye(1, n, n - 1), 0, nominal.dt)
                if n
                else control.ss([], [], [], 1, nominal.dt)
                for n in self.later
            ]
            nominal, Li = (system * control.append(*chains) for system in (nominal, Li))
        ball = ResponseBall(self.Lo, Li, self.radius, lowest_rad_s=float(self.shown.omega_rad_s[0]))
        return MultivariablePlant(self.name, nominal, ball, input_error=off)

    @property
    def modes(self) -> tuple[tuple[float, float, Real | None], ...]:
        """Frequency [rad/s], damping ratio, and motion of the outputs, largest 1, of every pole pair below
        the Nyquist frequency that has one shape (None: it has not)."""
        modes = []
        residues = self.model.residues()
        dt_s = self.model.dt_s
        for pole, residue in zip(residues.poles, residues.pole, strict=True):
            if not pole.imag:
                continue
            s = np.log(pole) / dt_s
            left, sizes, _ = np.linalg.svd(residue)
            # A mode moves all outputs in one shape: its residue has rank one, but for rounding.
            one_shape = sizes.size == 1 or sizes[1] < 1e-6 * sizes[0]
            moved = left[:, 0] / left[np.argmax(np.abs(left[:, 0])), 0]
            modes.append((float(abs(s)), float(-s.real / abs(s)), moved.real if one_shape else None))
        return tuple(sorted(modes, key=lambda mode: mode[0]))


@dataclass(frozen=True, eq=False)
class PointModels:
    """One per operating point."""

    points: tuple[PointModel, ...]


@dataclass(frozen=True, eq=False)
class JointsCertificate:
    """Certificate of a controller for several joints; None where there is no controller."""

    certificate: MultivariableCertificate | None

    @property
    def certified(self) -> bool:
        return self.certificate is not None and self.certificate.met


@dataclass(frozen=True, eq=False)
class JointsRun:
    """A step of all joints at an operating point. output (T, Y), command (T, U); settled: every output ends
    within a tenth of its step; overshoot (Y,) over the step; limited: share of samples at a limit."""

    point: str
    condition: str
    output: Real
    command: Real
    settled: bool
    overshoot: Real
    limited: float


@dataclass(frozen=True, eq=False)
class JointsLoopResult:
    """machine: what ran; time_s (T,), reference (T, Y); skipped: why nothing ran."""

    machine: Literal["simulated", "identified"] = "identified"
    time_s: Real | None = None
    reference: Real | None = None
    runs: tuple[JointsRun, ...] = ()
    skipped: str | None = None

    def settled_points(self) -> tuple[int, int]:
        """Operating points where every run settles, and their number."""
        points = dict.fromkeys(run.point for run in self.runs)
        good = [all(run.settled for run in self.runs if run.point == point) for point in points]
        return sum(good), len(good)


class JointsResults(AnyResults):
    """Results of a run for several joints."""

    identify = StageResult(PointModels)
    certify = StageResult(JointsCertificate)
    closed_loop = StageResult(JointsLoopResult)

    @property
    def certified(self) -> bool:
        return self.certify.certified

    @property
    def settles(self) -> bool:
        settled, points = self.closed_loop.settled_points()
        return settled == points

    def certified_for(self, config: JointsConfig) -> str:
        return f"{len(self.identify.points)} operating points"
