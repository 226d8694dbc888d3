"""Logs of one set whose columns are in different units: one unit, and a word of it, or a refusal."""

import numpy as np
import pytest

import flexlink
from ident.data.finding import FindingKind
from ident.data.record import Record, in_one_unit

N, DT_S = 400, 0.005
U = np.repeat(np.random.default_rng(3).choice([-2.0, 2.0], N // 4), 4)
Y = 0.05 * np.convolve(U, np.r_[0, 0.3 * 0.7 ** np.arange(N)])[:N] + 1e-4 * np.random.default_rng(
    4
).standard_normal(N)


def written(folder, name, units=("V", "rad"), sizes=(1.0, 1.0), reference=None):
    """Where a file has a reference it is in its own unit: (unit, size)."""
    unit, size = reference or ("", 1.0)
    rows = (
        f"{DT_S * k:.3f},{u / sizes[0]:.9g},{y / sizes[1]:.9g},{u / size:.9g}"
        for k, (u, y) in enumerate(zip(U, Y, strict=True))
    )
    path = folder / name
    path.write_text("\n".join(["time,voltage,angle,wish", ",".join(["s", *units, unit]), *rows]) + "\n")
    return path


def read(path, **more):
    return Record.from_file(path, ["voltage"], ["angle"], time="time", **more)


@pytest.mark.parametrize(
    ("units", "sizes", "said"),
    [
        (("V", "deg"), (1, np.pi / 180), {"angle"}),
        (("mV", "rad"), (1e-3, 1), {"voltage"}),
        (("kV", "rev"), (1e3, 2 * np.pi), {"angle", "voltage"}),
        (("Volts", "mrad"), (1, 1e-3), {"angle"}),
        (("V", ""), (1, 1), set()),
        (("V", "radians"), (1, 1), set()),
    ],
)
def test_records_of_one_set_are_in_the_unit_of_the_first(tmp_path, units, sizes, said):
    first = read(written(tmp_path, "a.csv"))
    one, other = in_one_unit([first, read(written(tmp_path, "b.csv", units, sizes))])
    assert one is first
    np.testing.assert_allclose(other.input, one.input, rtol=1e-7)
    np.testing.assert_allclose(other.output, one.output, rtol=1e-7, atol=1e-12)
    notes = [note for note in other.notes if note.kind is FindingKind.UNIT_CONVERTED]
    assert {note.values["name"] for note in notes} == said
    assert in_one_unit([one, other]) == [one, other]


def test_a_reference_is_converted_with_its_output(tmp_path):
    loop = {"references": ["wish"]}
    first = read(written(tmp_path, "a.csv", reference=("rad", 1.0)), **loop)
    turned = written(tmp_path, "b.csv", ("V", "deg"), (1, np.pi / 180), ("deg", np.pi / 180))
    other = in_one_unit([first, read(turned, **loop)])[1]
    np.testing.assert_allclose(other.reference, first.reference, rtol=1e-7)
    assert other.output_units == ("rad",)


@pytest.mark.parametrize(("unit", "more"), [("counts", {}), ("ell", {}), ("deg", {"scale": {"angle": 2.0}})])
def test_units_of_two_quantities_or_one_scale_for_two_are_refused(tmp_path, unit, more):
    records = [read(written(tmp_path, f"{own}.csv", ("V", own)), **more) for own in ("rad", unit)]
    with pytest.raises(ValueError, match=rf"{unit}.csv: 'angle' is in .*{unit}, in \S*rad.csv in .*rad"):
        in_one_unit(records)
    with pytest.raises(ValueError, match="'angle' is in"):
        flexlink.identify(records, n_pairs=0, n_real=1)
    stated = [
        read(written(tmp_path, f"{own}.csv", ("V", own)), units={"angle": "rad"}) for own in ("rad", unit)
    ]
    assert in_one_unit(stated) == stated


def test_commands_read_all_logs_in_one_unit(tmp_path, flexlink, refused):
    """Also those for validation, and the limit of the input is in the unit of the first."""
    a, b = written(tmp_path, "a.csv"), written(tmp_path, "b.csv", ("mV", "deg"), (1e-3, np.pi / 180))
    c = written(tmp_path, "c.csv", ("V", "counts"))
    named = ("--input", "voltage", "--output", "angle", "--time", "time", "--real", "1", "--pairs", "0")
    answer = flexlink("identify", a, "--validation", b, *named, "--input-limit", "1.5", "--json")
    assert "b.csv: 'voltage' is in mV, in the first log in V" in answer.out
    assert answer.out.count('"input_cut_samples": 400') == 2
    assert "'angle' is in counts" in refused("identify", a, "--validation", c, *named)
    assert "'angle' is in counts" in refused("init", a, c, "--out", tmp_path / "new.toml")
    configuration = tmp_path / "run.toml"
    records = "".join(
        f'[[source.records]]\npath = "{log.name}"\nrole = "{role}"\n'
        for log, role in ((a, "estimation"), (c, "validation"))
    )
    configuration.write_text(
        f'[source]\nkind = "files"\ntime = "time"\n{records}'
        '[[channels]]\ninput = "voltage"\noutput = "angle"\n'
        "[specification]\nbandwidth_rad_s = 4.0\n"
    )
    assert "'angle' is in counts" in refused("run", "--config", configuration, "--out", tmp_path / "out")
