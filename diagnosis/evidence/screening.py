"""Where a fit of a candidate starts: grids, with the nominal parameters following linearly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import czt

from diagnosis.fit.fit import Fit
from diagnosis.fit.nominal import prior_cost, prior_curvature, prior_slope
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Ripple and disturbance frequencies are looked at this densely: periods over the record for the one, a tenth
# of the inverse of the largest angle for the other.
_CYCLES = np.concatenate([np.arange(1.0, 12, 0.25), np.arange(12, 80.5, 1.0)])
# Frequencies of long records, of which there are as many as samples: how many of them are fitted, the lowest
# in any case.
MOST_LINES, BEST_LINES, SLOW_LINES = 6000, 1000, 200


@dataclass(frozen=True, eq=False)
class Start:
    """A point to descend from: cost with the deviations moved along their linearisation, x (A,), d (P,).

    size_ratio: largest RMS, over experiments and outputs, by which the effect changes the model, over noise.
    change: what the effect adds to the residuals (N,), or nothing where it is found anew beside others.
    """

    cost: float
    coordinates: Real
    deviations: Real
    size_ratio: float
    change: npt.NDArray[np.float32]


class Screening:
    """Grid points of candidates around a fit whose nominal Jacobian is known."""

    def __init__(self, model: ResidualModel, around: Fit) -> None:
        self.model = model
        self.around = around
        P = around.deviations.size
        self._Jn = around.jacobian[:, :P]
        self._A = self._Jn.T @ self._Jn + np.diag(prior_curvature(around.deviations))
        self._parts = np.cumsum([e.output.size for e in model.case.estimation])[:-1]

    def starts(self, candidate: Candidate) -> list[Start]:
        """Every start of the candidate, best first."""
        found = self._harmonic(candidate) if candidate.kind.harmonic else None
        if found is None:
            found = [
                start for x in candidate.starts if (start := self._at(candidate, np.array(x))) is not None
            ]
        return sorted(found, key=lambda start: start.cost)

    def beside(self, parent: Fit, starts: list[Start]) -> list[Start]:
        """The same starts judged beside the effects of `parent`, changes simply added; best first.

        No simulation: a second effect large enough for superposition to fail shows all the same. The nominal
        parameters and the sizes of the parent follow along its Jacobian.
        """
        around = _Around(parent)
        found = [around.start(start, parent.residuals + start.change) for start in starts]
        return sorted(found, key=lambda start: start.cost)

    def simulated_beside(self, parent: Fit, candidate: Candidate, starts: list[Start]) -> list[Start]:
        """As `beside`, from simulations of both together: for one that acts through the other."""
        around = _Around(parent)
        found = []
        for start in starts:
            effects = (*parent.effects, candidate.effect_at(start.coordinates))
            e = self.model.of(parent.deviations, effects)
            if np.all(np.isfinite(e)):
                found.append(around.start(start, e))
        return sorted(found, key=lambda start: start.cost)

    def zoomed(self, candidate: Candidate, starts: list[Start]) -> list[Start]:
        """Two finer grids around the best points of a non-smooth cost, one size coordinate; best first."""
        found = list(starts)
        for points, reach in ((24, 0.25), (16, 0.02)):
            found.sort(key=lambda start: start.cost)
            centre = found[0].coordinates
            for shift in np.linspace(-reach, reach, points):
                x = np.clip(centre + np.concatenate([[shift], np.zeros(centre.size - 1)]), *candidate.box)
                start = self._at(candidate, x)
                if start is not None:
                    found.append(start)
        return sorted(found, key=lambda start: start.cost)

    def _at(self, candidate: Candidate, x: Real) -> Start | None:
        effects = (*self.around.effects, candidate.effect_at(x))
        e = self.model.of(self.around.deviations, effects)
        if not np.all(np.isfinite(e)):
            return None
        cost, step = self.follow(e)
        change = e - self.around.residuals
        return Start(cost, x, self.around.deviations + step, self._size(change), change.astype(np.float32))

    def follow(self, e: Real) -> tuple[float, Real]:
        """Least cost and step of the deviations on the linearisation."""
        d = self.around.deviations
        gradient = self._Jn.T @ e + prior_slope(d)
        step = -np.linalg.solve(self._A, gradient)
        # Never trust the linearisation beyond a tolerance or so.
        step = np.clip(step, -1.5, 1.5)
        return float(e @ e + 2 * gradient @ step + step @ self._A @ step) + prior_cost(d), step

    def _size(self, change: Real) -> float:
        parts, outputs = np.split(change, self._parts), self.model.case.noise.size
        return float(max(np.max(np.sqrt(np.mean(p.reshape(-1, outputs) ** 2, axis=0))) for p in parts))

    def _harmonic(self, candidate: Candidate) -> list[Start] | None:
        """Amplitude and phase by linear least squares at each frequency: the torque acts on a linear arm;
        None of a machine without a hub."""
        model, around = self.model, self.around
        P = around.deviations.size
        longest = max(len(e.input) for e in model.case.estimation)
        known = model.nominal.at(around.deviations).torque_response(longest)
        if known is None:
            return None
        response, dt = known[0] / model.case.noise, known[1]
        model.simulations += 1
        periodic = candidate.kind.harmonic == "time"
        if periodic:
            lines = np.arange(candidate.axes[1].low, min(60.0, 0.45 / dt), 0.4 / (longest * dt))
            if len(lines) > MOST_LINES:
                lines = self._loudest(lines, response, dt)
        else:
            lines = _CYCLES[np.greater_equal(_CYCLES, candidate.axes[1].low)]
        # Circular convolution over twice the longest record: no response reaches around.
        size = next_fast_len(2 * longest, real=True)
        transfer = np.fft.rfft(response, size, axis=0)

        def answers(angle: Real) -> Real:
            """(2, T, outputs) to a torque that follows the sine and the cosine of an angle (T,)."""
            torque = np.stack([np.sin(angle), np.cos(angle)])
            moved = np.fft.irfft(np.fft.rfft(torque, size)[:, :, None] * transfer, size, axis=1)
            return np.asarray(moved[:, : angle.size])

        time = (np.arange(longest, dtype=np.float64) + 0.5) * dt
        found = []
        for line in map(float, lines):
            if periodic:
                # The same in every record, up to its end.
                all_along = answers(2 * np.pi * line * time)
                moved = [all_along[:, : len(e.input)] for e in model.case.estimation]
            else:
                moved = [answers(line * e.output[:, 0]) for e in model.case.estimation]
            parts = [part.reshape(2, -1) for part in moved]
            columns = -np.concatenate(parts, axis=1)
            H = np.empty((P + 2, P + 2))
            H[:P, :P] = self._A
            H[P:, :P] = columns @ self._Jn
            H[:P, P:] = H[P:, :P].T
            H[P:, P:] = columns @ columns.T
            gradient = np.concatenate([self._Jn.T @ around.residuals, columns @ around.residuals])
            gradient[:P] += prior_slope(around.deviations)
            step = -np.linalg.solve(H, gradient)
            a, b = step[P:]
            amplitude = float(np.hypot(a, b))
            cost = around.cost + float(gradient @ step)
            low, high = candidate.axes[0].low, candidate.axes[0].high
            x = np.array([np.log(np.clip(amplitude, low, high)), line, np.arctan2(b, a)])
            change = a * columns[0] + b * columns[1]
            d = around.deviations + np.clip(step[:P], -1.5, 1.5)
            found.append(Start(cost, x, d, self._size(change), np.zeros(0, np.float32)))
        return found

    def _loudest(self, lines: Real, response: Real, dt_s: float) -> Real:
        """Those of evenly spaced frequencies [Hz] at which a torque would take most from the residuals, its
        response (T, outputs to a pulse) taken to be settled, and the lowest, at which it is not."""
        T = len(response)
        size = next_fast_len(2 * T, real=True)
        transfer = np.fft.rfft(response, size, axis=0)
        correlation = np.zeros(T)
        parts = np.split(self.around.residuals, self._parts)
        for part in parts:
            e = np.fft.rfft(part.reshape(-1, response.shape[1]), size, axis=0)
            correlation += np.fft.irfft(np.sum(e * transfer.conj(), axis=1), size)[:T]
        turn = 2j * np.pi * dt_s
        found = np.abs(
            czt(correlation, len(lines), np.exp(-turn * (lines[1] - lines[0])), np.exp(turn * lines[0]))
        )
        power = np.interp(lines, np.fft.rfftfreq(size, dt_s), np.sum(np.abs(transfer) ** 2, axis=1))
        gain = found**2 / power
        gain[:SLOW_LINES] = np.inf
        return lines[np.sort(np.argsort(gain)[-BEST_LINES:])]


class _Around:
    """Linearisation of everything a fit holds, in which it follows a further effect."""

    def __init__(self, parent: Fit) -> None:
        self.parent = parent
        A = parent.hessian
        scale = np.sqrt(np.maximum(np.diag(A), 1e-12))
        self._factor = cho_factor(A + 1e-8 * np.diag(scale**2))

    def start(self, start: Start, e: Real) -> Start:
        """The start with cost and deviations that go with the residuals e (N,) before anything follows."""
        parent = self.parent
        P = parent.deviations.size
        gradient = parent.jacobian.T @ e
        gradient[:P] += prior_slope(parent.deviations)
        step = -cho_solve(self._factor, gradient)
        cost = float(e @ e + gradient @ step) + prior_cost(parent.deviations)
        return replace(start, cost=cost, deviations=parent.deviations + np.clip(step[:P], -1.5, 1.5))


def smallest_size(candidate: Candidate, starts: list[Start], ratio: float) -> float | None:
    """Coordinate of the size at which the effect changes the model by `ratio` noise deviations.

    From the grid: interpolated between points in log-log, extrapolated in proportion; over several points of
    equal size the largest change counts. None if the grid never changes anything.
    """
    sizes: dict[float, float] = {}
    for start in starts:
        key = float(start.coordinates[0])
        sizes[key] = max(sizes.get(key, 0.0), start.size_ratio)
    x = np.array(sorted(sizes))
    change = np.array([sizes[v] for v in x])
    if not np.any(change > 0):
        return None
    change = np.log(np.maximum(change, 1e-9))
    if not candidate.grows:
        x, change = -x[::-1], change[::-1]
    change = np.maximum.accumulate(change)
    target = np.log(ratio)
    if target <= change[0]:
        found = x[0] + (target - change[0])
    elif target >= change[-1]:
        found = x[-1] + (target - change[-1])
    else:
        i = int(np.searchsorted(change, target))
        share = (target - change[i - 1]) / (change[i] - change[i - 1])
        found = x[i - 1] + share * (x[i] - x[i - 1])
    return float(found if candidate.grows else -found)
