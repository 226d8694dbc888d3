"""Machines whose truth comes from scipy's integrator, event by event: not from what is on trial."""

import numpy as np
from scipy.integrate import solve_ivp


def rubbing(acceleration, force, dt_s, level=lambda v: 0.0):
    """Position and speed (T, 2) of a body that starts at rest; acceleration(x, v, u), dry friction level(v).

    Both per mass. Friction by its three states: slipping either way until the speed is zero, stuck until more
    than the level at rest pulls.
    """
    x, v = 0.0, 0.0
    found = np.zeros((force.size, 2))
    for k, u in enumerate(force):
        found[k] = x, v
        t = 0.0
        while t < dt_s:
            pull = acceleration(x, 0.0, u)
            if v == 0.0 and abs(pull) <= level(0.0):
                break
            way = np.sign(v) or np.sign(pull)

            def stops(t, s, way=way):
                return s[1] + way * 1e-15

            stops.terminal, stops.direction = True, -way
            run = solve_ivp(
                lambda t, s, u=u, way=way: (s[1], acceleration(s[0], s[1], u) - way * level(s[1])),
                (t, dt_s),
                (x, v),
                events=stops if level(0.0) else None,
                rtol=1e-8,
                atol=1e-11,
            )
            t, (x, v) = run.t[-1], run.y[:, -1]
            if run.status == 1:
                v = 0.0
    return found


def binary(rng, n, hold):
    """(n,) random signs, each held."""
    return rng.choice([-1.0, 1.0], -(-n // hold)).repeat(hold)[:n]
