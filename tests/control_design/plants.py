"""Small plants of the tests; built with python-control only."""

from typing import Any

import control
import numpy as np

from control_design import Controller, UncertainPlant
from ident import Poles
from ident.uncertainty import ResponsePosterior
from validation.example_plants import ResponseRecord


class RelativeDisc:
    """Discs of relative radius that grow with frequency, on any frequency; evaluated by python-control."""

    def __init__(self, system: control.StateSpace, relative_std: float, corner_rad_s: float) -> None:
        self.system, self.relative_std, self.corner = system, relative_std, corner_rad_s

    def at(self, omega_rad_s: np.ndarray, level: float) -> ResponseRecord:
        centre = np.asarray(control.frequency_response(self.system, omega_rad_s).complex).reshape(-1)
        std = np.abs(centre) * self.relative_std * np.sqrt(1 + (omega_rad_s / self.corner) ** 4)
        return ResponseRecord(omega_rad_s, centre, std[:, None, None] ** 2 * np.eye(2), level)


def hub_arm(dt_s: float = 0.005, *, integrators: int = 1) -> control.StateSpace:
    """Voltage to hub angle: integrator(s), motor lag, zeros at 12 rad/s below a mode at 16 rad/s."""
    numerator = 50 * 256 / 144 * np.array([1, 2 * 0.01 * 12, 144])
    rigid = [1, 8, 0] if integrators == 1 else [1, 0, 0]
    denominator = np.polymul([1, 2 * 0.015 * 16, 256], rigid)
    return control.c2d(control.ss(control.tf(numerator, denominator)), dt_s, "zoh")


def tip_acceleration(dt_s: float = 0.005) -> control.StateSpace:
    """Motor voltage to tip acceleration of the same arm."""
    denominator = np.polymul([1, 2 * 0.015 * 16, 256], [1, 8])
    return control.c2d(control.ss(control.tf([3.0, 0, 0], denominator)), dt_s, "zoh")


def random_stable(rng: np.random.Generator, n: int, dt_s: float) -> control.StateSpace:
    """Random stable discrete system without feedthrough, poles inside 0.97."""
    a = rng.standard_normal((n, n))
    a *= rng.uniform(0.3, 0.97) / np.max(np.abs(np.linalg.eigvals(a)))
    return control.ss(a, rng.standard_normal((n, 1)), rng.standard_normal((1, n)), 0, dt_s)


def uncertain_hub(relative_std: float, **more: Any) -> UncertainPlant:
    """`hub_arm` in discs."""
    return UncertainPlant(
        hub_arm(), name="hub", uncertainty=RelativeDisc(hub_arm(), relative_std, 60.0), **more
    )


def uncertain_lag(std: float, level: float = 0.95) -> UncertainPlant:
    """G = (1 + std x) 0.02/(z - 0.98), x ~ N(0, 1); its ellipses hold |x| below the radius of the level."""
    poles, scale = Poles(np.array([0.98]), np.zeros(0, complex)), 0.02 / np.sqrt(1 - 0.98**2)
    posterior = ResponsePosterior(poles, np.array([scale]), np.array([[scale * std]]), 0.005)
    return UncertainPlant(
        control.ss([[0.98]], [[1.0]], [[0.02]], 0, 0.005), name="lag", uncertainty=posterior, level=level
    )


def notched(corners_rad: Any, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator in z of PI and notches, corners in radians per sample: poles close together
    where these are small."""
    above, below = np.array([1.0, -1 + 2 * dt_s]), np.array([1.0, -1.0])
    for corner in corners_rad:
        zero, pole = np.exp((-0.02 + 1j) * corner), np.exp(0.7 * (-1 + 1j) * corner)
        above = np.polymul(above, np.poly([zero, zero.conj()]).real)
        below = np.polymul(below, np.poly([pole, pole.conj()]).real)
    return above, below


def gain(value: float, delay: int = 1) -> Controller:
    return Controller.proportional(value, 0.005, computational_delay_samples=delay)
