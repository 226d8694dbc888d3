"""Nyquist count against closed-loop poles on random loops; margins by hand and by python-control."""

import control
import numpy as np
import pytest

from control_design import Controller, Ellipses, UncertainPlant
from control_design.analysis.margins import ellipse_margins, nominal_margins
from control_design.analysis.stability import closed_loop_poles, loop_integrators, mode_changes, nyquist_count
from control_design.plants.ellipses import distance_to_minus_one
from control_design.plants.frequency_grid import frequency_grid
from control_design.plants.plant_set import frequency_response

from .plants import random_stable


def _controller(system: control.StateSpace, delay: int) -> Controller:
    return Controller(*control.ssdata(system), float(system.dt), computational_delay_samples=delay)


def _count(controller: Controller, plant: UncertainPlant) -> bool:
    integrators, unstable = loop_integrators(controller, plant)
    omega = frequency_grid(plant.nyquist_rad_s, plant.modes, omega_min_rad_s=1e-4, n_log=400, n_mode=60)

    def loop(w: np.ndarray) -> np.ndarray:
        return controller.response(w) * plant.channel.nominal_response(w)

    return nyquist_count(loop, omega, integrators=integrators, unstable_poles=unstable).matches


def test_nyquist_count_and_poles_agree_over_random_loops():
    rng = np.random.default_rng(11)
    verdicts = []
    for trial in range(150):
        dt = 0.01
        g = random_stable(rng, int(rng.integers(1, 5)), dt)
        if trial % 3:  # integrators in the plant
            for _ in range(trial % 3):
                g = control.series(g, control.ss(1, dt, 1, 0, dt))
        if trial % 5 == 0:  # one unstable pole
            g = control.series(g, control.ss(1.1, 1, 0.1, 0.05, dt))
        k = random_stable(rng, int(rng.integers(1, 4)), dt)
        k = control.ss(k.A, k.B, k.C, rng.standard_normal() * np.ones((1, 1)), dt)
        if trial % 7 == 0:  # integrator in the controller
            k = control.series(k, control.ss(1, dt, 1, 1, dt))
        k = k * float(10 ** rng.uniform(-3, 0.5) * rng.choice([-1, 1]))
        plant, controller = UncertainPlant(g, name="random"), _controller(k, trial % 2)
        radius = np.max(np.abs(closed_loop_poles(controller, plant)))
        if abs(radius - 1) < 1e-6:
            continue
        verdicts.append(radius < 1)
        assert _count(controller, plant) == (radius < 1), (trial, radius)
    assert 20 < sum(verdicts) < len(verdicts) - 20  # both verdicts occur often


def test_margins_of_an_integrator_with_delay_by_hand():
    """L = k dt z^-1/(z - 1): arg L = -pi/2 - 3 theta/2 and |L| = k dt/(2 sin(theta/2)), theta = omega dt.

    The phase crossover is at theta = pi/3, where |L| = k dt: the gain may rise by 1/(k dt).
    """
    dt, k = 0.01, 20.0
    g = control.ss(1, dt, 1, 0, dt)

    def loop(omega: np.ndarray) -> np.ndarray:
        return k * frequency_response(g, omega) * np.exp(-1j * omega * dt)

    omega = np.geomspace(1e-3, np.pi / dt, 3000)
    margins = nominal_margins(loop, omega)
    crossover = 2 / dt * np.arcsin(k * dt / 2)
    phase = np.pi / 2 - 1.5 * crossover * dt
    assert margins.gain_up == pytest.approx(1 / (k * dt), rel=1e-9)
    assert margins.gain_down == 0
    assert margins.phase_rad == pytest.approx(phase, rel=1e-9)
    assert margins.delay_s == pytest.approx(phase / crossover, rel=1e-9)


def test_worst_margins_over_ellipses_agree_with_sampled_members():
    """Dense sampling of one ellipse's members: every sampled crossing lies within the exact worst case."""
    rng = np.random.default_rng(13)
    for _ in range(60):
        centre = np.array([rng.uniform(-1.5, 0.5) + 1j * rng.uniform(-1.2, 1.2)])
        major = np.array([rng.uniform(0.05, 0.8)])
        minor, turned = major * rng.uniform(0.05, 1), np.exp(1j * rng.uniform(0, 2 * np.pi, 1))
        e = Ellipses(np.array([2.0]), centre, major, minor, turned)
        k = np.array([1.0 + 0j])
        distance = distance_to_minus_one(k, e)
        margins = ellipse_margins(k, e, distance)
        if distance[0] == 0:
            assert margins.modulus == 0
            assert margins.phase_rad == 0
            continue

        def member(x: np.ndarray, e: Ellipses = e) -> np.ndarray:
            turned = (x - e.centre[0]) * np.conj(e.direction[0])
            inside = (turned.real / e.semi_major[0]) ** 2 + (turned.imag / e.semi_minor[0]) ** 2
            return np.asarray(inside <= 1)

        # Members on the unit circle and on the negative real axis, sampled; 1e-3 is a few sampling steps.
        angle = np.linspace(0, 2 * np.pi, 40_001)
        turn = angle[member(-np.exp(1j * angle))]
        either = np.minimum(turn, 2 * np.pi - turn)
        _same(margins.phase_rad, either.min(initial=np.inf))
        _same(margins.delay_s * 2.0, turn.min(initial=np.inf))
        real = np.linspace(-4, 0, 80_001)[:-1]
        hit = real[member(real + 0j)]
        _same(margins.gain_up, np.min(-1 / hit[hit > -1], initial=np.inf))
        _same(margins.gain_down, np.max(-1 / hit[hit < -1], initial=0.0))


def _same(exact: float, sampled: float) -> None:
    """Sampling may only miss what is thinner than its steps: close where it finds anything."""
    if np.isfinite(sampled) and sampled != 0:
        assert exact == pytest.approx(sampled, rel=2e-3, abs=2e-3)


_DT = 0.005


def _link(*modes: tuple[float, float]) -> UncertainPlant:
    """Sum of modes (rad/s, damping ratio) of unit static gain, each."""
    parts = [control.tf([w * w], [1.0, 2 * zeta * w, w * w]) for w, zeta in modes]
    return UncertainPlant(control.ss(sum(parts[1:], parts[0])).sample(_DT), name="link")


def _lead(gain: float, corner: float = 400.0, delay: int = 0) -> Controller:
    """gain s / (s/corner + 1): damping by the speed of the output; late, it takes damping away."""
    return _controller(control.ss(control.tf([gain, 0.0], [1 / corner, 1.0])).sample(_DT, "tustin"), delay)


def test_modes_move_in_closed_loop_as_perturbation_theory_has_it():
    """For a small gain a pole p of G moves by -K(p) times its residue, whichever other pole it passes."""
    plant = _link((30.0, 0.05), (33.0, 0.01), (150.0, 0.02))
    controller = _lead(1e-5, delay=2)
    g, k = control.tf(plant.nominal), controller
    num, den = np.squeeze(g.num[0][0]), np.squeeze(g.den[0][0])
    found = mode_changes(controller, plant)
    assert [round(change.open_loop.omega_rad_s) for change in found] == [30, 33, 150]
    for change in found:
        w, zeta = change.open_loop.omega_rad_s, change.open_loop.zeta
        pole = np.exp(w * (-zeta + 1j * np.sqrt(1 - zeta**2)) * _DT)
        residue = np.polyval(num, pole) / np.polyval(np.polyder(den), pole)
        law = k.C @ np.linalg.solve(pole * np.eye(k.order) - k.A, k.B) + k.D
        s = np.log(pole - residue * law[0, 0] * pole**-2) / _DT
        assert change.closed_loop.zeta - zeta == pytest.approx(-s.real / abs(s) - zeta, rel=2e-2)


@pytest.mark.parametrize("delay", [0, 12])
def test_a_loop_that_is_late_takes_damping_from_the_modes_it_is_late_for(delay):
    """A quarter period of the mode at 60 rad/s is 5 samples: 12 samples turn damping into the reverse there,
    and leave a mode at 10 rad/s damped."""
    plant = _link((10.0, 0.05), (60.0, 0.05))
    slow, fast = mode_changes(_lead(2e-4, delay=delay), plant)
    assert not slow.loses_damping
    assert slow.closed_loop.zeta > slow.open_loop.zeta
    assert fast.loses_damping == (delay > 0)


def test_a_pole_of_the_controller_that_rings_beside_a_mode_counts_as_the_mode():
    plant = _link((20.0, 0.1))
    resonance = control.ss(control.tf([1e-3 * 400.0], [1.0, 2 * 0.01 * 21.0, 441.0])).sample(_DT)
    (change,) = mode_changes(_controller(resonance, 0), plant)
    assert change.loses_damping
    assert change.closed_loop.zeta < 0.02


def test_a_mode_that_swings_no_more_has_not_lost_damping():
    (change,) = mode_changes(_lead(0.2, corner=2000.0), _link((20.0, 0.3)))
    assert change.closed_loop.zeta > 0.9
    assert not change.loses_damping
