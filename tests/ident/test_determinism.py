"""The same input gives the same bytes, whatever ran before in the process and whichever process compiled."""

import hashlib
import importlib
import json
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numba.core.dispatcher
import numba.core.types
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import ident
from ident import IdentOptions, identify
from ident.data.arrays import kernel_array
from ident.several_outputs import identify_mimo
from ident.uncertainty.embedding import tangent
from tests.ident.benchmark_plants import p1, p1_friction, p2, p3

FOURTH_ORDER = IdentOptions(n_real=2, n_pairs=1)


def numbers(result):
    """Poles and coefficients as JSON, every digit of them."""
    model = result.model
    return json.dumps(
        {
            "real": model.poles.real.tolist(),
            "pairs": [[pole.real, pole.imag] for pole in model.poles.pairs.tolist()],
            "coefficients": model.coefficients.tolist(),
        }
    )


def the_fits():
    """JSON of a fit of given order and of one whose order the data choose, with its posterior.

    On one BLAS thread, as runs have it: two add up in another order, and move the posterior's last digit.
    """
    with threadpool_limits(1):
        first = identify([p1(3).record], FOURTH_ORDER)
        record = p3(3, 0, 40).record
        second = identify([record])
        posterior = tangent([record], second.model)
    return [numbers(first), numbers(second), json.dumps([posterior.mean.tolist()])]


def everything_else():
    """Fits of many kinds: records in pieces, known structure, fixed poles, several inputs, other searches."""
    truth = p2(1, 3000)
    pieces = [truth.record.slice(1000, 2000), truth.record.slice(2000, 3000)]
    known = p1(0).record
    for records, options in (
        (pieces, IdentOptions(n_real=2, n_pairs=2)),
        (pieces[:1], IdentOptions(n_real=1, n_pairs=1, estimate_initial_state=True)),
        ([known], IdentOptions(n_real=0, n_pairs=1, integrators=2, relative_degree=2)),
        ([known], IdentOptions(n_real=1, n_pairs=1, fixed_poles=((0.9999, 0.0),), feedthrough=True)),
        ([known], IdentOptions(n_real=2, n_pairs=1, algorithm="GN_DIRECT_L", coordinates="raw")),
        ([p1_friction(1).record], IdentOptions(input_delay_samples=1)),
    ):
        result = identify(records, options)
        assert result.model.order > 0
        assert isinstance(result.warnings, tuple)
    tangent(records, result.model)
    identify_mimo([known], FOURTH_ORDER)


def in_a_fresh_process(cache, code):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    imports = "import json; from tests.ident.test_determinism import compiled, everything_else, the_fits; "
    run = subprocess.run(
        [sys.executable, "-c", imports + code],
        env=environment,
        capture_output=True,
        text=True,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert run.returncode == 0, run.stderr[-500:]
    return json.loads(run.stdout)


def assert_same(first, second, what):
    """No diff of long texts: only which of them differs."""
    for name, one, other in zip(("order 4", "order from data", "posterior"), first, second, strict=True):
        if hashlib.sha256(one.encode()).digest() != hashlib.sha256(other.encode()).digest():
            pytest.fail(f"{what}: {name} differs", pytrace=False)


@pytest.fixture(scope="module")
def fresh():
    """The fits of a fresh process, and what was compiled there."""
    code = "fits = the_fits(); everything_else(); print(json.dumps([fits, compiled()]))"
    return in_a_fresh_process(os.environ.get("NUMBA_CACHE_DIR", ""), code)


@pytest.mark.slow
def test_a_fit_in_a_used_process_is_that_of_a_fresh_one(fresh):
    """There they came first."""
    everything_else()
    assert_same(the_fits(), fresh[0], "this process against a fresh one")


@pytest.mark.long
def test_fits_do_not_depend_on_who_compiled(fresh, tmp_path):
    """The fresh process does these fits first and finds everything compiled; here everything is compiled
    anew, for other fits before them."""
    others_first = in_a_fresh_process(tmp_path, "everything_else(); print(json.dumps(the_fits()))")
    assert_same(fresh[0], others_first, "compiled by others")


def compiled():
    """Compilations in this process: [module.kernel, how many, how many of them for locked arrays]."""
    counts = []
    for module in pkgutil.walk_packages(ident.__path__, "ident."):
        for name, kernel in vars(importlib.import_module(module.name)).items():
            if isinstance(kernel, numba.core.dispatcher.Dispatcher):
                locked = [
                    any(isinstance(kind, numba.core.types.Array) and not kind.mutable for kind in signature)
                    for signature in kernel.signatures
                ]
                counts.append((f"{module.name.rpartition('.')[2]}.{name}", len(locked), sum(locked)))
    return counts


@pytest.mark.slow
def test_kernels_are_compiled_once_for_one_kind_of_array(fresh):
    """No locked array reaches compiled code: it would be another type there, and another compilation."""
    compilations = fresh[1]
    assert [name for name, _, locked in compilations if locked] == []
    count = {name: number for name, number, _ in compilations}
    for entry in (
        "functions.blocks_of_poles",
        "kernels.cost_of_point",
        "kernels.linearise",
        "coordinates.blocks_of_point",
        "pole_unknowns.scaled_system",
        "pole_unknowns.damped_step",
    ):
        assert count[entry] == 1, f"{entry}: {count[entry]} compilations"


def test_kernel_arrays():
    array = np.arange(6.0).reshape(2, 3)
    assert kernel_array(array) is array
    locked = array.copy()
    locked.setflags(write=False)
    for other in (locked, array.T, array[:, ::2]):
        usable = kernel_array(other)
        assert usable.flags.writeable
        assert usable.flags.c_contiguous
        np.testing.assert_array_equal(usable, other)
