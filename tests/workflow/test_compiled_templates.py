"""Compiled templates are kept between processes, and count only while they are what would be compiled."""

import sys

import pytest
from jinja2 import DictLoader, Environment

from workflow.text.templates import CompiledTemplates


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return tmp_path


def said(source, **values):
    environment = Environment(loader=DictLoader({"page": source}), bytecode_cache=CompiledTemplates())
    return environment.get_template("page").render(**values)


def kept(folder):
    return list(folder.rglob("*.template"))


def test_a_template_is_compiled_once(folder, monkeypatch):
    assert said("{{ a }} m", a=1) == "1 m"
    assert len(kept(folder)) == 1
    monkeypatch.setattr(Environment, "compile", lambda *_, **__: pytest.fail("compiled again"))
    assert said("{{ a }} m", a=2) == "2 m"


def test_another_text_is_another_template(folder):
    assert (said("{{ a }} m", a=1), said("{{ a }} s", a=1)) == ("1 m", "1 s")
    assert len(kept(folder)) == 1


@pytest.mark.parametrize(
    "damage", [lambda b: b"", lambda b: b[:-7], lambda b: b[:-1] + b"\0", lambda b: b * 2]
)
def test_a_damaged_file_is_as_none(folder, damage):
    said("{{ a }} m", a=1)
    path = kept(folder)[0]
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert said("{{ a }} m", a=1) == "1 m"
    assert path.read_bytes() == whole


def test_nothing_is_kept_where_nothing_can_be_written(folder):
    (folder / "a file").touch()
    sys.pycache_prefix = str(folder / "a file")
    assert said("{{ a }} m", a=1) == "1 m"
    assert not kept(folder)


def test_a_filter_that_changed_is_asked_again(folder):
    """Of a constant it is asked when the template is compiled."""
    for unit in "mk":
        (folder / "filters.py").write_text(unit)
        made = Environment(
            loader=DictLoader({"page": "{{ 1|with_unit }}"}), bytecode_cache=CompiledTemplates(folder)
        )
        made.filters["with_unit"] = f"{{}} {unit}".format
        assert made.get_template("page").render() == f"1 {unit}"
