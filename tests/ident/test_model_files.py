"""Models in files: bit-identical both ways, readable by others, damaged ones refused in one line."""

import json

import control
import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings, strategies as st

from ident import GobfModel, Poles
from ident.basis.model_files import FORMAT, ModelFile
from ident.data.frequency_uncertainty import FrequencyUncertainty
from tests.workflow.test_codec import same

numbers = st.floats(-1e6, 1e6)
inside = st.floats(-0.99, 0.99)
upper = st.tuples(st.floats(1e-3, 0.999), st.floats(1e-3, 3.1)).map(lambda p: p[0] * np.exp(1j * p[1]))


@st.composite
def models(draw):
    poles = Poles(
        np.array(draw(st.lists(inside, max_size=3)), dtype=float),
        np.array(draw(st.lists(upper, max_size=3)), dtype=complex),
    )
    return GobfModel(
        poles,
        np.array(draw(st.lists(numbers, min_size=poles.order, max_size=poles.order)), dtype=float),
        draw(st.floats(1e-6, 10)),
        feedthrough=draw(numbers),
        integrators=draw(st.integers(0, 2)),
        input_delay_samples=draw(st.integers(0, 3)),
        input_name=draw(st.sampled_from(["u", "", "voltage V", "Δθ [rad]"])),
        output_name="y",
    )


def example():
    poles = Poles.from_continuous(decay_per_s=[3.0], omega_rad_s=[15.0, 70.0], zeta=[0.01, 0.2], dt_s=0.005)
    return GobfModel(poles, [0.1, -0.2, 1 / 3, np.pi, -0.0], 0.005, 0.25, 1, 2, "voltage_V", "hub_rad")


def ellipses(dt_s=0.005):
    omega = np.geomspace(0.3, 600.0, 40)
    factor = np.random.default_rng(0).normal(size=(40, 2, 2))
    return FrequencyUncertainty(
        omega, np.exp(1j * omega) / 3, factor @ factor.transpose(0, 2, 1), dt_s, 0.99, "tangent"
    )


@settings(max_examples=60)
@given(model=models())
def test_json_keeps_every_bit(model):
    assert same(model, ModelFile.from_json(ModelFile(model).to_json()).model)


@settings(max_examples=2)  # each is read by a process of its own
@given(model=models())
def test_mat_keeps_every_bit(model):
    assert same(model, ModelFile.from_mat(ModelFile(model).to_mat()).model)


def test_ellipses_go_along():
    file = ModelFile(example(), ellipses())
    for again in (ModelFile.from_json(file.to_json()), ModelFile.from_mat(file.to_mat())):
        assert same(file.model, again.model)
        assert same(ellipses(), again.ellipses)
    assert ModelFile.from_mat(ModelFile(example()).to_mat()).ellipses is None
    with pytest.raises(ValueError, match="dt_s"):
        ModelFile(example(), ellipses(dt_s=0.004))


def test_equal_models_give_equal_files():
    assert ModelFile(example(), ellipses()).to_mat() == ModelFile(example(), ellipses()).to_mat()


def test_matlab_finds_what_it_needs(tmp_path):
    """Plain variables of class double, column vectors, char: what `load` and `ss` take as they are."""
    path = tmp_path / "model.mat"
    path.write_bytes(ModelFile(example(), ellipses()).to_mat())
    classes = {name: kind for name, _, kind in scipy.io.whosmat(path)}
    assert {classes[name] for name in ("A", "B", "C", "D", "dt_s", "poles_real", "poles_pairs")} == {"double"}
    assert classes["input_name"] == classes["format"] == "char"
    assert classes["ellipses"] == "struct"
    assert all(name.isidentifier() and name[0].isalpha() and len(name) < 32 for name in classes)
    m = scipy.io.loadmat(path)
    assert m["coefficients"].shape == (5, 1)
    omega = np.geomspace(0.1, 600, 50)
    there = control.ss(m["A"], m["B"], m["C"], m["D"], m["dt_s"].item())(np.exp(1j * omega * 0.005))
    np.testing.assert_allclose(there, example().frequency_response(omega), rtol=1e-9)


def test_json_is_for_others_to_read():
    document = json.loads(ModelFile(example()).to_json())
    assert document["format"] == FORMAT
    assert document["format_version"] == 1
    assert np.array(document["A"]).shape == (8, 8)  # two samples of delay, one integrator, five basis states
    assert document["poles_pairs"][0] == [example().poles.pairs[0].real, example().poles.pairs[0].imag]


def changed(**fields):
    return json.dumps(json.loads(ModelFile(example(), ellipses()).to_json()) | fields)


def without(name):
    document = json.loads(ModelFile(example()).to_json())
    del document[name]
    return json.dumps(document)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON .Expecting value: line 1 column 1"),
        (ModelFile(example()).to_json()[:300], "not JSON"),
        ("[1, 2]", "expected a JSON object, found list"),
        ("{}", "'format' is missing"),
        (changed(format="something else"), "'format' is 'something else'"),
        (changed(format_version=2), "format_version is 2"),
        (without("dt_s"), "the field 'dt_s' is missing"),
        (without("A"), "the field 'A' is missing"),
        (changed(dt_s="0.005"), "'dt_s' must be a number"),
        (changed(dt_s=0.0), "dt_s must be positive"),
        (changed(coefficients=[1, 2]), "one coefficient per basis function"),
        (changed(coefficients=[1, [2, 3], 4, 5, 6]), "'coefficients' must be an array of numbers"),
        (changed(poles_real=[1.5]), "inside the unit circle"),
        (changed(poles_pairs=[0.5, 0.1]), "rows"),
        (changed(integrators=1.5), "whole number"),
        (changed(integrators=np.inf), "whole number"),
        (changed(input_name=3), "'input_name' must be text"),
        (changed(D=[[7.0]]), "'D' is not the state matrix"),
        (changed(A=[[1.0]]), "'A' is not the state matrix"),
        (changed(ellipses=3), "'ellipses' must hold fields"),
        (changed(ellipses={"level": 0.9}), "'omega_rad_s' is missing"),
    ],
)
def test_damaged_json_is_one_line(text, message):
    with pytest.raises(ValueError, match=message) as error:
        ModelFile.from_json(text, "model.json")
    assert str(error.value).startswith("model.json")
    assert "\n" not in str(error.value)


def test_damaged_mat_is_one_line():
    whole = ModelFile(example()).to_mat()
    for content in (b"", whole[: len(whole) // 2]):
        with pytest.raises(ValueError, match=r"^model\.mat: ") as error:
            ModelFile.from_mat(content, "model.mat")
        assert "\n" not in str(error.value)
