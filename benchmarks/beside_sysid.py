"""Five cases of `benchmarks.mujoco_cases` in `mujoco.sysid` (part of the package mujoco) and in flexlink.

mujoco.sysid fits every value that flexlink lists for the model, ranges as usual there (a tenth to ten times
a stated value; of an effect flexlink's range), to a free run of the estimation log from its first sample.
Which of them is the cause it leaves to its user: "moved" are values that end more than three tolerances from
what is stated, effects that end at more than the smallest size that flexlink looks for. Needs the packages
tabulate, plotly and narwhals beside mujoco.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.harness import Print, main, timed
from benchmarks.mujoco_cases import DT_S, NOISE_RAD, case_of
from diagnosis import diagnose

# Motors of one joint: dry friction, stiffness, gain, a payload, nothing.
CASES, ITERATIONS = (0, 7, 13, 24, 36), 40


def fitted(case: Any) -> tuple[dict[str, float], dict[str, float]]:
    """name -> value of everything that mujoco.sysid has moved, and values as stated."""
    from mujoco import sysid

    arm = case.plant.simulation.arm
    quantities = arm.quantities(case.experiments)
    log = case.experiments[0]
    model, n = arm.nominal, len(arm.outputs)
    steps = round(DT_S / model.opt.timestep)
    time_s = model.opt.timestep * np.arange(steps * len(log.output))
    control = sysid.TimeSeries(time_s, np.repeat(log.input[:, :n], steps, axis=0))
    speed = np.polyfit(DT_S * np.arange(7), log.output[:7], 2)[1]
    start = sysid.create_initial_state(model, log.output[0], speed, np.zeros(0))
    mapping = {name: (sysid.SignalType.MjSensor, np.array([k])) for k, name in enumerate(arm.outputs)}
    measured = sysid.TimeSeries(DT_S * np.arange(1, len(log.output)), log.output[1:], mapping)
    parameters = sysid.ParameterDict()
    listed = {effect.name: effect.parameters[0] for effect in case.plant.effects if not effect.signed}
    for name, one in quantities.items():
        stated = case.plant.tolerances.get(name)
        if name.endswith(("delay", "lag", "backlash", "sensor_gain", "payload", "inertia", "forcerange")) or (
            stated is None and name not in listed
        ):
            continue
        low, high = (0.1 * one.value, 10 * one.value) if stated else (0.0, listed[name].high)
        first = one.value if stated else listed[name].low

        def put(spec: Any, parameter: Any, one: Any = one) -> None:
            if one.name.endswith(".gain"):  # a factor, and the model is edited again and again
                spec.actuator(one.name.removesuffix(".gain")).gainprm = np.eye(10)[0]
            one.put(spec, float(parameter.value[0]))

        parameters.add(sysid.Parameter(name, first, low, high, modifier=put))
    sequence = sysid.ModelSequences("case", arm.spec, "log", start, control, measured)
    best, _ = sysid.optimize(
        initial_params=parameters,
        residual_fn=sysid.build_residual_fn(models_sequences=[sequence]),
        optimizer="mujoco",
        max_iters=ITERATIONS,
        verbose=False,
    )
    values = {name: float(best[name].value[0]) for name in best.keys()}  # noqa: SIM118
    off = {n: abs(np.log(v / quantities[n].value)) for n, v in values.items() if n in case.plant.tolerances}
    moved = [n for n in off if off[n] > 3 * case.plant.tolerances[n]]
    moved += [n for n in values if n in listed and values[n] > 2 * listed[n].low]
    return {name: values[name] for name in moved}, {name: quantities[name].value for name in moved}


def run(out: Print, *, seed: int = 51) -> None:
    for number in CASES:
        truth, case = case_of(number, seed)
        (moved, stated), cpu_s = timed(partial(fitted, case))
        found, own_s = timed(partial(diagnose, case))
        out(f"{truth.name} {truth.value:.4g}; noise {NOISE_RAD:g} rad, {truth.integrator}, {truth.drive}")
        told = ", ".join(f"{name} {stated[name]:.4g} to {value:.4g}" for name, value in moved.items())
        out(f"  mujoco.sysid moved ({cpu_s:.0f} s): {told or 'nothing'}")
        sizes = ", ".join(f"{one.id} {next(iter(one.values.values())):.4g}" for one in found.repair)
        named = " and ".join(found.combination) or found.verdict
        out(f"  flexlink ({own_s:.0f} s): {named}, {found.probability:.3f}; repaired by {sizes or 'nothing'}")


if __name__ == "__main__":
    main(run)
