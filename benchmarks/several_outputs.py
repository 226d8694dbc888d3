"""Two motors, two sensors: shared poles beside channel by channel and subspace methods; balls of responses.

Plants: `joints`, two joints with one flexible mode per link, weak springs in place of integrators; `links`,
the two-link arm of `validation.example_arms`, both joints free. Records of 6000 and 8000 samples, both motors
at once (binary sequences), sensor noise with correlation .3. Of every seed: rms of |Ghat - G| / |G| over 1 to
200 rad/s by channel; states; share of frequencies whose 95 % ball holds G, by band. nfoursid (N4SID) is told
the number of states, and is run where it is installed.

Then the arm of a CD player (DaISy; FLEXLINK_DATA): fit of samples 0 to 1023, free run on 1024 to 2047 with
its state fitted, fit % of both outputs, numbers of poles given.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import control
import numpy as np
import pandas as pd
from scipy.signal import dlsim
from scipy.stats import chi2

from benchmarks.harness import Print, main, timed
from ident import IdentOptions, Record
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from plant import prbs
from validation.example_arms import two_link_operating_point

BALLS = np.geomspace(1.0, 700.0, 140)
ERRORS = np.geomspace(1.0, 200.0, 200)
BANDS = 7
NAMES = ("u1", "u2"), ("y1", "y2")
CORRELATION = np.linalg.cholesky([[1.0, 0.3], [0.3, 1.0]])


def joints() -> control.StateSpace:
    """M q'' + C q' + K q = [diag(2.5, 1.5); 0] u, outputs both joint angles, 4 ms."""
    mass = np.array([[2, 0.6, 0.45, 0.25], [0.6, 0.6, 0.1, 0.3], [0.45, 0.1, 1, 0], [0.25, 0.3, 0, 1]])
    damping = np.diag([5, 2, 2 * 0.004 * 12, 2 * 0.006 * 26])
    stiffness = np.diag([0.1, 0.04, 12**2, 26**2])
    drive = np.vstack([np.diag([2.5, 1.5]), np.zeros((2, 2))])
    a = np.block(
        [[np.zeros((4, 4)), np.eye(4)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )
    b = np.vstack([np.zeros((4, 2)), np.linalg.solve(mass, drive)])
    return control.c2d(control.ss(a, b, np.eye(2, 8), 0), 0.004)


def links() -> control.StateSpace:
    """Both joint angles of the two-link arm, 2 ms."""
    return control.c2d(two_link_operating_point(2 * np.pi / 3), 0.002)[:2, :]


# plant, its integrators, samples, hold of the sequence, its amplitude in V, noise in rad
PLANTS: dict[str, tuple[Callable[[], control.StateSpace], int, int, int, float, tuple[float, float]]] = {
    "joints": (joints, 0, 6000, 2, 2.0, (2e-4, 1e-4)),
    "links": (links, 1, 8000, 1, 1.0, (2e-5, 2e-5)),
}


def record_of(name: str, seed: int) -> tuple[control.StateSpace, Record]:
    make, _, samples, hold, amplitude, noise = PLANTS[name]
    plant = make()
    rng = np.random.default_rng([seed, samples])
    u = np.column_stack([prbs(13, hold, amplitude, samples, rng) for _ in range(2)])
    y = dlsim((plant.A, plant.B, plant.C, plant.D, plant.dt), u)[1]
    y = y + (rng.normal(size=y.shape) @ CORRELATION.T) * np.array(noise)
    return plant, Record(u, y, plant.dt, name=name, input_names=NAMES[0], output_names=NAMES[1])


def response(system: Any, omega: np.ndarray) -> np.ndarray:
    """(F, Y, U)."""
    return np.moveaxis(np.atleast_3d(system(np.exp(1j * omega * system.dt))), 2, 0)


def n4sid(record: Record, order: int) -> control.StateSpace:
    from nfoursid.nfoursid import NFourSID

    frame = pd.DataFrame(np.hstack([record.input, record.output]), columns=[*NAMES[0], *NAMES[1]])
    search = NFourSID(frame, list(NAMES[1]), input_columns=list(NAMES[0]), num_block_rows=20)
    search.subspace_identification()
    system, _ = search.system_identification(rank=order)
    return control.ss(system.a, system.b, system.c, system.d, record.dt_s)


def run(out: Print, *, seeds: int = 50, first: int = 0, plants: str = "joints,links") -> None:
    for name in plants.split(","):
        _plant(out, name, range(first, first + seeds))
        out()
    if "FLEXLINK_DATA" in os.environ:
        _cd_player(out, Path(os.environ["FLEXLINK_DATA"]) / "daisy_cd_player_arm" / "cd_player_arm.csv")


def _plant(out: Print, name: str, seeds: range) -> None:
    errors: dict[str, list[np.ndarray]] = {}
    held = []
    states = []
    seconds = []
    enclosure = []
    for seed in seeds:
        plant, record = record_of(name, seed)
        truth = response(plant, ERRORS)

        def noted(method: str, found: np.ndarray, truth: np.ndarray = truth) -> None:
            share = np.sqrt(np.mean(np.abs(found / truth - 1) ** 2, axis=0))
            errors.setdefault(method, []).append(100 * share.ravel())

        options = IdentOptions(integrators=PLANTS[name][1])
        result, taken = timed(partial(identify_mimo, [record], options))
        seconds.append(taken)
        noted("shared poles", result.model.frequency_response(ERRORS))
        single_outputs = [identify_mimo([record.only(k)], options).model.outputs[0] for k in range(2)]
        noted(
            "channel by channel",
            np.stack([output.frequency_response(ERRORS) for output in single_outputs], axis=1),
        )
        states.append(len(result.model.state_space()[0]))
        balls = matrix_posterior([record], result).at(BALLS)
        held.append(balls.holds(response(plant, BALLS)))
        independent = np.sqrt(chi2.ppf(balls.level, 2 * balls.centre[0].size) / 2)
        enclosure.append(float(np.median(balls.radius / independent)))
        with suppress(ImportError):
            noted("nfoursid", response(n4sid(record, plant.nstates), ERRORS))
    out(f"{name}: {plant.nstates} states, seeds {seeds.start} to {seeds.stop - 1}")
    for method, values in errors.items():
        median = "  ".join(f"{v:7.3f}" for v in np.median(values, axis=0))
        out(f"  {method:20s} rms error %, median, by channel: {median}")
    counts = ", ".join(f"{n}: {states.count(n)}" for n in sorted(set(states)))
    out(f"  states: {counts}; CPU {np.median(seconds):.1f} s, at most {max(seconds):.1f} s")
    bands = "  ".join(f"{100 * part.mean():.1f}" for part in np.array_split(np.array(held), BANDS, axis=1))
    out(
        f"  ball holds G, %, by band: {bands}; all {100 * np.mean(held):.1f}; "
        f"radius {np.median(enclosure):.2f} times that of independent channels"
    )


def _cd_player(out: Print, path: Path) -> None:
    columns = pd.read_csv(path).to_numpy(float)[:, 1:]
    u = columns[:, :2]
    y = columns[:, 2:]
    record = Record(u[:1024], y[:1024], 1.0, name="CD player", input_names=NAMES[0], output_names=NAMES[1])
    out("CD player arm, fit % on the second half, y1 y2 (published common-pole output error in brackets)")
    published = {4: "65.2 78.1", 6: "70.9 77.9", 8: "71.4 83.2", 10: "72.6 84.0"}
    for order, peer in published.items():
        parts = []
        for free in (True, False):
            options = IdentOptions(
                n_real=2, n_pairs=(order - 2) // 2, feedthrough=True,
                estimate_offset=False, estimate_initial_state=True,
            )  # fmt: skip
            model = identify_mimo([record], options, free_shapes=free).model
            fits = "  ".join(f"{v:.1f}" for v in _free_run_fit(model.state_space(), u[1024:], y[1024:]))
            word = "free residues" if free else "one shape each where the records let them"
            parts.append(f"{word}: {fits} with {len(model.state_space()[0])} states")
        out(f"  {order} poles: {'; '.join(parts)} ({peer})")


def _free_run_fit(system: Any, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit in % of the outputs from the best initial state, (2,)."""
    a, b, c, d = system
    x = np.zeros(len(a))
    power = np.eye(len(a))
    driven = np.empty_like(y)
    seen = np.empty((len(y), y.shape[1], len(a)))
    for k in range(len(y)):
        driven[k] = c @ x + d @ u[k]
        seen[k] = c @ power
        x = a @ x + b @ u[k]
        power = a @ power
    start = np.linalg.lstsq(seen.reshape(-1, len(a)), (y - driven).ravel(), rcond=None)[0]
    residual = np.linalg.norm(y - driven - seen @ start, axis=0)
    return 100 * (1 - residual / np.linalg.norm(y - y.mean(axis=0), axis=0))


if __name__ == "__main__":
    main(run)
