"""The D-scaled bound against independent judges, the scalar ellipses and samples; certificate and margins."""

from dataclasses import replace
from functools import cache

import control
import numpy as np
import pytest

from benchmarks import mimo_problems as problems
from benchmarks.mimo_designs import DT_D, TS, plant_d, plant_t, specification_d, specification_t, tustin
from control_design import Controller, MultivariablePlant, ResponseBall, certify_multivariable
from control_design.plants import scaled_bound as bounds
from control_design.plants.ellipses import Ellipses, distance_to_minus_one
from control_design.plants.multivariable import tustin_s
from control_design.specification.multivariable import gram


@cache
def judged_t(name: str, ball: float = 1.0):
    """Judgement of a published controller of problem T, for the published ball or a larger one."""
    return problems.judge_t(*PUBLISHED[name](), ball=ball)


PUBLISHED = {"reference": problems.reference_t, "order six": problems.order_six_t}


def given(abcd) -> Controller:
    return Controller(*tustin(*abcd, TS), TS, computational_delay_samples=0)


@pytest.mark.long
def test_judges_give_the_published_values():
    at = np.array([2j / TS * np.tan(10 * TS / 2)])
    expected = [[-0.012486 - 0.004415j, 0.006810 + 0.005085j], [0.011351 + 0.008474j, -0.027103 - 0.012788j]]
    np.testing.assert_allclose(problems.nominal_t(at)[0], expected, atol=1e-6)
    li = problems.factor_t(at)[0]
    np.testing.assert_allclose((li.conj().T @ li)[0], [4.04395e-8, 0.812522e-8], rtol=2e-6)
    reference, six = judged_t("reference"), judged_t("order six")
    found = [reference.sensitivity, reference.effort, reference.nominal, six.sensitivity, six.effort]
    np.testing.assert_allclose(found, [1.2292, 1.2351, 1.2108, 0.9553, 0.9547], atol=6e-5)
    assert problems.judge_d(problems.inverse_d) == pytest.approx(5.782, abs=6e-4)


@pytest.mark.parametrize("ball", [1.0, pytest.param(3.0, marks=pytest.mark.long)])
def test_the_certificate_agrees_with_the_judge_of_the_ball(ball):
    for name, published in PUBLISHED.items():
        judged = judged_t(name, ball)
        certificate = certify_multivariable(given(published()), plant_t(ball), specification_t(6))
        verdict = certificate.verdicts[0]
        # Two grids, each within 3e-4 of the maximum between its points.
        assert verdict.worst["tracking"] == pytest.approx(judged.sensitivity, rel=4e-4)
        assert verdict.worst["effort"] == pytest.approx(judged.effort, rel=4e-4)
        assert verdict.proved
        assert verdict.winding.matches
        for name, worst in verdict.worst.items():
            assert worst < verdict.bounds[name] <= 1.0021 * worst


def test_several_blocks_agree_with_the_judge_of_the_column():
    omega = np.geomspace(1e-6, 100, 200)
    s = tustin_s(omega, DT_D)
    plant, specification = plant_d(), specification_d(2)
    G, seen, entering = plant.blocks(omega)
    K = problems.inverse_d(s)
    size = gram(specification.weights(2, 2)["tracking"][1], s)
    found = bounds.scaled_bound(bounds.BoundRows(G, seen, entering, size, 0 * size, True), K)
    assert np.max(found.gamma) == pytest.approx(5.782, abs=2e-3)


def random_rows(
    rng: np.random.Generator, count: int, u: int, y: int, blocks: int
) -> tuple[bounds.BoundRows, np.ndarray]:
    def draw(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    li, lo = 0.24 / u * draw(count, blocks, u, u), 0.24 / y * draw(count, blocks, y, y)
    weight = draw(count, y, y)
    rows = bounds.BoundRows(
        draw(count, y, u), np.conj(np.swapaxes(li, -1, -2)) @ li, lo @ np.conj(np.swapaxes(lo, -1, -2)),
        np.conj(np.swapaxes(weight, -1, -2)) @ weight, np.zeros((count, u, u)), False,
    )  # fmt: skip
    return rows, 0.3 * draw(count, u, y)


@pytest.mark.parametrize(("u", "y", "blocks"), [(2, 2, 1), (3, 2, 1), (2, 3, 2), (1, 1, 1), (4, 4, 2)])
def test_slopes_are_those_of_differences(u, y, blocks):
    rng = np.random.default_rng(5)
    rows, K = random_rows(rng, 40, u, y, blocks)
    bound = bounds.scaled_bound(rows, K, accuracy=1e-13)
    finite = np.isfinite(bound.gamma)
    assert np.mean(finite) > 0.5
    step = 1e-5 * (rng.standard_normal(K.shape) + 1j * rng.standard_normal(K.shape))
    ahead, behind = (
        np.log(bounds.scaled_bound(rows, K + sign * step, accuracy=1e-13).gamma) for sign in (1, -1)
    )
    good = finite & np.isfinite(ahead) & np.isfinite(behind)
    found = bounds.expansion(rows.part(good), K[good], bound.log_t[good])
    sizes, top = (each[..., -1:] for each in np.linalg.eigh(found.H))
    change = (bounds.conjugate(found.left @ top) @ step[good] @ found.right @ top)[:, 0, 0]
    # Third order: 1e-10 of a curvature of 1e2; a kink in the scalings spoils single rows.
    assert np.median(np.abs((ahead[good] - behind[good]) / 2 - change.real / sizes[:, 0])) < 1e-8


@pytest.mark.parametrize(("u", "y"), [(2, 2), (3, 2), (2, 3)])
def test_no_sample_of_the_ball_exceeds_the_bound_and_ascent_reaches_it(u, y):
    rng = np.random.default_rng(11)
    rows, K = random_rows(rng, 1, u, y, 1)
    rows = bounds.BoundRows(rows.G, rows.seen, rows.entering, rows.V_y, rows.V_u, False)
    bound = float(bounds.scaled_bound(rows, K).gamma[0])
    li, lo = np.linalg.cholesky(rows.seen[0, 0]).conj().T, np.linalg.cholesky(rows.entering[0, 0])
    weight = np.linalg.cholesky(rows.V_y[0]).conj().T

    def gain(delta: np.ndarray) -> float:
        loop = np.eye(y) + (rows.G[0] + lo @ delta @ li) @ K[0]
        return float(np.linalg.norm(weight @ np.linalg.inv(loop), 2))

    def unit(delta: np.ndarray) -> np.ndarray:
        return delta / np.linalg.norm(delta)

    best, at = 0.0, None
    for _ in range(2000):
        delta = unit(rng.standard_normal((y, u)) + 1j * rng.standard_normal((y, u)))
        if gain(delta) > best:
            best, at = gain(delta), delta
    width = 0.3
    for _ in range(3000):
        delta = unit(at + width * (rng.standard_normal((y, u)) + 1j * rng.standard_normal((y, u))))
        if gain(delta) > best:
            best, at = gain(delta), delta
        else:
            width = max(0.995 * width, 1e-4)
    assert best <= bound * (1 + 1e-9)
    assert best > 0.999 * bound


def test_one_loop_is_that_of_circular_ellipses():
    rng = np.random.default_rng(3)
    count = 200
    G, K = (rng.standard_normal(count) + 1j * rng.standard_normal(count) for _ in range(2))
    radius = 10 ** rng.uniform(-2, 0, count)
    ellipses = Ellipses(np.arange(1.0, count + 1), G, radius, radius, np.ones(count, complex))
    distance = distance_to_minus_one(K, ellipses)
    one = np.ones((count, 1, 1))
    rows = bounds.BoundRows(
        G[:, None, None], radius[:, None, None, None] ** 2 * one[:, None], one[:, None] + 0j, one, 0 * one,
        False,
    )  # fmt: skip
    gamma = bounds.scaled_bound(rows, K[:, None, None]).gamma
    away = distance > 0
    assert 0.3 < np.mean(away) < 1.0
    np.testing.assert_allclose(gamma[away], 1 / distance[away], rtol=1e-6)
    assert np.all(np.isinf(gamma[~away]))


def test_the_smallest_destabilising_member_lies_at_the_predicted_radius():
    rng = np.random.default_rng(2)
    rows, K = random_rows(rng, 20, 2, 2, 1)
    mu = bounds.stability_bound(rows, K)
    for r in range(20):
        li, lo = np.linalg.cholesky(rows.seen[r, 0]).conj().T, np.linalg.cholesky(rows.entering[r, 0])
        seen = li @ K[r] @ np.linalg.inv(np.eye(2) + rows.G[r] @ K[r]) @ lo
        left, sizes, right = np.linalg.svd(seen)
        delta = -np.outer(right[0].conj(), left[:, 0].conj()) / sizes[0]
        assert abs(np.linalg.det(np.eye(2) + (rows.G[r] + lo @ delta @ li) @ K[r])) < 1e-9
        assert 1 / mu[r] == pytest.approx(np.linalg.norm(delta), rel=1e-6)


def test_a_certificate_begins_where_the_ball_does():
    plant, controller = plant_t(), given(problems.order_six_t())
    plant = replace(plant, ball=replace(plant.ball, lowest_rad_s=0.3))
    verdict = certify_multivariable(controller, plant, specification_t(6)).verdicts[0]
    assert (verdict.from_rad_s, verdict.proved) == (0.3, True)


def test_structured_norms_and_disk_margins():
    rng = np.random.default_rng(8)
    M = rng.standard_normal((50, 2, 2)) + 1j * rng.standard_normal((50, 2, 2))
    found = bounds.structured_norm(M)
    t = np.exp(np.linspace(-8, 8, 4001))
    scaled = M[:, None] * np.array([[[[1, 1], [1, 1]]]]) + 0
    scaled = np.repeat(scaled, t.size, axis=1)
    scaled[:, :, 0, 1] *= t
    scaled[:, :, 1, 0] /= t
    np.testing.assert_allclose(found, np.min(np.linalg.norm(scaled, 2, axis=(2, 3)), axis=1), rtol=1e-4)
    margins = certify_multivariable(given(problems.order_six_t()), plant_t(), specification_t(6)).verdicts[0]
    for disk in (margins.input_disk, margins.output_disk):
        assert 0 < disk.alpha <= min(disk.loops)


def test_an_unstable_loop_is_told():
    a, b, c, d = problems.reference_t()
    verdict = certify_multivariable(given((a, b, 60 * c, d)), plant_t(), specification_t(6)).verdicts[0]
    assert not verdict.stable
    assert not verdict.winding.matches
    assert not verdict.proved


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"Lo": np.eye(3)}, "rows"),
        ({"radius": 0.0}, "radius"),
        ({"Li": np.ones((3, 2, 2)), "omega_rad_s": np.array([1.0, 3.0, 2.0])}, "ascending"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, message):
    ball = {"Lo": np.eye(2), "Li": np.ones((3, 2, 2)), "radius": 1.0, "omega_rad_s": np.arange(1.0, 4.0)}
    nominal = control.ss(0.5 * np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), 0.01)
    with pytest.raises(ValueError, match=message):
        MultivariablePlant("p", nominal, ResponseBall(**{**ball, **change}))


def test_a_ball_on_its_own_frequencies_is_certified_there_only():
    omega = np.geomspace(0.1, 300, 80)
    nominal = control.ss(0.9 * np.eye(2), 0.1 * np.eye(2), np.eye(2), np.zeros((2, 2)), 0.01)
    ball = ResponseBall(np.eye(2), 0.01 * np.ones((80, 2, 2)), 1.0, omega)
    specification = specification_t(0)
    verdict = certify_multivariable(
        Controller(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2), 0.01, 0),
        MultivariablePlant("p", nominal, ball), specification,
    ).verdicts[0]  # fmt: skip
    assert verdict.stable
    assert verdict.frequencies == 80
    assert not verdict.proved
    assert "own frequencies" in verdict.obstacle


def test_a_controller_of_another_period_is_refused_however_short_the_period_is():
    law = given(PUBLISHED["order six"]())
    with pytest.raises(ValueError, match="at dt"):
        certify_multivariable(replace(law, dt_s=law.dt_s * (1 + 1e-6)), plant_t(1.0), specification_t(6))
