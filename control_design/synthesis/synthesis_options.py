"""How hard a synthesis searches: options of one loop, and of several joints.

Every field says in its description what it sets and, with its default, within which bounds. Larger values
take more time and may find a lower worst case gamma.
"""

from __future__ import annotations

from pydantic import Field

from control_design.plants.frequency_grid import GridOptions
from ident.data.settings import Settings


class SynthesisOptions(GridOptions):
    """Effort of the search; the defaults solve an order-5 design in about a second.

    Sizes of the grids come from `GridOptions`. A value out of its bounds or an unknown key is refused by
    pydantic (ValueError). The defaults are chosen for that time.

    Examples
    --------
    >>> quick = flexlink.SynthesisOptions(starts=1, dense_points=1000)
    >>> flexlink.synthesise(example_plant(), example_specification(), quick).outcome.name
    'MET_ON_GRID'
    """

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


class MultivariableOptions(Settings):
    """Effort of the search for one controller of several joints; the defaults take seconds for two joints.

    Chosen for that time. A value out of its bounds or an unknown key is refused by pydantic (ValueError).

    Examples
    --------
    >>> quick = flexlink.MultivariableOptions(rounds=2, steps=2)
    >>> plant, asked = example_joint_plant(), example_joint_specification()
    >>> flexlink.synthesise_multivariable(plant, asked, quick).controller.order
    2
    """

    starts: int = Field(default=1, ge=1, le=50, description="starts to go down from; the best counts")
    rounds: int = Field(default=40, ge=1, le=100, description="rounds of descent, with exchange")
    steps: int = Field(default=12, ge=1, le=200, description="steps of a round")
    grid_points: int = Field(default=60, ge=20, le=2000, description="logarithmic points of the programme")
    mode_points: int = Field(
        default=15, ge=5, le=500, description="points around each mode or zero of the plant"
    )
    dense_points: int = Field(
        default=600, ge=100, le=20_000, description="logarithmic points of the dense check"
    )
    sufficient_gamma: float = Field(default=0.0, ge=0, description="stop at this worst case; 0 = the best")
