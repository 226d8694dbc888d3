"""How finely the convex programmes are solved: the bound over all controllers, and the reference filter.

Both work on frequency grids and exchange violated frequencies, so both extend `GridOptions`. The limits of
each field refuse sizes that a programme cannot be solved with. On the example link a basis of 91 instead of
57 functions lowers the bound by 0.1 %.
"""

from __future__ import annotations

from pydantic import Field

from control_design.plants.frequency_grid import GridOptions


class YoulaOptions(GridOptions):
    """Size of the basis of Q and of the grids of `youla_bracket`; the defaults take about two seconds a
    plant, and were chosen for that. Further fields (points of the dense check and the like) are those of
    `GridOptions`. A value out of its bounds or an unknown key is refused by pydantic (ValueError).

    Examples
    --------
    >>> small = flexlink.YoulaOptions(grid_points=60, dense_points=1000)
    >>> flexlink.youla_bracket(example_plant(), example_specification(), small).floor <= 1.0
    True
    """

    real_poles: int = Field(default=32, ge=2, le=200, description="real poles of the basis of Q")
    mirrored_poles: int = Field(
        default=6, ge=0, le=50, description="real poles of the basis of Q at negative z, next to Nyquist"
    )
    pairs_per_mode: int = Field(
        default=12, ge=1, le=50, description="pole pairs of the basis at every mode and light zero"
    )
    grid_points: int = Field(default=200, ge=20, le=2000, description="logarithmic points of the programme")
    mode_points: int = Field(
        default=100, ge=0, le=1000, description="points spread around the flexible modes"
    )
    exchange_rounds: int = Field(default=6, ge=0, le=20, description="rounds of adding violated frequencies")


class ReferenceFilterOptions(GridOptions):
    """Order of the reference filter of `design_reference_filter` and how finely it is designed.

    A value out of its bounds or an unknown key is refused by pydantic (ValueError); that decay rates lie
    below Nyquist is checked by the design, which knows the sampling time.
    """

    order: int = Field(
        default=1, ge=0, le=12, description="real poles, searched; unused if poles_rad_s is given"
    )
    poles_rad_s: tuple[float, ...] | None = Field(
        default=None, description="decay rates of the real poles, rad/s; none = searched"
    )
    unit_gain: bool = Field(
        default=True, description="F(1) = 1: the loop treats constant references as before"
    )
    exchange_rounds: int = Field(default=3, ge=0, le=20, description="rounds of adding violated frequencies")
