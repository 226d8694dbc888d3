"""Files spoilt at random: by hand, by a failing disk, by a program with other ideas of the format."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

Mutation = Callable[[np.random.Generator, str], str]

_VALUE = re.compile(r'"(?:[^"\\\n]|\\.)*"|\b(?:true|false|null)\b|-?\b\d[\d_.eE+-]*')
_NAME = re.compile(r'"?[A-Za-z_$][\w.$]*"?(?=\s*[=:])')
_DEEP = 500
VALUES = (
    *("nan", "inf", "-inf", "NaN", "Infinity", "null", "true", "{}", "[]", '""', "1979-05-27", "0x10"),
    *("-1", "0", "0.0", "1", "1e308", "-1e308", "1e-308", "1e999", "1e5", "1000001", str(2**63), str(10**30)),
    *("9" * 4301, "0." + "1" * 5000, '"' + "x" * 5000 + '"', '"\\u0000"', '"../../etc/passwd"', '"nan"'),
    *("[" * _DEEP + "]" * _DEEP, '{"a":' * _DEEP + "1" + "}" * _DEEP, "{ a = " * _DEEP + "1" + " }" * _DEEP),
    *("[" + "1, " * 3000 + "1]", '["a", 1]', "[[1, 2], [3]]", "[1e308, 1e308]", '{"$float": "x"}', '"=1+1"'),
    *('{"$array": "y"}', '{"$complex": [1]}', '"' + "é\u202e" * 100 + '"'),
)
NAMES = ("x", "kind", "$type", '""', '"' + "k" * 3000 + '"', "a." * _DEEP + "b", "format", "_result", "dt_s")
CHARACTERS = '\x00\ufeffé\u202e"[]{}=,\\\n\r#-+.:1eE '


def _span(rng: np.random.Generator, text: str) -> slice:
    start = int(rng.integers(len(text) + 1))
    return slice(start, start + int(rng.integers(1, 60)))


def _cut(rng: np.random.Generator, text: str) -> str:
    return text[: int(rng.integers(len(text) + 1))]


def _without_span(rng: np.random.Generator, text: str) -> str:
    at = _span(rng, text)
    return text[: at.start] + text[at.stop :]


def _span_twice(rng: np.random.Generator, text: str) -> str:
    at = _span(rng, text)
    return text[: at.stop] + text[at.start :]


def _other_character(rng: np.random.Generator, text: str) -> str:
    at = int(rng.integers(len(text) + 1))
    return text[:at] + CHARACTERS[int(rng.integers(len(CHARACTERS)))] + text[at + int(rng.integers(2)) :]


def _without_line(rng: np.random.Generator, text: str) -> str:
    lines = text.split("\n")
    del lines[int(rng.integers(len(lines)))]
    return "\n".join(lines)


def _lines_swapped(rng: np.random.Generator, text: str) -> str:
    lines = text.split("\n")
    i, j = rng.integers(len(lines), size=2).tolist()
    lines[i], lines[j] = lines[j], lines[i]
    return "\n".join(lines)


def _line_twice(rng: np.random.Generator, text: str) -> str:
    lines = text.split("\n")
    at = int(rng.integers(len(lines)))
    return "\n".join([*lines[:at], lines[at], *lines[at:]])


def _replaced(pattern: re.Pattern[str], others: tuple[str, ...]) -> Mutation:
    def mutate(rng: np.random.Generator, text: str) -> str:
        places = list(pattern.finditer(text))
        if not places:
            return text + others[0]
        found = places[int(rng.integers(len(places)))]
        return text[: found.start()] + others[int(rng.integers(len(others)))] + text[found.end() :]

    return mutate


def _scaled(rng: np.random.Generator, text: str) -> str:
    """A number that is one still, of another size or sign."""
    places = list(re.finditer(r"-?\b\d+(?:\.\d+)?\b", text))
    if not places:
        return text
    found = places[int(rng.integers(len(places)))]
    factor = float(rng.choice([-1.0, 0.0, 10.0, 1e3, 1e6, 1e-3, 1e-6]))
    number = float(found.group()) * factor
    return (
        text[: found.start()]
        + (str(int(number)) if "." not in found.group() else repr(number))
        + text[found.end() :]
    )


_other_value, _other_name = _replaced(_VALUE, VALUES), _replaced(_NAME, NAMES)
# A value is what people change; syntax is caught by the parsers.
MUTATIONS: tuple[Mutation, ...] = (
    *(_cut, _without_span, _span_twice, _other_character, _without_line, _lines_swapped, _line_twice),
    *(_other_value, _other_value, _other_value, _other_value, _scaled, _scaled, _other_name),
)


def spoilt(rng: np.random.Generator, text: str) -> bytes:
    """One to three mutations of a text."""
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        text = MUTATIONS[int(rng.integers(len(MUTATIONS)))](rng, text)
    content = text.encode("utf-8", "surrogatepass")
    return content + b"\xff\xfe" if rng.random() < 0.02 else content


def tamper(rng: np.random.Generator, folder: Path) -> str:
    """Something in a folder deleted, cut, spoilt or exchanged; says what."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[int(rng.integers(len(files)))]
    name, content, how = path.relative_to(folder).as_posix(), path.read_bytes(), int(rng.integers(8))
    if how == 0:
        path.unlink()
    elif how == 1:
        path.write_bytes(content[: int(rng.integers(len(content) + 1))])
    elif how == 2:
        at = int(rng.integers(len(content) + 1))
        path.write_bytes(content[:at] + bytes([int(rng.integers(256))]) + content[at + 1 :])
    elif how == 3:
        path.unlink()
        path.mkdir()
    elif how == 4:
        other = files[int(rng.integers(len(files)))]
        shutil.copyfile(other, path) if other != path else path.unlink()
    elif how == 5 and path.parent != folder:
        shutil.rmtree(path.parent)
    elif b"\x00" in content:
        path.write_bytes(rng.integers(256, size=200, dtype=np.uint8).tobytes())
    else:
        path.write_bytes(spoilt(rng, content.decode("utf-8", "replace")))
    return f"{name} ({how})"
