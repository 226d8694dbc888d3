"""What a page shows before anything is unfolded: its height in screens, its words, and its first screen."""

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

from tests.browser import Browser

SCREEN = 800  # px
_WORDS = "document.body.innerText.split(/\\s+/).filter(word => /[\\p{L}\\d]/u.test(word)).length"
_FIRST = """(() => {
  const place = selector => document.querySelector(selector)?.getBoundingClientRect();
  const lines = document.querySelector(".headline");
  return {
    numbers: [...document.querySelectorAll(".numbers > div")].length,
    numbers_end: place(".numbers")?.bottom ?? 0,
    bullets: document.querySelectorAll(".bullets > li").length,
    picture: [...document.querySelectorAll(".plot > svg")].map(image => image.getBoundingClientRect())
      .filter(box => box.height).map(box => box.bottom)[0] ?? 1e9,
    headline: lines.getBoundingClientRect().height / parseFloat(getComputedStyle(lines).lineHeight),
  };
})()"""


def shape_faults(
    browser: Browser, path: Path, *, screens: float, words: int = 900, picture: bool = True, lines: int = 1
) -> list[str]:
    """What is too long, and what the first screen lacks, wide and narrow; what the page says twice."""
    found = []
    for width in (1280, 400):
        browser.open(path, width, SCREEN)
        first = browser.ask(_FIRST)
        if width == 1280:
            height, said = browser.ask("document.documentElement.scrollHeight") / SCREEN, browser.ask(_WORDS)
            if height > screens:
                found.append(f"{height:.1f} screens, at most {screens}")
            if said > words:
                found.append(f"{said} words, at most {words}")
            if round(first["headline"]) > lines:
                found.append(f"the verdict takes more than {lines} lines")
        if picture and first["picture"] > SCREEN:
            found.append(f"{width} px: the picture ends {first['picture']:.0f} px down")
        if not 0 < first["numbers_end"] <= SCREEN or first["numbers"] > 5:
            found.append(f"{width} px: {first['numbers']} numbers down to {first['numbers_end']:.0f} px")
        if not 0 < first["bullets"] <= 5:
            found.append(f"{first['bullets']} bullets")
    return found + [f"said twice: {sentence}" for sentence in said_twice(path.read_text(encoding="utf-8"))]


_NOT_PROSE = ("script", "style", "svg", "pre", "table", "figcaption", "h1", "h2", "h3", "dl")


class _Blocks(HTMLParser):
    """Text of paragraphs and items, folded ones too; not of tables, captions, pictures and code."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks: list[str] = [""]
        self._hidden = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._hidden += tag in _NOT_PROSE
        if tag in ("p", "li"):
            self.blocks.append("")

    def handle_endtag(self, tag: str) -> None:
        self._hidden -= tag in _NOT_PROSE

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.blocks[-1] += data


def said_twice(html: str) -> list[str]:
    """Sentences of six words or more that stand more than once on a page."""
    parser = _Blocks()
    parser.feed(html)
    blocks = (" ".join(block.split()) for block in parser.blocks)
    every = (sentence for block in blocks for sentence in re.split(r"(?<=[.;]) ", block))
    counts = Counter(sentence.strip(" .;:").lower() for sentence in every)
    return [sentence for sentence, times in counts.items() if times > 1 and len(sentence.split()) >= 6]
