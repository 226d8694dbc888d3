"""Panels and words stand where matplotlib's own constrained layout has them."""

import numpy as np
import pytest

from workflow.figures import style
from workflow.figures.layout import lay_out, titles


def panels_with_everything(scale=1.0):
    """Second axes, hidden numbers, labels of several widths, a title, a legend."""
    with style.house_style():
        figure, grid = style.panels(
            5.0, 2, 2, sharex="col", height_ratios=[1.6, 1.0], width_ratios=[2.1, 1.0]
        )
        omega = np.geomspace(0.1, 300, 50)
        for axes in grid.ravel():
            axes.semilogx(omega, scale * np.sin(omega), label="what is drawn")
        grid[0, 0].set_title("Two panels and more")
        grid[0, 0].set_ylabel("level [1]")
        grid[1, 0].set_ylabel("another\n[rad]")
        grid[1, 1].set_xlabel("frequency [rad/s]")
        style.hertz_axis(grid[0, 0])
        style.finish(figure)
    return figure


def positions(figure):
    return np.array([axes.get_position(original=True).extents for axes in figure.axes])


@pytest.mark.parametrize("scale", [1.0, 1e-7, 3e6])
def test_panels_stand_where_the_constrained_layout_has_them(scale):
    ours, theirs = panels_with_everything(scale), panels_with_everything(scale)
    with style.house_style():
        lay_out(ours)
        theirs.get_layout_engine().execute(theirs)
    np.testing.assert_allclose(positions(ours), positions(theirs), atol=2e-3)


def test_labels_of_a_column_stand_under_each_other_and_beside_their_numbers():
    figure = panels_with_everything()
    with style.house_style():
        lay_out(figure)
        boxes = [axes.yaxis.label.get_window_extent() for axes in figure.axes[::2]]
        numbers = [label.get_window_extent() for axes in figure.axes[::2] for label in axes.get_yticklabels()]
    assert boxes[0].x1 == pytest.approx(boxes[1].x1, abs=1.0)
    assert max(box.x1 for box in boxes) < min(box.x0 for box in numbers if box.width)


@pytest.mark.parametrize("scale", [1.0, 1e-7])
def test_a_title_is_above_all_that_stands_above_its_panel(scale):
    figure = panels_with_everything(scale)
    with style.house_style():
        lay_out(figure)
        figure.draw_without_rendering()
        title = next(titles(figure.axes[0])).get_window_extent()
        renderer = figure._get_renderer()
        others = [figure.axes[0].child_axes[0].get_tightbbox(renderer)]
        others.append(figure.axes[0].yaxis.get_offset_text().get_window_extent(renderer))
    assert title.y0 > max(box.y1 for box in others) - 1
    assert title.y1 < figure.bbox.y1


def test_a_title_is_above_the_power_of_ten_of_its_axis():
    with style.house_style():
        figure, axes = style.panels(3.0)
        axes.plot([0, 1], [0, 3e-7])
        axes.set_title("Small")
        style.finish(figure)
        lay_out(figure)
        figure.draw_without_rendering()
        power = axes.yaxis.get_offset_text()
        assert power.get_text()
        assert next(titles(axes)).get_window_extent().y0 > power.get_window_extent().y1
