"""The writer of SVG: places, paths, numbers, and words that are whole."""

import ast
import itertools
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

import workflow
from workflow.figures import style, svg
from workflow.figures.description import Y, new_picture
from workflow.figures.ticks import linear_ticks, log_ticks

HOSTILE = "a_$very$_<b>long</b> & 漢 --> <script>"
LINE = {"color": style.MODEL, "lw": 1.4}


def everything(scale=1.0, words="Two panels and more"):
    """Second axes, hidden numbers, labels of several widths, a title, a legend, every kind of mark."""
    picture, grid = new_picture(5.0, 2, 2, sharex="col", height_ratios=[1.6, 1.0], width_ratios=[2.1, 1.0])
    omega = np.geomspace(0.1, 300, 50)
    for panel in grid.ravel():
        panel.plot(omega, scale * np.sin(omega), **LINE, label=words)
        panel.plot(omega[::9], scale * np.cos(omega[::9]), ls="none", marker="o", ms=5, label="markers")
        panel.fill_between(omega, -0.1 * scale, 0.1 * scale, **style.BAND, label="a band")
        panel.set(xscale="log", xlim=(0.1, 300))
    grid[0, 0].set_title(words)
    grid[0, 0].set(ylabel="level [1]")
    grid[1, 0].set(ylabel="another\n[rad]")
    grid[1, 1].set(xlabel="frequency [rad/s]")
    grid[0, 0].hertz = True
    style.tag_below(grid[1, 1], 10.0, "mode 1")
    return picture


def page_of(picture, classes=None):
    made = svg.drawn(picture, 'a "label" & more', 3, {} if classes is None else classes)
    return made, ElementTree.fromstring(made.svg)


def points_of(path):
    """Corners of a path of relative steps, a list of arrays."""
    at, lines = np.zeros(2), []
    for steps, closed in re.findall("m([^mz]*)(z?)", path):
        numbers = np.array([float(number) for number in re.findall(r"-?\d*\.?\d+", steps)]).reshape(-1, 2)
        line = at + np.cumsum(numbers, axis=0)
        at = line[0] if closed else line[-1]
        lines.append(line)
    return lines


@pytest.mark.parametrize("closed", [False, True])
def test_paths_go_where_the_points_are(closed):
    rng = np.random.default_rng(1)
    parts = [np.cumsum(rng.normal(0, 30, (n, 2)), axis=0) for n in (1, 2, 40)]
    found = points_of(svg._many(parts, closed=closed))
    for line, part in zip(found, parts, strict=True):
        # Half of a tenth in x, half of a hundredth in y; errors of steps do not add up.
        assert np.all(np.abs(line - part).max(axis=0) < [0.0501, 0.00501])


def distance(points, line):
    """Largest distance of points (N, 2) from a line of corners (M, 2)."""
    way = np.diff(line, axis=0)
    off = points[:, None] - line[:-1]
    along = np.clip(np.sum(off * way, axis=2) / np.maximum(np.sum(way**2, axis=1), 1e-300), 0, 1)
    return np.linalg.norm(off - along[..., None] * way, axis=2).min(axis=1).max()


@pytest.mark.parametrize("unseen", [0.03, 0.1])
def test_a_thinned_line_is_where_the_full_one_is(unseen):
    angle = np.linspace(0, 2 * np.pi, 700)
    circle = 100 * np.column_stack([np.cos(angle), np.sin(angle)])
    x = np.linspace(0, 300, 900)
    wave = np.column_stack([x, 60 * np.sin(x / 20) * np.exp(-x / 100)])
    for line in (circle, wave):
        kept = svg.thinned(line, unseen)
        assert len(kept) < 0.3 * len(line)
        # What later turns leave out adds to what earlier ones did.
        assert distance(line, kept) < 3 * unseen
        assert np.array_equal(kept[[0, -1]], line[[0, -1]])


def test_noise_keeps_its_extremes():
    signal = np.random.default_rng(2).standard_normal(20_000)
    line = np.column_stack([np.linspace(0, 400, signal.size), 30 * signal])
    kept = svg.thinned(line)
    assert len(kept) <= 4 * 400 / svg._PIXEL + 4
    assert (kept[:, 1].min(), kept[:, 1].max()) == (line[:, 1].min(), line[:, 1].max())


def test_places_of_values_on_every_scale():
    picture, (linear, logarithmic, both) = new_picture(3.0, 1, 3)
    linear.set(xlim=(0, 4), ylim=(10, -10))  # upside down
    logarithmic.set(xscale="log", xlim=(1, 100), yscale="log", ylim=(0.1, 10))
    both.set(yscale=10.0, ylim=(-1000, 1000))
    for panel, x, y, share in (
        (linear, 1.0, 0.0, (0.25, 0.5)),
        (linear, 4.0, -10.0, (1.0, 1.0)),
        (logarithmic, 10.0, 1.0, (0.5, 0.5)),
        (logarithmic, 1.0, 10.0, (0.0, 1.0)),
        (both, 0.0, 0.0, (0.0, 0.5)),
    ):
        assert panel.x.shares(x) == pytest.approx(share[0])
        assert panel.y.shares(y) == pytest.approx(share[1])
    # A decade is as long as any other, and the linear part as long as 10/9 of one.
    at = both.y.even([0, 10, 100, 1000])
    np.testing.assert_allclose(np.diff(at), [10 / 9, 1, 1])
    assert len(svg.drawn(picture, "", 1, {}).plot["axes"]) == 3


def test_a_line_is_drawn_at_its_values():
    picture, panel = new_picture(3.0)
    x = np.array([0.0, 1.0, 2.0, np.nan, 3.0, 4.0])
    panel.plot(x, np.array([0.0, 5.0, 1.0, 1.0, 2.0, 9.0]), **LINE)
    panel.set(xlim=(0, 4), ylim=(0, 10))
    made, page = page_of(picture)
    left, top, right, bottom = made.plot["axes"][0]["box"]
    (path,) = page.findall(".//g[@class='m']//path")
    first, second = points_of(path.get("d"))
    wanted = np.array([[0, 0], [0.25, 0.5], [0.5, 0.1], [0.75, 0.2], [1, 0.9]])
    places = np.array([left, bottom]) + wanted * np.array([right - left, top - bottom])
    assert np.abs(np.concatenate([first, second]) - places).max() < 0.11  # the gap parts the line


def test_what_lies_outside_of_a_panel_is_not_written():
    picture, panel = new_picture(3.0)
    x = np.linspace(0, 100, 2001)
    panel.plot(x, np.sin(x), **LINE)
    panel.plot(x, np.cos(x), ls="none", marker="x")
    panel.set(xlim=(0, 1))
    _, page = page_of(picture)
    (line,) = page.findall(".//g[@class='m']//path")
    (dots,) = page.findall(".//path[@class='p']")
    assert len(points_of(line.get("d"))[0]) < 25
    assert len(points_of(dots.get("d"))[0]) <= 24


@pytest.mark.parametrize("scale", [1.0, 1e-7, 3e6])
@pytest.mark.parametrize("words", ["Two panels and more", HOSTILE])
def test_words_are_whole_and_none_lies_on_another(scale, words):
    made, _ = page_of(everything(scale, words))
    assert len(made.narrow) == 2  # a part of it is too wide for a narrow screen
    for form in (made, *made.narrow):
        boxes = boxes_of_words(form)
        assert len(boxes) > 10
        for said, left, top, right, bottom in boxes:
            assert left > -1, said
            assert top > -1, said
            assert right < form.plot["width"] + 1, said
            assert bottom < form.plot["height"] + 1, said
        for (one, *a), (other, *b) in itertools.combinations(boxes, 2):
            overlap = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
            assert min(overlap) < 1, f"{one!r} overlaps {other!r}"
    for form in (made, made.narrow[0]):
        assert words in [said for said, *_ in boxes_of_words(form)]


def boxes_of_words(made):
    """Words of a picture and the box of each (left, top, right, bottom) [pt]."""
    boxes = []
    # Of data only the legend and tags speak; here are titles, labels and numbers.
    for group in ElementTree.fromstring(made.svg).findall("./g"):
        for text in group.iter("text"):
            lines = [text.text or "", *(line.text or "" for line in text)]
            said = " ".join(lines)
            size = {"ti": 10.5, "lb": 9.5, "se": 8.5}.get((text.get("class") or "").split(" ")[0], 9.0)
            bold = "ti" in (text.get("class") or "")
            length = svg.text_width("\n".join(lines), size, bold=bold)
            if turned := re.match(r"translate\(([-\d.]+) ([-\d.]+)\)rotate", text.get("transform", "")):
                x, y = map(float, turned.groups())
                boxes.append((said, x - 0.76 * size, y - length / 2, x + 0.2 * size, y + length / 2))
                continue
            x, y = float(text.get("x")), float(text.get("y"))
            names = f"{text.get('class')} {next((g.get('class') for g in group if text in list(g)), '')}"
            x -= length if " en" in names else length / 2 if " mi" in names else 0
            foot = y + 1.2 * size * (len(lines) - 1)
            boxes.append((said, x, y - 0.76 * size, x + length, foot + 0.2 * size))
    return boxes


def test_long_names_and_labels_leave_room_for_bars_on_a_narrow_screen():
    """Names beside bars go on in a second line, the label below moves inwards, numbers at the ends are
    whole."""
    names = ["a delay of the command and output offset", "something else that is missing here", "short"]
    picture, panel = new_picture(3.0)
    panel.y.named = [(float(k), name) for k, name in enumerate(names)]
    panel.x.every = 20.0
    panel.bars(np.arange(3.0), np.array([100.0, 99.8, 3.0]), 0.6, lying=True, color=style.MODEL)
    for k, share in enumerate((100.0, 99.8, 3.0)):
        panel.words(f"{share:g} %", share, k, offset=(4, 0), vertical="center")
    panel.set_title("What each of these effects explains by itself, and no other")
    panel.set(xlabel="share of the model error that is explained by it [%]", xlim=(0, 105))
    made, _ = page_of(picture)
    (narrow,) = made.narrow
    assert sorted(names) == sorted(said for said, *_ in boxes_of_words(narrow) if said in names)
    for said, left, top, right, bottom in boxes_of_words(narrow):
        assert 0 <= left < right <= narrow.plot["width"], said
        assert 0 <= top < bottom <= narrow.plot["height"], said
    left, _, right, _ = narrow.plot["axes"][0]["box"]
    assert right - left > 0.4 * narrow.plot["width"]
    # On a wide screen a name of this length stands on one line.
    assert 'class="y en"' in made.body
    assert "<tspan" not in made.body


def test_a_narrow_part_shows_the_lines_of_the_whole_at_the_same_values():
    """It writes none of its own: those of the whole stand in its panel, corner on corner."""
    made, page = page_of(everything(1.0, "Two panels and more"))
    lines = {group.get("id"): group for group in page.iter("g") if group.get("id")}
    shown = []
    for part in made.narrow:
        again = ElementTree.fromstring(part.svg)
        assert not again.findall(".//g[@class='m']/path")
        for place, axes in enumerate(part.plot["axes"]):
            for use in again.find(f"./g[@class='a{place}']").iter("use"):
                shown.append(use.get("href")[1:])
                of_panel = next(k for k in range(9) if page.find(f"./g[@class='a{k}']//*[@id='{shown[-1]}']"))
                whole = made.plot["axes"][of_panel]
                a, _, _, d, e, f = map(float, re.findall(r"-?[\d.]+(?:e-?\d+)?", use.get("transform")))
                corners = np.reshape(whole["box"], (2, 2)) * [a, d] + [e, f]
                assert corners.ravel() == pytest.approx(axes["box"], abs=0.05)
    assert sorted(shown) == sorted(lines)


@pytest.mark.parametrize("scale", [1e-7, 3e6])
def test_numbers_without_their_power_of_ten_say_which_it_is(scale):
    picture, panel = new_picture(3.0)
    panel.plot([0, 1], [0, 1.5 * scale], **LINE)
    panel.set_title("Small or large")
    _, page = page_of(picture)
    words = {"".join(text.itertext()): text for text in page.iter("text")}
    power = next(text for said, text in words.items() if said.startswith("×10"))
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    factor = 10.0 ** int("".join(power.itertext()).removeprefix("×10").translate(digits))
    assert scale / 10 < factor <= 10 * scale
    assert float(power.get("y")) > float(words["Small or large"].get("y")) + 10  # the title is above


def test_letters_are_as_wide_as_measured():
    for words in ("frequency [rad/s]", "identified response (centre)", "0.001", "WMlit|"):
        wide = TextPath((0, 0), words, size=10, prop=FontProperties(family="DejaVu Sans")).get_extents().width
        assert svg.text_width(words, 10) == pytest.approx(wide, rel=0.06, abs=2)


def test_a_picture_is_well_formed_whatever_its_words():
    classes: dict[str, str] = {}
    made, page = page_of(everything(words=HOSTILE), classes)
    assert "<script>" not in made.svg
    assert page.get("aria-label") == 'a "label" & more'
    assert [words for _, words in made.legend] == [HOSTILE, "markers", "a band"]
    # Every look is a class of the page.
    used = {name for part in page.iter() for name in part.get("class", "").split() if re.match(r"s\d", name)}
    assert used <= set(classes.values())
    file = ElementTree.fromstring(svg.svg_file(made, classes))
    said = ["".join(text.itertext()) for text in file.iter("{http://www.w3.org/2000/svg}text")]
    assert {HOSTILE, "markers", "a band", "frequency [Hz]", "mode 1"} <= set(said)


def test_same_bytes_twice():
    def once():
        classes: dict[str, str] = {}
        made = svg.drawn(everything(), "", 1, classes)
        return svg.svg_file(made, classes), made.svg

    assert once() == once()


def test_shared_numbers_stand_below_and_labels_of_a_column_under_each_other():
    _, page = page_of(everything())
    groups = [page.find(f"./g[@class='a{place}']") for place in range(5)]
    numbers = [group.findall("./g[@class='x mi']/text") for group in groups]
    # The second axis of the first panel comes after it.
    assert [bool(texts) for texts in numbers] == [False, True, False, True, True]
    places = [
        text.get("transform").partition(" ")[0].removeprefix("translate(")
        for group in (groups[0], groups[3])
        for text in group.findall("./text")
        if text.get("transform")
    ]
    # The second line of a label is nearer to the numbers: where a label of one line stands.
    assert float(places[0]) == pytest.approx(float(places[-1]), abs=0.1)


def test_a_legend_names_each_look_once_and_hides_it_in_every_panel():
    made, page = page_of(everything())
    assert len(made.legend) == 3
    for place in (0, 2, 3, 4):
        panel = page.find(f"./g[@class='a{place}']")
        assert {group.get("class") for group in panel if group.get("clip-path")} >= {"k0", "k1", "k2"}


@pytest.mark.parametrize("seed", range(6))
def test_numbers_of_an_axis_are_round_even_and_in_view(seed):
    rng = np.random.default_rng(seed)
    low = float(rng.normal() * 10.0 ** rng.integers(-8, 8))
    high = low + float(10.0 ** rng.uniform(-2, 2)) * max(abs(low), 1e-9)
    ticks = linear_ticks(low, high, 8)
    assert 2 <= ticks.places.size <= 9
    assert low <= ticks.places.min() + 1e-9 * (high - low)
    assert ticks.places.max() <= high + 1e-9 * (high - low)
    np.testing.assert_allclose(np.diff(ticks.places), np.diff(ticks.places)[0], rtol=1e-6)
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    factor = 10.0 ** int(ticks.power.removeprefix("×10").translate(digits) or 0)
    said = [factor * float(word.replace("\u2212", "-")) for word in ticks.words]
    np.testing.assert_allclose(said, ticks.places, rtol=1e-6, atol=1e-9 * abs(high))


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.05, 300.0, ["0.1", "1", "10", "100"]),
        (3e-6, 2.0, ["10⁻⁵", "10⁻⁴", "0.001", "0.01", "0.1", "1"]),
        (1.0, 30.0, ["1", "2", "5", "10", "20"]),
        (40.0, 61.0, ["40", "45", "50", "55", "60"]),
    ],
)
def test_numbers_of_a_logarithmic_axis(low, high, words):
    ticks = log_ticks(low, high, 9)
    assert ticks.words == words
    assert np.all((ticks.minor >= low) & (ticks.minor <= high))
    assert not np.isin(ticks.minor, ticks.places).any()


def test_bars_begin_where_they_are_said_to():
    picture, panel = new_picture(3.0)
    panel.bars([0, 1, 2], [3.0, 5.0, 4.0], 0.6, begins=[0.0, 1.0, 2.0], color=style.MODEL)
    panel.set(ylim=(0, 6))
    made, page = page_of(picture)
    _, top, _, bottom = made.plot["axes"][0]["box"]
    ends = [points_of(path.get("d"))[0][:, 1] for path in page.findall(".//g[@class='m']//path")]
    share = [(bottom - end) / (bottom - top) for end in ends]
    found = np.array([[6 * part.min(), 6 * part.max()] for part in share])
    np.testing.assert_allclose(found, [[0, 3], [1, 5], [2, 4]], atol=0.01)
    assert panel.axis(Y) is panel.y


@pytest.mark.long
def test_one_module_needs_matplotlib():
    """Pages are drawn without it, and it takes half a second to load."""
    needing = set()
    for path in Path(workflow.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            if any(name.partition(".")[0] == "matplotlib" for name in names):
                needing.add(path.name)
    assert needing == {"matplotlib_figure.py"}
