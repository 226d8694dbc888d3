"""DaISy robot arm (96-009): fitted on the first half, run freely on the second, and honest splits beside it.

Fit: 100 (1 - |y - yhat| / |y - mean y|) of a free run, no output fed back. "own state": second half alone,
its initial state (one number per pole, no offset) estimated from it. "carried": the initial state of the
first half is estimated there and the run goes on through the second, where it is judged. "through": from rest
at the first sample through both halves, judged on the second, when the transient has died. "whole": the same
judged on all 1024 samples, from a rest the arm was not in. "periodic": input repeated until the response is
periodic.

The second half is the first with its sign turned (odd harmonics only): a model that fits one half fits the
other, and the split tests little. Honest splits: (a) the first half holds one sweep down and one up; fit one,
run freely on the other, own initial state; (b) every second excited line of the whole period for the fit, the
others for the judgement, so that the model has to know the response where it was not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from benchmarks.harness import Print, data_folder, main
from ident import GobfModel, IdentOptions, Record, identify
from ident.basis.functions import free_response
from ident.checks.validation import fit_on_fresh_data
from ident.frequency_fit import identify_frf
from ident.uncertainty import FrequencyUncertainty
from ident.uncertainty.autoregression import fit_autoregression
from validation.comparators.comparators import PolynomialModel, armax, arx, oe
from validation.paper.methods import poles_of

HALF = 512
ORDERS = (4, 6, 8, 10)
REACH = {4: 96.4, 6: 96.9, 8: 97.2, 10: 97.4}
THROUGH = 94.0

Model = GobfModel | PolynomialModel


def percent(y: np.ndarray, error: np.ndarray) -> float:
    """100 (1 - |error| / |y - mean y|)."""
    return 100 * (1 - float(np.linalg.norm(error) / np.linalg.norm(y - y.mean())))


def free_columns(model: Model, n_samples: int) -> np.ndarray:
    """Every output the poles can give without input, (T, n)."""
    if isinstance(model, GobfModel):
        return free_response(model.poles, n_samples)
    denominator = np.convolve(model.a, model.f)
    impulses = np.eye(n_samples, denominator.size - 1)
    return lfilter([1.0], denominator, impulses, axis=0)


def largest_pole(model: Model) -> float:
    """Modulus of the slowest pole; 1 or more is unstable."""
    return float(np.abs(poles_of(model)).max())


# Fits in per cent, see the module text.
COLUMNS = ("first", "own state", "carried", "through", "whole", "periodic")
Score = dict[str, float]


def own_state_percent(model: Model, u: np.ndarray, y: np.ndarray) -> float:
    """Fit of a free run whose initial state is estimated from the run itself."""
    columns, rest = free_columns(model, y.size), y - model.simulate(u)
    return percent(y, rest - columns @ np.linalg.lstsq(columns, rest, rcond=1e-10)[0])


def score(model: Model, record: Record) -> Score:
    """All runs of one model, by `COLUMNS`; nan where an unstable one has no meaning."""
    if not largest_pole(model) < 1:
        return dict.fromkeys(COLUMNS, np.nan)
    u, y = record.input[:, 0], record.output[:, 0]
    error = y - model.simulate(u)
    free = free_columns(model, y.size)
    start = np.linalg.lstsq(free[:HALF], error[:HALF], rcond=1e-10)[0]
    periods = 12
    steady = y - model.simulate(np.tile(u, periods))[-y.size :]
    fits = (
        own_state_percent(model, u[:HALF], y[:HALF]),
        own_state_percent(model, u[HALF:], y[HALF:]),
        percent(y[HALF:], (error - free @ start)[HALF:]),
        percent(y[HALF:], error[HALF:]),
        percent(y, error),
        percent(y, steady),
    )
    return dict(zip(COLUMNS, fits, strict=True))


def gobf(record: Record, order: int) -> GobfModel:
    """Pairs only and a direct term: the structure of an acceleration."""
    return identify([record], structure(order)).model


def structure(order: int) -> IdentOptions:
    """Options of every fit in the time domain here; records start in mid-sweep, hence the initial state.

    Eight starts: with order 10 three miss the best minimum, and time is no matter here.
    """
    return IdentOptions(n_real=0, n_pairs=order // 2, feedthrough=True, estimate_initial_state=True, starts=8)


def whitened(record: Record, order: int) -> GobfModel:
    """The same behind the noise model of design 4.5: AR(<= 8) of the residual by BIC, two rounds."""
    model = gobf(record, order)
    for _ in range(2):
        residual = fit_on_fresh_data(model, record, estimate_offset=False).residual
        a = fit_autoregression([residual], 8)
        u, y = (lfilter(a, [1.0], signal, axis=0)[a.size - 1 :] for signal in (record.input, record.output))
        model = identify([replace(record, input=u, output=y)], structure(order)).model
    return model


PEERS: dict[str, Callable[[Record, int], Model]] = {
    "ARX n, n + 1": lambda record, n: arx(record, n, n + 1, delay_samples=0),
    "OE n + 1, n": lambda record, n: oe(record, n + 1, n, delay_samples=0),
    "ARMAX n, n + 1, n": lambda record, n: armax(record, n, n + 1, n, delay_samples=0),
    "GOBF behind an AR noise model": whitened,
}


def numbers(item: Score, model: Model) -> str:
    """One line of the tables."""
    cells = "".join(f"{'unstable' if np.isnan(v) else f'{v:.2f}':>10}" for v in item.values())
    return f"{cells}   {largest_pole(model):.5f}"


def sweeps(record: Record, say: Print) -> None:
    """Honest split (a): sweep down and sweep up of the first half."""
    down, up = record.slice(0, 256), record.slice(256, HALF)
    say("\nHonest split (a): fitted to the sweep down (samples 0-255), run on the sweep up (256-511); back")
    say(f"{'':<32}" + "".join(f"{f'order {n}':>22}" for n in ORDERS))
    methods: dict[str, Callable[[Record, int], Model]] = {"GOBF": gobf} | PEERS
    for name, method in methods.items():
        cells = []
        for order in ORDERS:
            values = []
            for part, fresh in ((down, up), (up, down)):
                model = method(part, order)
                stable = largest_pole(model) < 1
                found = own_state_percent(model, fresh.input[:, 0], fresh.output[:, 0]) if stable else np.nan
                values.append(f"{found:.1f}" if stable else "unstable")
            cells.append(f"{' / '.join(values):>22}")
        say(f"{name:<32}" + "".join(cells))


def lines(record: Record, say: Print) -> None:
    """Honest split (b): every second excited line."""
    u, y = (np.fft.rfft(signal[:, 0])[1:] for signal in (record.input, record.output))
    omega = 2 * np.pi * np.arange(1, u.size + 1) / record.n_samples
    odd = np.arange(u.size) % 2 == 0  # index 0 is line 1
    excited = odd & (np.abs(u) > 0.05 * np.abs(u[odd]).max()) & (omega < np.pi)
    chosen = np.flatnonzero(excited)
    used, left = chosen[::2], chosen[1::2]
    noise = float(np.mean(np.abs(y[~odd & (omega < omega[chosen[-1]])]) ** 2))
    covariance = (noise / 2 / np.abs(u[used]) ** 2)[:, None, None] * np.eye(2)
    frf = FrequencyUncertainty(omega[used], y[used] / u[used], covariance, record.dt_s)
    say(
        f"\nHonest split (b): {used.size} excited lines for the fit (identify_frf), the {left.size} between "
        f"them for the judgement;\nfitted lines {4 * omega[0]:.4f} rad/sample apart, half widths of the "
        "modes 0.0021 and 0.0037"
    )
    say(f"{'order':>6}{'fitted lines':>16}{'lines left out':>18}")
    for order in ORDERS:
        model = identify_frf(frf, IdentOptions(n_real=0, n_pairs=order // 2, feedthrough=True)).model
        fits = [
            100
            * (1 - np.linalg.norm(y[k] - model.frequency_response(omega[k]) * u[k]) / np.linalg.norm(y[k]))
            for k in (used, left)
        ]
        say(f"{order:>6}{fits[0]:>16.2f}{fits[1]:>18.2f}")


def run(say: Print) -> None:
    path = data_folder("daisy_robot_arm") / "daisy_robot_arm" / "robot_arm.csv"
    record = Record.from_file(path, ["u_reaction_torque"], ["y_acceleration"], dt_s=1.0)
    y, u = record.output[:, 0], record.input[:, 0]
    first = record.slice(0, HALF)
    say("Fit in per cent, GOBF with order / 2 pairs and a direct term, fitted to samples 0-511")
    head = "".join(f"{name:>10}" for name in COLUMNS)
    say(f"order   reach own / through{head}   largest |pole|")
    for order in ORDERS:
        model = gobf(first, order)
        item = score(model, record)
        # Both to the two decimals printed.
        met = "met " if round(item["own state"], 2) >= REACH[order] and item["through"] >= THROUGH else "FAIL"
        say(f"{order:>5}   {REACH[order]:.1f} / {THROUGH:.1f}  {met}   {numbers(item, model)}")
    mirrored = percent(y[HALF:], y[HALF:] + y[:HALF])
    say(
        f"No model at all, the first half with its sign turned: {mirrored:.2f} (input: "
        f"{percent(u[HALF:], u[HALF:] + u[:HALF]):.2f}). That much is in the split, whatever the model."
    )
    say("\nPeers in the same run, same half; OE and ARMAX take it to start from rest, ARX does not")
    say(f"{'method':<30}{'order':>6}{head}   largest |pole|")
    for name, method in PEERS.items():
        for order in (*ORDERS, 12) if name.startswith("ARX") else ORDERS:
            fitted = method(first, order)
            say(f"{name:<30}{order:>6}{numbers(score(fitted, record), fitted)}")
    say("ARX as noted with the data, free run on the second half: 73.9, 92.5, 94.9, 93.9 at 4, 6, 8, 12.")
    say("Published: no error figure (SLICOT: MOESP/N4SID of order 4 'good enough', 6 'slightly better';")
    say("ControlSystemIdentification.jl: order 4 on half the data, low coherence near the notches).")
    sweeps(record, say)
    lines(record, say)


if __name__ == "__main__":
    main(run, seeds="none: measured data")
