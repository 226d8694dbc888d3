"""Which modal block lowers the worst case fastest: column generation over frequency and damping.

At a local minimum of smaller order every slope is balanced, but not those of a block that is not there yet.
For a block (w, zeta) with output matrix C and input matrix B the worst case falls by <T(B), C>, T linear in
B, so the best B of unit size is the first singular vector of T. What counts is the fall while no other row
near the worst rises by more: the singular value over the largest change of such a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Real
from control_design.synthesis.modal_controller import ModalForm
from control_design.synthesis.multivariable_descent import Pull

_FREQUENCIES = 60  # over three decades three of them within `_APART`
_DAMPINGS = (0.1, 0.3, 0.6, 1.0, 3.0)
_FASTEST = 30.0  # in units of the scale
_APART = 0.35  # of log w between two blocks on the list


@dataclass(frozen=True, eq=False)
class Block:
    """Frequency, damping ratio and B (2, Y) of a block; merit: fall of the worst log gamma^2 for a change of
    one in the row that changes most."""

    merit: float
    omega_rad_s: float
    zeta: float
    B: Real


def best_blocks(form: ModalForm, block: int, pull: Pull, most: int) -> list[Block]:
    """At most `most` blocks for place `block` of a form, of the largest merit and apart in frequency."""
    rows, columns = form.masks(block)
    size = np.exp(form.bounds()[0][form.blocks])  # the smallest damping that the form allows
    found = []
    for omega in np.geomspace(form.slowest, _FASTEST * form.scale, _FREQUENCIES):
        for zeta in _DAMPINGS:
            if zeta < size:
                continue
            ratio = pull.s / omega
            swing = ratio + 2 * zeta
            E = np.array([[swing, np.ones_like(ratio)], [-np.ones_like(ratio), ratio]])
            E = E / (ratio * swing + 1.0)  # (2, 2, r)
            T = 2 * np.einsum("ryu,klr->ukly", pull.on_K, E).real
            T[~rows], T[..., ~columns] = 0.0, 0.0
            left, values, right = np.linalg.svd(T.reshape(2 * form.inputs, -1))
            C, B = left[:, 0].reshape(form.inputs, 2), right[0].reshape(2, form.outputs)
            seen, sent = np.conj(pull.left) @ C, pull.right @ B.T  # (r, 2) each
            change = 2 * np.abs(np.einsum("rk,klr,rl->r", seen, E, sent).real)
            found.append(Block(float(values[0] / max(np.max(change), 1e-300)), float(omega), zeta, B))
    found.sort(key=lambda each: -each.merit)
    chosen: list[Block] = []
    for each in found:
        if all(abs(np.log(each.omega_rad_s / other.omega_rad_s)) > _APART for other in chosen):
            chosen.append(each)
        if len(chosen) == most:
            break
    return chosen
