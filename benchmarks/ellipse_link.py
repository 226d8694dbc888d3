"""The flexible link with ellipses: certified worst case of our designs, scenarios A, B, C at orders 3 to 6,
with CPU times.

    OMP_NUM_THREADS=1 python benchmarks/ellipse_link.py [--orders 3 4 5 6] [--scenarios A B C] [--seed 1]

The worst case is max(|W1 S|, |W3 K S|) over all ellipses from the certificate (its own refined grid, not the
optimiser's). Reference figures beside it: the same orders by a prototype, and the exact-ellipse Youla value.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from control_design import certify, synthesise
from control_design.example_plants import flexible_link, flexible_link_specification

REFERENCE: dict[str, dict[int | str, float]] = {
    "A": {3: 0.996, 4: 0.994, 5: 0.937, 6: 0.931, "youla": 0.931},
    "B": {3: 1.349, 4: 1.155, 5: 1.085, 6: 1.082, "youla": 1.065},
    "C": {3: 1.508, 4: 1.366, 5: 1.334, 6: 1.277, "youla": 1.268},
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--orders", type=int, nargs="+", choices=[3, 4, 5, 6], default=[3, 4, 5, 6])
    parser.add_argument("--scenarios", nargs="+", choices=list(REFERENCE), default=list(REFERENCE))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("scenario order  certified  reference   youla  stable  design s  certify s")
    for scenario in arguments.scenarios:
        for order in arguments.orders:
            plant, specification = flexible_link(scenario), flexible_link_specification(order)
            begin = time.process_time()
            result = synthesise([plant], specification, rng=np.random.default_rng(arguments.seed))
            designed = time.process_time()
            certificate = certify(result.controller, [plant], specification)
            done = time.process_time()
            verdict = certificate.plants[0]
            known = REFERENCE[scenario]
            sound = verdict.stable and verdict.nyquist.matches
            print(
                f"{scenario:>8} {order:>5}  {certificate.gamma:>9.4f}  {known[order]:>9.3f}  "
                f"{known['youla']:>6.3f}  {sound!s:>6}  {designed - begin:>8.1f}  {done - designed:>9.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
