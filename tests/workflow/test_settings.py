"""TOML errors: one line with the file, the dotted key as the user wrote it, and what was expected."""

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from workflow.config.settings import InputPath, check, expand
from workflow.engine.documents import read_toml
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
