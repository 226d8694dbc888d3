"""A picture as a part of the page: text is text, what looks alike shares a class, the unseen is left out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from xml.etree import ElementTree as ET

from markupsafe import Markup

from workflow.figures.style import Picture

_SVG = "{http://www.w3.org/2000/svg}"
_XLINK = "{http://www.w3.org/1999/xlink}href"
# Entry of a legend: height of its words, width of its sample, and the gap between them.
_HEIGHT, _SAMPLE, _GAP = 9.0, 18.0, 7.2


def inline(
    picture: Picture, label: str, number: int, styles: dict[str, str]
) -> tuple[Markup, list[tuple[Markup, str]]]:
    """The SVG without its legend, and the legend: (sample, words) of each entry.

    label: what is read aloud in its place; number: of the picture in the page;
    styles: classes of the page by what they say, added to.
    """
    root = ET.fromstring(picture.content)
    ids: dict[str, str] = {}
    for element in root.iter():
        element.tag = element.tag.removeprefix(_SVG)
    _clean(root, number, styles, ids)
    samples = []
    for group in list(root.iter("g")):
        for child in list(group):
            if child.get("id", "").startswith("legend_"):
                samples = list(_samples(child))
                group.remove(child)
    for group in root.iter("g"):
        _named(group)
    _flatten(root)
    marks = {path.get("id"): path for path in root.iter("path") if path.get("id")}
    for group in root.iter("g"):
        _minor_ticks_together(group, marks)
    size = picture.plot["width"], picture.plot["height"]
    root.attrib = {"viewBox": f"0 0 {size[0]} {size[1]}", "role": "img", "aria-label": label}
    return Markup(_text(root)), list(zip(samples, picture.plot["legend"], strict=True))


def _clean(root: ET.Element, number: int, styles: dict[str, str], ids: dict[str, str]) -> None:
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("metadata", "style") or (child.tag == "defs" and not len(child)):
                parent.remove(child)
    for element in root.iter():
        element.tail = None
        if element.tag != "text":
            element.text = None
        style = element.attrib.pop("style", "")
        style = re.sub(r"font-family: [^;]*;? ?", "", style).replace(": ", ":").replace("; ", ";")
        if style:
            element.set("class", styles.setdefault(style, f"s{len(styles)}"))
        if _XLINK in element.attrib:
            element.set("href", element.attrib.pop(_XLINK))
        if "d" in element.attrib:
            element.set("d", relative(element.attrib["d"]))
        if "transform" in element.attrib and re.match(r"rotate\(-?0 ", element.attrib["transform"]):
            del element.attrib["transform"]
        for name, digits in (("x", 1), ("y", 2)):
            if name in element.attrib:
                element.set(name, f"{float(element.attrib[name]):.{digits}f}".rstrip("0").rstrip("."))
    for element in root.iter():
        for name in ("href", "clip-path"):
            if match := re.search(r"#([\w-]+)", element.get(name, "")):
                short = ids.setdefault(match[1], f"f{number}-{len(ids)}")
                element.set(name, element.attrib[name].replace(match[0], f"#{short}"))
    for element in root.iter():
        if element.tag != "g" and (known := element.attrib.pop("id", "")) in ids:
            element.set("id", ids[known])


def _named(group: ET.Element) -> None:
    """Classes in place of ids: axes, data, words, ticks; data is clipped by its group and can move in it."""
    name = group.attrib.pop("id", "")
    if name.startswith(("xtick_", "ytick_")):
        group.set("class", name[0])
    elif re.match(r"(a\d+$|[kdtu]\d*-)", name):
        group.set("class", name.partition("-")[0])
    if name[:1] in "kd" and "-" in name:
        clip = next(filter(None, [child.attrib.pop("clip-path", "") for child in group.iter()]), "")
        moving = ET.Element("g", {"class": "m"})
        moving.extend(list(group))
        for child in list(group):
            group.remove(child)
        group.append(moving)
        if clip:
            group.set("clip-path", clip)


def _flatten(element: ET.Element) -> None:
    """Groups that say nothing give way to what they hold; what all of a group look like, the group does."""
    children: list[ET.Element] = []
    for child in element:
        _flatten(child)
        children.extend(child if child.tag == "g" and not child.attrib else [child])
    element[:] = children
    looks = {child.get("class") for child in element if child.tag == "use"}
    alike = len(children) > 2 and len(looks) == 1 and None not in looks
    if element.tag == "g" and alike and all(child.tag in ("use", "defs") for child in element):
        element.set("class", f"{element.get('class', '')} {looks.pop()}".strip())
        for child in element:
            child.attrib.pop("class", None)


def _minor_ticks_together(group: ET.Element, marks: dict[str | None, ET.Element]) -> None:
    """Minor ticks of an axis as one path: a third of their size, and there are a hundred in a picture."""
    many = group.find("g")
    if many is None or group.get("class") not in ("x", "y"):
        return
    mark = marks[many[0].attrib["href"][1:]]
    steps = (f"M{tick.get('x')} {tick.get('y')}{mark.attrib['d'].removeprefix('m0 0')}" for tick in many)
    look = f"{many.get('class', '')} {mark.get('class', '')}"
    # A tick that stands alone elsewhere may use the same mark.
    group[:] = [*group.findall("defs"), ET.Element("path", {"class": look, "d": "".join(steps)})]


def _samples(legend: ET.Element) -> Iterator[Markup]:
    """What stands before each of the legend's words, as a picture of its own."""
    parts: list[ET.Element] = []
    for group in legend.iter():
        if group.tag == "text":
            left = float(group.get("x", 0)) - _SAMPLE - _GAP
            top = float(group.get("y", 0)) - 0.8 * _HEIGHT
            box = f"{left - 1:.1f} {top:.1f} {_SAMPLE + 2:.1f} {_HEIGHT:.1f}"
            svg = ET.Element("svg", {"viewBox": box, "aria-hidden": "true"})
            svg.extend(parts)
            yield Markup(_text(svg))
            parts = []
        elif (
            group.tag == "g" and group is not legend and any(c.tag in ("path", "use", "defs") for c in group)
        ):
            parts.extend(group)


def _text(element: ET.Element) -> str:
    return ET.tostring(element, encoding="unicode").replace(" />", "/>")


def relative(path: str) -> str:
    """A path of absolute M, L, Q, C, z with relative steps, half as long: 0.1 units in x, 0.01 in y."""
    out: list[str] = []
    at = start = (0, 0)
    for command, text in re.findall(r"([MLQCz])([^MLQCz]*)", path):
        if command == "z":
            out.append("z")
            at = start
            continue
        values = [round(100 * float(value)) for value in text.split()]
        points = [(10 * round(x / 10), y) for x, y in zip(values[::2], values[1::2], strict=True)]
        steps = [_short(value - old) for point in points for value, old in zip(point, at, strict=True)]
        out.append(command.lower() + " ".join(steps).replace(" -", "-"))
        at = points[-1]
        if command == "M":
            start = at
    return "".join(out)


@lru_cache(maxsize=10_000)
def _short(hundredths: int) -> str:
    text = f"{hundredths / 100:.2f}".rstrip("0").rstrip(".")
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else "0" if text == "-0" else text
