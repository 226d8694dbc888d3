"""Time domain against python-control's feedback of the same functions; limits, quantisation, metrics."""

from dataclasses import replace

import control
import numpy as np
import pytest

from control_design import ClosedLoopTrajectory, Controller, LinearMachine, simulate, step_metrics
from control_design.analysis.closed_loop import measure_sensitivity, simulate_joints

from .plants import hub_arm

_DT = 0.005


def _controller(delay: int = 1, **fields) -> Controller:
    law = [[0.8, 0.05], [0, 0.95]], [[1.0], [0.2]], [[0.3, 0.5]], [[1.5]]
    return Controller(*law, _DT, computational_delay_samples=delay, **fields)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_linear_loop_in_time_is_the_feedback_of_its_transfer_functions(delay):
    """Same delay convention in time and in the loop analysis: 1e-10 of signals of size one over 4 s."""
    rng = np.random.default_rng(1)
    g, controller = hub_arm(), _controller(delay)
    reference, load = rng.standard_normal(800), rng.standard_normal(800)
    shift = rng.standard_normal(800)
    trajectory = simulate(
        controller, LinearMachine(g), reference, input_disturbance=load, output_disturbance=shift
    )
    z = control.ss(0, 1, 1, 0, _DT)
    k = controller.to_control()
    for _ in range(delay):
        k = control.series(k, z)
    closed = control.feedback(control.series(k, g), 1)
    from_load = control.feedback(g, k)
    sensitivity = control.feedback(control.ss([], [], [], 1, _DT), control.series(k, g))
    expected = (
        control.forced_response(closed, inputs=reference).outputs
        + control.forced_response(from_load, inputs=load).outputs
        + control.forced_response(sensitivity, inputs=shift).outputs
    )
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(trajectory.measured, expected, rtol=0, atol=1e-10 * scale)


def test_hub_torque_reaches_the_second_input():
    g = hub_arm()
    two = control.ss(g.A, np.hstack([np.asarray(g.B), 2 * np.asarray(g.B)]), g.C, np.zeros((1, 2)), _DT)
    torque = np.sin(np.arange(200) * 0.1)
    still = Controller.proportional(0.0, _DT)
    got = simulate(still, LinearMachine(two), np.zeros(200), hub_torque_Nm=torque).measured
    np.testing.assert_allclose(got, control.forced_response(g, inputs=2 * torque).outputs, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="torque"):
        simulate(still, LinearMachine(g), np.zeros(200), hub_torque_Nm=torque)


def test_limits_and_quantisation_are_where_they_belong():
    law, steps = (
        _controller(input_limit=0.05, rate_limit=1.0),
        {"measurement_step": 1e-3, "command_step": 0.01},
    )
    trajectory = simulate(law, LinearMachine(hub_arm()), np.ones(400), **steps)
    assert np.all(np.abs(trajectory.command) <= 0.05 + 1e-12)
    steps = trajectory.command / 0.01
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    steps = trajectory.measured / 1e-3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert trajectory.limited.mean() > 0.5
    assert trajectory.command[0] == 0  # one sample of delay


class _Stepped(LinearMachine):
    """The same, sample by sample."""

    measure = LinearMachine.measure


def test_whole_loop_compiled_is_the_stepped_one():
    rng = np.random.default_rng(3)
    a, b, c = (rng.standard_normal(shape) for shape in ((4, 4), (4, 2), (2, 4)))
    two = control.ss(0.9 * a / np.max(np.abs(np.linalg.eigvals(a))), b, c, np.zeros((2, 2)), _DT)
    law = _controller(2, input_limit=0.4, rate_limit=30.0)
    signals = {f"{name}_disturbance": 0.2 * rng.standard_normal(300) for name in ("input", "output")}
    others = {"hub_torque_Nm": rng.standard_normal(300), "measurement_step": 1e-2, "command_step": 1e-2}
    runs = [
        simulate(law, kind(two), np.ones(300), measured_index=1, clip=0.3, **signals, **others)
        for kind in (LinearMachine, _Stepped)
    ]
    assert 0 < runs[0].limited.mean() < 1
    for name in ("output", "command", "limited"):
        np.testing.assert_allclose(*(getattr(run, name) for run in runs), rtol=1e-9, atol=1e-12)
    parts = [rng.standard_normal(shape) / 4 for shape in ((3, 3), (3, 2), (2, 3), (2, 2))]
    both = Controller(*parts, _DT, input_limit=(1.0, None), rate_limit=(60.0, 90.0))
    joints = [simulate_joints(both, kind(two), np.ones((300, 2))) for kind in (LinearMachine, _Stepped)]
    np.testing.assert_allclose(*joints, rtol=1e-9, atol=1e-12)


def test_bad_signals_are_refused():
    controller, machine = _controller(), LinearMachine(hub_arm())
    with pytest.raises(ValueError, match="sample 1"):
        simulate(controller, machine, [0.0, np.nan])
    with pytest.raises(ValueError, match="input_disturbance"):
        simulate(controller, machine, np.ones(3), input_disturbance=np.ones(2))
    with pytest.raises(ValueError, match=r"dt_s: 0\.005 and 0\.01"):
        simulate(controller, LinearMachine(hub_arm(0.01)), np.ones(3))
    with pytest.raises(ValueError, match="1 outputs and 1 inputs"):
        simulate(controller, machine, np.ones(3), measured_index=1)
    with pytest.raises(ValueError, match="D = 0"):
        LinearMachine(control.ss(0.5, 1, 1, 1, 0.1))


def test_step_metrics_of_a_known_second_order_response():
    """zeta 0.5, omega 10: overshoot exp(-pi zeta/sqrt(1 - zeta^2)) = 16.30 %; the rest by python-control."""
    system = control.tf([100], [1, 10, 100])
    time = np.arange(0, 3, 0.0005)
    y = control.step_response(system, time).outputs
    at = 100
    trajectory = ClosedLoopTrajectory(
        np.arange(time.size + at) * 0.0005,
        np.concatenate([np.zeros(at), 2 * np.ones(time.size)]),
        np.concatenate([np.zeros(at), 2 * y])[:, None],
        np.full(time.size + at, 3.0),
        np.arange(time.size + at) < at + time.size // 4,
        0.0005,
    )
    metrics = step_metrics(trajectory)
    info = control.step_info(system, T=time)
    assert metrics.overshoot_percent == pytest.approx(100 * np.exp(-np.pi * 0.5 / np.sqrt(0.75)), rel=1e-4)
    # python-control counts samples, we interpolate: one sample of 0.5 ms each.
    assert metrics.rise_time_s == pytest.approx(info["RiseTime"], abs=1e-3)
    assert metrics.settling_time_s == pytest.approx(info["SettlingTime"], abs=1e-3)
    assert metrics.steady_error == pytest.approx(0, abs=1e-5)
    assert metrics.peak_command == 3
    assert metrics.limited_fraction == pytest.approx(0.25, abs=1e-3)
    assert metrics.undershoot_percent == 0


def test_step_metrics_refuse_what_is_no_step():
    trajectory = simulate(_controller(), LinearMachine(hub_arm()), np.sin(np.arange(50)))
    with pytest.raises(ValueError, match="reference"):
        step_metrics(trajectory)


class _Noisy(LinearMachine):
    """A linear machine with white measurement noise."""

    def __init__(self, system, rng, std):
        self._rng, self._std = rng, std
        super().__init__(system)

    def measure(self):
        return super().measure() + self._std * self._rng.standard_normal(1)


_GAIN = Controller.proportional(3.0, _DT)


def _analytic_sensitivity(omega):
    z = np.exp(1j * omega * _DT)
    return 1 / (1 + 3.0 / z * hub_arm()(z))


def test_measured_sensitivity_of_a_linear_machine_is_the_analytic_one():
    """Without noise only the lead-in's rest is left: pole radius 0.9932, 30 s, far below rounding."""
    played = {"rms": 0.1, "band_rad_s": (1.0, 100.0), "period_samples": 2000, "lead_in_periods": 3}
    found = measure_sensitivity(_GAIN, LinearMachine(hub_arm()), np.random.default_rng(1), **played)
    expected = _analytic_sensitivity(found.omega_rad_s)
    np.testing.assert_allclose(found.response, expected, atol=1e-6)
    assert found.omega_rad_s[0] >= 1.0
    assert found.omega_rad_s[-1] <= 100.0
    assert found.peak[0] == pytest.approx(np.max(np.abs(expected)), abs=1e-6)
    assert found.limited_fraction == 0.0


@pytest.mark.parametrize(("periods", "draws"), [(6, 1), (1, 5)])
def test_scatter_of_measured_sensitivity_is_stated_rightly(periods, draws):
    """Errors against the truth, in units of the stated deviation of the mean, have mean square near one."""
    found = measure_sensitivity(
        _GAIN, _Noisy(hub_arm(), np.random.default_rng(2), 0.01), np.random.default_rng(3), rms=0.1,
        band_rad_s=(1.0, 200.0), period_samples=2000, periods=periods, draws=draws, lead_in_periods=2,
    )  # fmt: skip
    error = np.abs(found.response) - np.abs(_analytic_sensitivity(found.omega_rad_s))
    # 300 lines: the ratio of mean squares has a relative standard deviation of 9 %; 4 of them allowed.
    assert np.mean(error**2) / np.mean(found.std**2) == pytest.approx(1.0, abs=0.36)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"periods": 1}, "1 and 1"),
        ({"rms": 0.0}, r"rms\D+0\.0"),
        ({"band_rad_s": (1e-5, 1e-4)}, "200 samples"),
    ],
)
def test_sensitivity_that_cannot_be_measured_is_refused(changes, words):
    settings = {"rms": 0.1, "band_rad_s": (1.0, 100.0), "period_samples": 200, **changes}
    with pytest.raises(ValueError, match=words):
        measure_sensitivity(_GAIN, LinearMachine(hub_arm()), np.random.default_rng(1), **settings)


@pytest.mark.parametrize("from_sample", [0, 30, 99])
def test_an_output_that_is_no_number_does_not_settle(from_sample):
    output = np.ones(100)
    run = simulate(_controller(), LinearMachine(hub_arm()), np.ones(100))
    output[from_sample:] = np.nan
    metrics = step_metrics(replace(run, output=output[:, None]))
    assert metrics.settling_time_s is None
    assert np.isnan(metrics.overshoot_percent)
    assert np.isnan(metrics.undershoot_percent)
