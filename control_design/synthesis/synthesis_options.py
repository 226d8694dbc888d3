"""How hard the synthesis searches."""

from __future__ import annotations

from pydantic import Field

from control_design.plants.frequency_grid import GridOptions


class SynthesisOptions(GridOptions):
    """Effort of the search; the defaults solve an order-5 design in about a second."""

    starts: int = Field(
        default=6,
        ge=1,
        le=100,
        description="random low-gain starts of each order, and as many shaped at the modes, where needed",
    )
    agreeing_starts: int = Field(
        default=3, ge=1, description="stop early when this many starts reach the best value within 0.1 %"
    )
    sufficient_gamma: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="stop as soon as a stable design reaches this gamma; 0 = look for the best",
    )
    exchange_rounds: int = Field(default=4, ge=0, le=20, description="rounds of adding violated frequencies")
    iterations: int = Field(
        default=100,
        ge=10,
        le=5000,
        description="IPOPT iterations per start; a descent then finishes it",
    )
    jobs: int = Field(
        default=1,
        ge=1,
        le=64,
        description="processes that work on the starts; the result does not depend on their number",
    )
