"""Controllers at their limits, as exported C code: random laws in four state spaces, compiled and run.

Each seed draws a PI (or two integrators, or none) with lead, notches and a roll-off of order 0 to 4, a period
of 0.5 to 10 ms, a plant that it controls with a modulus margin of 0.3 or more, and writes it as second-order
sections, in companion form, as `scipy.signal.tf2ss` does, or in random states. `flexlink.Controller` takes it
with a limit and `flexlink.c_source` writes the code; gcc compiles it. Then

- constant errors that ask for more than the limit: the command has to end at the limit and stay there (a law
  without integrator: at what it asks, clipped), without changing its sign more often than the same law does
  where its command is only clipped;
- reference steps that bring the command to its limit: the loop has to end where the linear loop ends, or,
  where the plant cannot follow, with the command at its limit.

The judge shares no code with the product: filters of scipy, and a loop of its own around the compiled code.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.signal

import flexlink
from benchmarks.harness import Print, main

Array = npt.NDArray[np.float64]
StateSpace = tuple[Array, Array, Array, Array]

FORMS = ("sections", "companion", "tf2ss", "random states")
PLANTS = ("motor", "second order", "integrating", "flexible")

# What may be left of the way at the end, of limit and step.
_LEFT = 0.02
# Largest closed-loop pole radius of a loop that is drawn: settles within 350 000 samples.
_SLOWEST = 1 - 2e-5
# Least distance of the loop from -1.
_MARGIN = 0.3
# Largest change of the response by writing the law in its form: beyond, it is another law.
_ROUNDED = 0.01
# Draws until a loop is good; a seed that needs more is left out and counted.
_TRIES = 200

# The loop around the code under test: state of the plant, output, command; `reference` less the output is the
# error. Written here, so that the arithmetic of the loop is the judge's own.
_LOOP = r"""
void run(int samples, double reference, int n, const double *a, const double *b, const double *c,
         double *output, double *command)
{
    static law_state law;
    double x[64] = {0}, next[64];
    law_reset(&law);
    for (int k = 0; k < samples; k++) {
        double y = 0;
        for (int i = 0; i < n; i++) y += c[i] * x[i];
        double u = law_step(&law, reference - y);
        for (int i = 0; i < n; i++) {
            next[i] = b[i] * u;
            for (int j = 0; j < n; j++) next[i] += a[i * n + j] * x[j];
        }
        for (int i = 0; i < n; i++) x[i] = next[i];
        output[k] = y;
        command[k] = u;
    }
}
"""


@dataclass(frozen=True)
class Draw:
    """A law as sections (numerator, denominator) in z, its arrays in some form, and its plant (with the delay
    of one sample); poles of the linear loop."""

    form: str
    plant_kind: str
    integrators: int
    rolloff: int
    dt_s: float
    sections: tuple[tuple[Array, Array], ...]
    law: StateSpace
    plant: StateSpace
    radius: float


def run(out: Print, *, seeds: int = 300, first_seed: int = 0, rate_limited: float = 0.2) -> None:
    """Wrong ends of laws drawn from `first_seed` on; rate_limited: share of them with a rate limit, too."""
    wrong = Counter[str]()
    drawn = Counter[str]()
    runs = 0
    refused: list[str] = []
    faults: list[str] = []
    for seed in range(first_seed, first_seed + seeds):
        rng = np.random.default_rng(seed)
        draw = drawn_law(rng)
        if draw is None:
            drawn["no loop drawn"] += 1
            continue
        rate = bool(rng.random() < rate_limited)
        try:
            errors, count = judged(draw, rate)
        except ValueError as refusal:
            refused.append(f"seed {seed} ({draw.form}): {refusal}")
            continue
        runs += count
        for group in groups(draw, rate):
            drawn[group] += 1
            wrong[group] += bool(errors)
        if errors:
            kind = f"{draw.form}, {draw.plant_kind}, {draw.integrators} integrators, roll-off {draw.rolloff}"
            faults.append(f"seed {seed} ({kind}{', rate limit' if rate else ''}): {'; '.join(errors)}")
    total = drawn["all"]
    out(f"wrong: {wrong['all']} of {total} laws, in {runs} runs of compiled code; refused: {len(refused)}; "
        f"no stable loop drawn: {drawn['no loop drawn']}")  # fmt: skip
    for group in sorted(set(drawn) - {"all", "no loop drawn"}):
        out(f"  {group:<24} {wrong[group]:>3} of {drawn[group]}")
    for line in (*faults, *refused):
        out(line)


def groups(draw: Draw, rate: bool) -> tuple[str, ...]:
    """What a law is counted under."""
    limit = "limit and rate limit" if rate else "limit"
    numbers = (f"integrators {draw.integrators}", f"roll-off {draw.rolloff}")
    return ("all", draw.form, draw.plant_kind, *numbers, limit)


def drawn_law(rng: np.random.Generator) -> Draw | None:
    """A law and a plant that it controls; None where none of `_TRIES` draws is good."""
    form = FORMS[int(rng.integers(len(FORMS)))]
    for _ in range(_TRIES):
        dt_s = float(10 ** rng.uniform(np.log10(0.5e-3), -2))
        crossover = float(rng.uniform(0.02, 0.3) * 10 ** -rng.uniform(0, 1) / dt_s)
        integrators = int(rng.choice([0, 1, 2], p=[0.15, 0.75, 0.1]))
        rolloff = int(rng.integers(0, 5))
        plant_kind = PLANTS[int(rng.integers(len(PLANTS)))]
        continuous = _continuous_law(rng, crossover, integrators, rolloff)
        sections = [scipy.signal.bilinear(top, bottom, 1 / dt_s) for top, bottom in continuous]
        # With one sample of delay, as a real-time loop has it.
        plant = _delayed(_sampled(*_continuous_plant(rng, crossover, plant_kind), dt_s))

        # Gain: crossover where it was asked, and a margin.
        omega = np.geomspace(1e-3 * crossover, 0.99 * np.pi / dt_s, 1500)
        z = np.exp(1j * omega * dt_s)
        loop = _sections_response(sections, z) * _response(plant, z)
        gain = float(10 ** rng.uniform(-0.2, 0.1) / np.abs(np.interp(crossover, omega, np.abs(loop))))
        if np.min(np.abs(1 + gain * loop)) < _MARGIN:
            continue
        sections[0] = (gain * sections[0][0], sections[0][1])
        in_a_row = _in_a_row(sections)
        radius = float(np.max(np.abs(np.linalg.eigvals(_closed(in_a_row, plant)))))
        if not radius < _SLOWEST:
            continue

        # The law as arrays: another law by rounding is nobody's.
        law = _written(form, sections, in_a_row, rng)
        exact = _sections_response(sections, z)
        if np.max(np.abs(_response(law, z) / exact - 1)) > _ROUNDED:
            continue
        each = tuple((np.asarray(top), np.asarray(bottom)) for top, bottom in sections)
        return Draw(form, plant_kind, integrators, rolloff, dt_s, each, law, plant, radius)
    return None


def _continuous_law(
    rng: np.random.Generator, crossover: float, integrators: int, rolloff: int
) -> list[tuple[list[float], list[float]]]:
    """Sections in s around a crossover frequency [rad/s], the gain one in the middle."""
    corner = crossover * 10 ** -rng.uniform(0.4, 1.5)
    sections = [([1 / corner, 1.0], [1 / corner, 0.0]) for _ in range(integrators)]
    if rng.random() < 0.4:
        ratio = rng.uniform(1.3, 4)
        sections.append(([ratio / crossover, 1.0], [1 / (ratio * crossover), 1.0]))
    above = crossover * rng.uniform(3, 8)
    sections += [([1.0], [1 / above**2, 1.4 / above, 1.0])] * (rolloff // 2)
    sections += [([1.0], [1 / above, 1.0])] * (rolloff % 2)
    for _ in range(rng.integers(0, 3)):
        notch = crossover * 10 ** rng.uniform(0.2, 1)
        light = 2 * rng.uniform(0.02, 0.3) / notch
        heavy = 2 * rng.uniform(0.5, 1) / notch
        sections.append(([1 / notch**2, light, 1.0], [1 / notch**2, heavy, 1.0]))
    return sections or [([1.0], [1.0])]


def _continuous_plant(
    rng: np.random.Generator, crossover: float, kind: str
) -> tuple[list[float], list[float]]:
    """Numerator and denominator in s."""
    slow = [1 / (crossover * 10 ** -rng.uniform(0, 1)), 1.0]
    fast = [1 / (crossover * 10 ** rng.uniform(0, 0.7)), 1.0]
    if kind == "motor":
        return [1.0], slow
    if kind == "second order":
        return [1.0], np.polymul(slow, fast).tolist()
    if kind == "integrating":
        return [crossover], np.polymul([1.0, 0.0], fast).tolist()
    mode = crossover * 10 ** rng.uniform(0.5, 1)
    damping = 10 ** rng.uniform(-2.5, -1)
    pair = [1 / (1.3 * mode) ** 2, 2 * damping / (1.3 * mode), 1.0]
    return [1 / mode**2, 0.02 / mode, 1.0], np.polymul(slow, pair).tolist()


def _sampled(top: list[float], bottom: list[float], dt_s: float) -> StateSpace:
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(top, bottom), dt_s, "zoh")
    return a, b, c, d


def _delayed(plant: StateSpace) -> StateSpace:
    """The plant after one sample of delay at its input."""
    a, b, c, d = plant
    n = a.shape[0]
    late = np.block([[a, b], [np.zeros((1, n + 1))]])
    enters = np.vstack([np.zeros((n, 1)), [[1.0]]])
    return late, enters, np.hstack([c, d]), np.zeros((1, 1))


def _in_a_row(sections: list[tuple[Array, Array]]) -> StateSpace:
    """Series of the sections' companion forms."""
    a = np.zeros((0, 0))
    b = np.zeros((0, 1))
    c = np.zeros((1, 0))
    d = np.ones((1, 1))
    for top, bottom in sections:
        section = scipy.signal.tf2ss(top, bottom)
        own_a, own_b, own_c, own_d = section if np.size(bottom) > 1 else _constant(float(top[0] / bottom[0]))
        upper = np.hstack([a, np.zeros((a.shape[0], own_a.shape[0]))])
        a = np.vstack([upper, np.hstack([own_b @ c, own_a])])
        b = np.vstack([b, own_b @ d])
        c = np.hstack([own_d @ c, own_c])
        d = own_d @ d
    return a, b, c, d


def _constant(gain: float) -> StateSpace:
    return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[gain]])


def _written(
    form: str, sections: list[tuple[Array, Array]], in_a_row: StateSpace, rng: np.random.Generator
) -> StateSpace:
    """The law in a state space of this form."""
    n = in_a_row[0].shape[0]
    if form == "sections" or n == 0:
        return in_a_row
    if form == "random states":
        turn = rng.standard_normal((n, n))
        a, b, c, d = in_a_row
        back = np.linalg.inv(turn)
        return turn @ a @ back, turn @ b, c @ back, d
    top = np.ones(1)
    bottom = np.ones(1)
    for above, below in sections:
        top = np.polymul(top, above)
        bottom = np.polymul(bottom, below)
    if form == "tf2ss":
        return scipy.signal.tf2ss(top, bottom)
    # Observer form: the coefficients in a column, the delays above the diagonal.
    top = np.concatenate([np.zeros(bottom.size - top.size), top]) / bottom[0]
    bottom = bottom / bottom[0]
    a = np.eye(n, k=1)
    a[:, 0] -= bottom[1:]
    return a, (top[1:] - bottom[1:] * top[0])[:, None], np.eye(1, n), np.array([[top[0]]])


def _sections_response(sections: list[tuple[Array, Array]], z: Array) -> Array:
    value = np.ones(z.size, dtype=complex)
    for top, bottom in sections:
        value = value * np.polyval(top, z) / np.polyval(bottom, z)
    return value


def _response(system: StateSpace, z: Array) -> Array:
    a, b, c, d = system
    enters = np.broadcast_to(b, (z.size, *b.shape))
    return (c @ np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, enters) + d)[:, 0, 0]


def _closed(law: StateSpace, plant: StateSpace) -> Array:
    a, b, c, _ = plant
    own_a, own_b, own_c, own_d = law
    return np.block([[a - b @ own_d @ c, b @ own_c], [-own_b @ c, own_a]])


class Compiled:
    """The exported code of a law in a loop, as a shared library in a folder that is gone afterwards."""

    def __init__(self, law: flexlink.Controller, folder: Path) -> None:
        (folder / "law.c").write_text(flexlink.c_source(law, prefix="law") + _LOOP)
        library = folder / "law.so"
        subprocess.run(
            ["gcc", "-std=c99", "-O2", "-shared", "-fPIC", str(folder / "law.c"), "-o", str(library), "-lm"],
            check=True,
        )
        self._run = ctypes.CDLL(str(library)).run

    def loop(self, samples: int, reference: float, plant: StateSpace | None) -> tuple[Array, Array]:
        """Outputs and commands (T,) from rest; plant None: the error is the reference."""
        nothing = (np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
        a, b, c = (np.ascontiguousarray(each, dtype=float) for each in (plant or nothing)[:3])
        output = np.empty(samples)
        command = np.empty(samples)
        pointers = [each.ctypes.data_as(ctypes.c_void_p) for each in (a, b, c, output, command)]
        self._run(ctypes.c_int(samples), ctypes.c_double(reference), ctypes.c_int(a.shape[0]), *pointers)
        return output, command


def judged(draw: Draw, rate: bool) -> tuple[list[str], int]:
    """What is wrong with a law at its limits, in words, and how many runs were judged.

    Raises ValueError where the product refuses it.
    """
    settling = int(np.ceil(np.log(1e-3) / np.log(draw.radius))) + 400
    output, command = _linear(draw, settling)
    peak = float(np.max(np.abs(command)))
    # A limit of one: errors and references are scaled instead.
    rise = 1 + int(np.argmax(np.abs(output) > 0.9 * np.abs(output[-1])))
    settings = {"rate_limit": 1.0 / (rise * draw.dt_s)} if rate else {}
    law = flexlink.Controller(*draw.law, draw.dt_s, input_limit=1.0, **settings)
    with tempfile.TemporaryDirectory() as folder:
        code = Compiled(law, Path(folder))
        constant_errors, constant_runs = _constant_errors(draw, code, settling, rise if rate else 0)
        step_errors, loop_runs = _steps(draw, code, settling, output, command, peak)
    return constant_errors + step_errors, constant_runs + loop_runs


def _linear(draw: Draw, samples: int) -> tuple[Array, Array]:
    """Output and command of the linear loop after a step of one, by the loop's own matrices."""
    _, b, c, _ = draw.plant
    own_a, own_b, own_c, own_d = _in_a_row(list(draw.sections))
    closed = _closed((own_a, own_b, own_c, own_d), draw.plant)
    enters = np.vstack([b @ own_d, own_b])
    seen = np.vstack([
        np.hstack([c, np.zeros((1, own_a.shape[0]))]),
        np.hstack([-own_d @ c, own_c]),
    ])  # fmt: skip
    x = np.zeros(closed.shape[0])
    outputs = np.empty((samples, 2))
    direct = np.array([0.0, own_d[0, 0]])
    for k in range(samples):
        outputs[k] = seen @ x + direct
        x = closed @ x + enters[:, 0]
    return outputs[:, 0], outputs[:, 1]


def _constant_errors(draw: Draw, code: Compiled, settling: int, ramp: int) -> tuple[list[str], int]:
    """Constant errors that ask for 1.5 to 150 times the limit at the end."""
    samples = min(settling + ramp, 100_000)
    asked = np.ones(samples)
    for top, bottom in draw.sections:
        asked = scipy.signal.lfilter(top, bottom, asked)
    errors = []
    factors = (1.5, 15.0, 150.0)
    for factor in factors:
        error = factor / abs(float(asked[-1]))
        clipped = np.clip(error * asked, -1, 1)
        _, command = code.loop(samples + ramp, error, None)
        end = float(np.sign(asked[-1]))
        tail = command[-max(1, samples // 10) :]
        away = float(np.max(np.abs(tail - end)))
        changes = _sign_changes(command)
        expected = _sign_changes(clipped)
        if away > _LEFT:
            errors.append(
                f"constant error {factor:g}: {away:.2g} away from the limit, {changes} sign changes"
            )
        elif changes > expected + 2:  # an overshoot may be cut off where clipping alone did not
            errors.append(f"constant error {factor:g}: {changes} sign changes, clipped {expected}")
    return errors, len(factors)


def _sign_changes(command: Array) -> int:
    has_sign = np.abs(command) > _LEFT
    signs = np.sign(command[has_sign])
    return int(np.sum(np.diff(signs) != 0))


def _steps(
    draw: Draw, code: Compiled, settling: int, output: Array, command: Array, peak: float
) -> tuple[list[str], int]:
    """Steps that bring the command to its limit, up to four times its peak, and one beyond reach."""
    integrating = draw.plant_kind == "integrating"
    at_rest = 0.0 if integrating else float(command[-1])
    largest = np.inf if integrating else 1 / abs(at_rest)
    sizes = [min(factor / peak, 0.9 * largest) for factor in (1.5, 4.0)]
    sizes = [size for size in dict.fromkeys(sizes) if size * peak > 1]
    if not integrating:
        sizes.append(1.5 * largest)
    # A plant next to its limit moves no faster than by itself.
    own_radius = float(np.max(np.abs(np.linalg.eigvals(draw.plant[0]))))
    slow = settling if integrating else max(settling, int(np.log(1e-3) / np.log(own_radius)))
    errors = []
    for size in sizes:
        share = min(size, largest)
        run_output, run_command = code.loop(min(16 * slow, 1_000_000), size, draw.plant)
        tail = slice(-max(1, run_output.size // 10), None)
        off = np.max(np.abs(run_output[tail] - share * output[-1])) / (size * np.max(np.abs(output)))
        off_command = np.max(np.abs(run_command[tail] - share * at_rest))
        if max(off, off_command) > _LEFT:
            errors.append(
                f"step {size * peak:.3g} times the limit: output {off:.2g}, command {off_command:.2g} away"
            )
    return errors, len(sizes)


if __name__ == "__main__":
    main(run)
