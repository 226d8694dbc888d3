"""TOML errors: one line with the file, the dotted key as the user wrote it, and what was expected."""

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from ident.basis.options import IdentOptions
from plant import paper_link
from plant.rig import Rig
from workflow.config.settings import InputPath, check, expand
from workflow.engine.documents import read_json, read_toml
from workflow.engine.errors import InputError


class Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Options(Strict):
    level: float = Field(0.95, gt=0, lt=1)
    wide: bool = False


class FromFiles(Strict):
    kind: Literal["files"]
    path: InputPath


class Simulated(Strict):
    kind: Literal["simulated"]
    bandwidth_rad_s: float = 1.0


class Channel(Strict):
    input: str
    options: Options = Options()


class Config(Strict):
    source: Annotated[FromFiles | Simulated, Field(discriminator="kind")]
    channels: tuple[Channel, ...] = ()


def source(**keys):
    return {"source": {"kind": "simulated", **keys}}


def channels(*given):
    return source() | {"channels": list(given)}


def options(**keys):
    return channels({"input": "u", "options": keys})


NO_NUMBER, LEVEL = "input should be a valid number, got", "channels[0].options.level: input should be"


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        (source(bandwith_rad_s=2), "unknown key source.bandwith_rad_s (did you mean bandwidth_rad_s?)"),
        (source() | {"zzz": 1}, "unknown key zzz (known keys: channels, source)"),
        (
            channels({"input": "u"}, {"inptu": "u"}),
            "unknown key channels[1].inptu (did you mean input?) (and 1 more)",
        ),
        (channels({}), "missing key channels[0].input"),
        ({}, "missing key source"),
        (channels({}, {}), "missing keys channels[0].input, channels[1].input"),
        (source(bandwidth_rad_s=True), f"source.bandwidth_rad_s: {NO_NUMBER} True"),
        (source(bandwidth_rad_s="fast"), f"source.bandwidth_rad_s: {NO_NUMBER} 'fast'"),
        (options(level="0.5"), f"channels[0].options.level: {NO_NUMBER} '0.5'"),
        (options(wide=1), "channels[0].options.wide: input should be a valid boolean, got 1"),
        ({"source": {}}, "missing key source.kind"),
        ({"source": {"kind": "wire"}}, "source.kind: expected one of 'files', 'simulated', got 'wire'"),
        (options(level=1.5), f"{LEVEL} less than 1, got 1.5"),
        (options(level=float("nan")), f"{LEVEL} a finite number, got nan"),
    ],
)
def test_first_complaint(document, expected):
    with pytest.raises(InputError) as caught:
        check(Config, document, source="arm.toml")
    assert str(caught.value) == f"arm.toml: {expected}"


def test_paths_are_relative_to_the_configuration_and_must_be_there(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("")
    found = check(FromFiles, {"kind": "files", "path": "log.csv"}, source="a", context={"base": tmp_path})
    assert found.path == tmp_path / "log.csv"
    with pytest.raises(InputError, match=r"a: path: no such file: .*missing\.csv"):
        check(FromFiles, {"kind": "files", "path": "missing.csv"}, source="a", context={"base": tmp_path})
    with pytest.raises(InputError, match="expected a file, found a directory"):
        check(FromFiles, {"kind": "files", "path": "."}, source="a", context={"base": tmp_path})
    gone = {"base": tmp_path, "may_be_gone": True}
    assert check(FromFiles, {"kind": "files", "path": "missing.csv"}, source="a", context=gone)


def test_environment_variables_are_expanded_or_named(tmp_path, monkeypatch):
    monkeypatch.setenv("FLEXLINK_DATA", str(tmp_path))
    assert expand("${FLEXLINK_DATA}/a.csv") == f"{tmp_path}/a.csv"
    monkeypatch.delenv("FLEXLINK_DATA")
    with pytest.raises(InputError, match="a: path: environment variable FLEXLINK_DATA is not set"):
        check(FromFiles, {"kind": "files", "path": "${FLEXLINK_DATA}/a.csv"}, source="a")


def test_toml_syntax_error_names_line_and_column(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text("[run]\nname = \n")
    with pytest.raises(InputError, match=r"arm\.toml: not valid TOML: .*line 2, column 8"):
        read_toml(path)


_DEEP = 60_000
_LONG = "1" * 5_000


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "[" * _DEEP, "nested deeper than 40 levels"),
        ("a.json", '{"a": ' * _DEEP + "1" + "}" * _DEEP, "nested deeper than 40 levels"),
        ("a.json", f'{{"A": [[{_LONG}]]}}', "4300 digits"),
        ("a.json", f'{{"A": [[{_LONG[:4000]}]]}}', "'A': an integer beyond 64 bits"),
        ("a.json", '{"A": "\\ud800"}', "'A': half a character of UTF-16"),
        ("a.json", '{"\\udfff": 1}', "half a character of UTF-16"),
        ("a.json", '{"a\\u0000": 1}', "a NUL character"),
        ("a.json", '{"a": 1, "a": 2}', "'a' is there twice"),
        ("a.json", "7", "expected a JSON object, found int"),
        ("a.toml", "a = " + "[" * 10_000, "nested deeper than 40 levels"),
        ("a.toml", f"a = {_LONG}", "4300 digits"),
        ("a.toml", "a = 0x" + "f" * 5_000, "'a': an integer beyond 64 bits, <int with too many digits>"),
        ("a.toml", "a = [0b" + "1" * 19_000 + "]", "'a': an integer beyond 64 bits"),
        ("a.toml", "a" + ".a" * 2_000 + " = 1", "nested deeper than 40 levels"),
    ],
)
def test_a_document_that_no_person_wrote_is_refused_in_one_line(tmp_path, refused, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    read = read_json if name == "a.json" else read_toml
    with pytest.raises(InputError) as error:
        read(path)
    assert words in str(error.value)
    # The same of a command that is given it as a plant, or as a configuration.
    command = ["run", "--config", path, "--out", tmp_path / "out"]
    if name == "a.json":
        command = ["design", path]
    assert words in refused(*command)


def test_a_number_of_too_many_digits_is_refused_in_one_line(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(paper_link().to_toml().replace("length_m = 1.0", "length_m = 0x" + "f" * 5_000))
    with pytest.raises(ValueError, match=r"rig\.toml: .*got a number of too many digits"):
        Rig.from_toml(path)
    with pytest.raises(ValueError, match=r"n_real: .*, got a number of too many digits"):
        IdentOptions(n_real=16**5_000)


def test_a_byte_order_mark_is_no_syntax_error(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_bytes(b"\xef\xbb\xbf[run]\nname = 'a'\n")
    assert read_toml(path)[1] == {"run": {"name": "a"}}


def test_unreadable_files_are_one_line(tmp_path):
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    (tmp_path / "log.lvm").touch()
    said = {"absent.toml": "No such file", "latin.toml": "not UTF-8", "log.lvm": "a log, not a TOML file"}
    for name, words in said.items():
        with pytest.raises(InputError, match=rf"{name}: {words}"):
            read_toml(tmp_path / name)
