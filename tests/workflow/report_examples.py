"""A small made-up arm and a whole run of it, as typed objects and stage files like a real run's."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from control_design.analysis.certificate import certify
from control_design.analysis.closed_loop import ClosedLoopTrajectory as LoopTrajectory, StepMetrics
from control_design.analysis.joint_coverage import JointCoverage
from control_design.controllers.controller import Controller
from control_design.convex.youla import PlantBracket, YoulaBracket
from control_design.plants.plant_set import PlantChannel, UncertainPlant
from control_design.synthesis.synthesis_result import BlockingPoint, Outcome, StartReport, SynthesisResult
from ident.basis.functions import basis_response
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.checks.prior_tests import NuisanceTest
from ident.checks.residual_tests import residual_tests
from ident.checks.validation import ScatterRow, fit_on_fresh_data
from ident.data.finding import FindingKind, finding
from ident.data.record import Record
from ident.one_input import Identification
from ident.search.order_selection import OrderStep
from ident.search.pole_search import PolishedMinimum, SearchStage, SearchTrace
from ident.stabilisation import Stabilisation
from ident.uncertainty import ResponsePosterior
from workflow.config.run_config import RunConfig
from workflow.engine.run_directory import RunDirectory
from workflow.tasks import closed_loop as closed_loop_stage, results as kept, uncertainty as uncertainty_stage
from workflow.tasks.identification import as_fitted
from workflow.tasks.loop_conditions import condition_run
from workflow.text.sentences.certificate import requirement
from workflow.text.sentences.design import outcome

DT_S = 0.01
INPUT = "voltage_V"


def model(output: str = "hub_angle_rad", *, input_name: str = INPUT) -> GobfModel:
    """A hub with one real pole, two lightly damped modes and an integrator."""
    poles = Poles.from_continuous(decay_per_s=[6.0], omega_rad_s=[14.0, 62.0], zeta=[0.05, 0.015], dt_s=DT_S)
    coefficients = np.array([0.02, 0.004, -0.006, 0.0005, 0.0003])
    return GobfModel(poles, coefficients, DT_S, integrators=1, input_name=input_name, output_name=output)


def posterior(of: GobfModel, relative: float = 0.01) -> ResponsePosterior:
    """The model as mean on its doubled basis (by projection on the circle), equal errors throughout."""
    doubled = of.poles.doubled()
    z = np.exp(1j * np.linspace(0.5, np.pi / DT_S, 600) * DT_S)
    rows, wanted = basis_response(doubled, z), basis_response(of.poles, z) @ of.coefficients
    stacked = np.vstack([rows.real, rows.imag])
    mean = np.linalg.lstsq(stacked, np.concatenate([wanted.real, wanted.imag]), rcond=None)[0]
    return ResponsePosterior(
        poles=doubled, mean=mean,
        covariance_factor=np.diag(np.full(mean.size, relative * float(np.abs(of.coefficients).min()))),
        dt_s=DT_S, fir_length=0, has_feedthrough=False, integrators=of.integrators, input_delay_samples=0,
        input_name=of.input_name, output_name=of.output_name,
    )  # fmt: skip


def record(models: list[GobfModel], name: str, seed: int) -> Record:
    """Square-wave excitation, outputs of the models with a little white noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 76), 12)[:900] * 2.0
    y = np.column_stack([m.simulate(u) for m in models])
    y = y + 0.02 * y.std(axis=0) * rng.standard_normal(y.shape)
    return Record(
        name=name, input=u[:, None], output=y, dt_s=DT_S, input_names=(models[0].input_name,),
        output_names=tuple(m.output_name for m in models), input_units=("V",),
        output_units=tuple("rad" if "rad" in m.output_name else "m" for m in models))  # fmt: skip


def identification(of: GobfModel, used: list[Record]) -> Identification:
    """What `identify` would return for this model, with a made-up search."""
    rng = np.random.default_rng(7)
    residuals = tuple(r.output[:, 0] - of.simulate(r.input[:, 0]) for r in used)
    rss = float(sum(e @ e for e in residuals))
    points = np.column_stack([rng.uniform(0.3, 2.3, 120), rng.uniform(-3.0, -0.2, 120)])
    names = ("log10(omega [rad/s]) 1", "log10(zeta) 1")
    trace = SearchTrace(
        stages=(SearchStage("pair 1", names, points, np.abs(points[:, 0] - np.log10(14.0))),),
        minima=(PolishedMinimum("pair 1", of.poles, rss),),
        warnings=(finding(FindingKind.DAMPING_BOUND, omega_rad_s=62.0, zeta=0.7),),
        evaluations=240,
    )
    fit = [
        100 * (1 - np.linalg.norm(e) / np.linalg.norm(r.output - r.output.mean()))
        for e, r in zip(residuals, used, strict=True)
    ]
    return Identification(
        model=of, structure=Structure(of.integrators, 0, False, True, False),
        record_names=tuple(r.name for r in used), residuals=residuals, fit_percent=np.array(fit), rss=rss,
        noise_std=float(np.sqrt(rss / sum(e.size for e in residuals))), tangent_optimality=1e-9,
        order_table=(OrderStep(1, 1, 2.5 * rss, 812.4), OrderStep(1, 2, rss, -95.1)),
        verdicts=(NuisanceTest("offset", 1, 0.3).finding,), search=trace,
    )  # fmt: skip


def stabilisation_plot() -> Stabilisation:
    """Two modes that stay and a pair that moves."""
    return Stabilisation(
        rss=np.array([9.0, 4.0, 1.0, 0.99, 0.98]),
        n_real=1,
        chosen=2,
        n_pairs=np.repeat([1, 2, 3, 4], [1, 2, 3, 4]),
        omega_rad_s=np.array([14.1, 14.0, 62.0, 14.0, 40.0, 62.1, 5.0, 14.0, 40.1, 62.0]),
        zeta=np.array([0.06, 0.05, 0.015, 0.05, 0.01, 0.0151, 0.3, 0.05, 0.01, 0.0149]),
        previous=np.array([-1, 0, -1, 1, -1, 2, -1, 3, 4, 5]),
        same_damping=np.array([False, False, False, True, False, True, False, True, True, True]),
        needed=np.array([True, True, True, True, False, True, False, True, False, True]),
    )


def controller(gain: float = 1.5) -> Controller:
    """A lead that costs the slow mode a quarter of its damping and leaves the other alone."""
    return Controller([[0.7]], [[1.0]], [[-0.25 * gain]], [[gain]], DT_S, input_limit=24.0)


def plant(*, performance: bool = True) -> UncertainPlant:
    hub, tip = model(), model("tip_m")
    return UncertainPlant(
        hub.to_control(),
        name="hub",
        uncertainty=posterior(hub),
        performance=PlantChannel(tip.to_control(), posterior(tip)) if performance else None,
    )


def scatter_rows() -> list[ScatterRow]:
    return [
        ScatterRow(0.3, 3.0, 0.11, 0.13, 1.18, 0.2, 1.8),
        ScatterRow(3.0, 30.0, 0.021, 0.019, 0.9, 0.03, 1.4),
        ScatterRow(30.0, 300.0, 0.3, 0.41, 1.37, float("nan"), float("nan")),
    ]


def config(
    *,
    channels: int = 2,
    validation: bool = True,
    title: str = "Made-up arm",
    outputs: tuple[str, ...] = ("hub_angle_rad", "tip_m"),
    labels: tuple[str, ...] = ("hub", "tip"),
    records: tuple[str, ...] = ("prbs 1", "prbs 2", "fresh"),
    input_name: str = INPUT,
    notes: tuple[str, ...] = ("link of 1 m",),
    machine: str = "simulated",
) -> RunConfig:
    """The configuration such a run would have. The excitations stand for the records made above."""
    excitation = {"kind": "prbs", "amplitude_V": 2.0, "samples": 900, "hold_samples": 12}
    roles = ["estimation", "estimation", "validation" if validation else "repeat"]
    return RunConfig.model_validate(
        {
            "run": {"name": "example", "title": title, "seed": 3},
            "source": {
                "kind": "simulated",
                "records": [
                    {"name": name, "role": role, "condition": "same", "excitation": excitation}
                    for name, role in zip(records, roles, strict=True)
                ][: 3 if validation else 2],
            },
            "channels": [
                {"name": label, "input": input_name, "output": output}
                for label, output in list(zip(labels, outputs, strict=True))[:channels]
            ],
            "specification": {
                "bandwidth_rad_s": 0.1,
                "modulus_margin": 0.5,
                "input_limit": 24.0,
                "controller_order": 1,
            },
            "closed_loop": {"machine": machine, "draws": 3},
            "notes": {"known": list(notes), "unknown": ["the amplifier's bandwidth"]},
        }
    )


def build_run(
    path: Path,
    settings: RunConfig,
    *,
    gain: float = 1.5,
    impossible: bool = False,
    settled: int = 3,
    scatter: bool = True,
) -> RunDirectory:
    """Write every stage but the report, through the same types and words as the real stages."""
    run = RunDirectory(path).begin_run(
        config_text="# as given\n[run]\nname = 'example'\n",
        config=settings.to_document(),
        seed=settings.run.seed,
        inputs={"log.csv": "ab" * 32},
    )
    models = [model(channel.output, input_name=channel.input) for channel in settings.channels]
    names = settings.record_names
    roles = [entry.role for entry in settings.source.records]
    records = tuple(
        kept.RunRecord(record(models, name, seed), role, "same", "a remark", kind="prbs")
        for seed, (name, role) in enumerate(zip(names, roles, strict=True), 1)
    )
    run.save_stage("records", kept.RecordsResult(records), "00")
    results = _save_identification(run, settings, models, records)
    _save_uncertainty(run, results, scatter)
    _save_design(run, settings, gain, impossible, settled)
    for number, name in enumerate(("records", "identify", "uncertainty", "design", "certify", "closed_loop")):
        run.record_stage(name, 1.5 + number, "00")
    return run


def _save_identification(
    run: RunDirectory, settings: RunConfig, models: list[GobfModel], records: tuple[kept.RunRecord, ...]
) -> tuple[kept.IdentifiedChannel, ...]:
    channels = []
    for channel, of in zip(settings.channels, models, strict=True):
        used = [as_fitted(item.record, channel) for item in records if item.role == "estimation"]
        fresh = [item for item in records if item.role != "estimation"]
        channels.append(
            kept.IdentifiedChannel(
                name=channel.label,
                identification=identification(of, used),
                used=tuple(used),
                bounded=tuple(used),
                fresh=tuple(
                    fit_on_fresh_data(of, item.record.siso(channel.input, channel.output)) for item in fresh
                ),
                fresh_roles=tuple(item.role for item in fresh),
                stabilisation=stabilisation_plot(),
            )
        )
    run.save_stage("identify", kept.IdentifyResult(tuple(channels)), "00")
    return tuple(channels)


def _save_uncertainty(run: RunDirectory, results: tuple[kept.IdentifiedChannel, ...], scatter: bool) -> None:
    channels = []
    for result in results:
        omega, poles = uncertainty_stage.display_grid(result.model, result.used), result.model.poles
        spread = posterior(result.model)
        tests = residual_tests(spread, result.bounded)
        more = {"tests": tests, "poles": poles, "linear": spread, "linear_poles": poles}
        found = uncertainty_stage.uncertain_channel("tangent", 0.95, spread, result, omega, **more)
        rows = tuple(scatter_rows()) if scatter else None
        channels.append(replace(found, nominal=result.model, repeat_scatter=rows))
    run.save_stage("uncertainty", kept.UncertaintyResult(tuple(channels)), "00")


def _save_design(run: RunDirectory, settings: RunConfig, gain: float, impossible: bool, settled: int) -> None:
    if impossible:
        reason = "plant 'hub': bandwidth_rad_s = 900 lies beyond the Nyquist frequency"
        run.save_stage("design", kept.DesignResult(None, met=False, reason=reason), "00")
        run.save_stage("achievable_performance", kept.AchievablePerformance(), "00")
        run.save_stage("certify", kept.CertifyResult(None, certified=False, reason=reason), "00")
        run.save_stage("reference_filter", kept.ReferenceFilterResult(), "00")
        run.save_stage("closed_loop", kept.ClosedLoopResult(skipped=reason), "00")
        return
    law = controller(gain)
    certificate = certify(
        law, [plant(performance=len(settings.channels) > 1)], settings.specification, n_dense=800
    )
    met = certificate.gamma <= 1
    result = SynthesisResult(
        outcome=Outcome.MET_ON_GRID if met else Outcome.NOT_MET,
        controller=law,
        gamma=certificate.gamma,
        blocking=(BlockingPoint("hub", "modulus", 12.5, certificate.gamma),),
        starts=(StartReport("Solve_Succeeded", 41, 0.7, certificate.gamma),),
        gamma_history=(certificate.gamma,),
        grid_points=200,
    )
    run.save_stage("design", kept.DesignResult(result, met, outcome(result)), "00")
    run.save_stage("achievable_performance", achievable(), "00")
    run.save_stage("reference_filter", kept.ReferenceFilterResult(), "00")
    reason = "; ".join(requirement(item) for item in certificate.items if not item.met) or "met"
    sampled = sampled_responses(certificate.gamma)
    run.save_stage("certify", kept.CertifyResult(certificate, certificate.certified, reason, sampled), "00")
    run.save_stage("closed_loop", kept.ClosedLoopResult(check=loop_check(settings, settled)), "00")


def achievable(reached: float = 0.79) -> kept.AchievablePerformance:
    """What a controller of any order reaches, made up."""
    return kept.AchievablePerformance(
        YoulaBracket((PlantBracket("hub", reached - 0.002, reached, reached + 0.002),))
    )


def sampled_responses(gamma: float) -> kept.SampledResponses:
    """Sampled responses, made up: the worst case holds for 990 of 1000."""
    joint = JointCoverage(
        coverage=0.95, draws=1000, gamma=0.99 * gamma, level=0.9, given_level=0.95, gamma_given=gamma,
        coverage_given=0.99, simultaneous_given=0.4, simultaneous_level=0.998, stable_share=1.0,
    )  # fmt: skip
    return kept.SampledResponses(joint)


def loop_check(settings: RunConfig, settled: int, draws: int = 3) -> kept.LoopCheck:
    """A well-damped step response for the prediction, noisy copies for the machine."""
    time = np.arange(800) * DT_S
    reference = np.where(time >= 0.4, 0.5, 0.0)
    disturbance = np.where(time >= 4.0, 0.3, 0.0)
    shape = 1 - np.exp(-3 * (time - 0.4)) * np.cos(5 * (time - 0.4))
    output = np.where(time >= 0.4, 0.5 * shape, 0.0)
    rng = np.random.default_rng(5)

    def runs(count: int, noise: float) -> kept.LoopRuns:
        y = output + noise * rng.standard_normal((count, time.size))
        y[:, time >= 4.0] += 0.05 * np.exp(-2 * (time[time >= 4.0] - 4))
        u = np.clip(4 * (reference - y), -24, 24)
        return kept.LoopRuns(y, u, 0.9 * y if len(settings.channels) > 1 else None, np.abs(u) >= 24)

    trial = closed_loop_stage.Trial(time, reference, reference, disturbance, 0.5, 400, tracking=True)
    predicted, achieved = runs(1, 0.0), runs(draws, 0.002)
    sensitivity, conditions = None, ()
    if settings.machine == "simulated":
        sensitivity, conditions = beyond_the_trial(reference[:400], output[:400])
    rows = closed_loop_stage.describe(achieved, trial)
    return kept.LoopCheck(
        machine=settings.machine, tracking=True, reference_step=0.5, disturbance_step=0.3, quantisation=0.0,
        measurement_step=0.0, input_limit=24.0, filtered=False,
        predicted=closed_loop_stage.describe(predicted, trial)[0],
        achieved=tuple(replace(row, settled=number < settled) for number, row in enumerate(rows)),
        time_s=time, reference=reference, disturbance=disturbance, model_answer=None,
        predicted_runs=predicted, achieved_runs=achieved, sensitivity=sensitivity, conditions=conditions,
        friction=None if sensitivity is None else friction_check(sensitivity),
    )  # fmt: skip


def friction_check(sensitivity: kept.SensitivityCheck) -> kept.FrictionCheck:
    """Three sizes, made up; the smallest is measured outside its interval."""
    sizes, peak = np.array([0.2, 0.02, 0.002]), sensitivity.nominal_peak
    error, step = 0.01 * np.sin(np.linspace(0, 6, 500)), 0.2 - 0.2 * np.exp(-np.linspace(0, 6, 100))
    return kept.FrictionCheck(
        level=0.04, level_interval=(0.039, 0.041), presliding=1e-5, sizes=sizes,
        low=peak * np.array([0.99, 0.95, 0.9]), high=peak * np.array([1.01, 0.98, 0.95]),
        measured=peak * np.array([1.0, 0.97, 0.96]), nominal_peak=peak,
        certified_peak=sensitivity.certified_peak, tolerance_percent=5.0, certified_from=0.002,
        linear_from=0.01, sticking_step=0.0013, sticking_interval=(0.0012, 0.0014), error_at_rest=0.006,
        error_interval=(0.0058, 0.0062), step=StepMetrics(0.2, 0.1, 10.0, 0.0, 1.5, 0.001, 3.0, 0.0),
        settling=kept.SettlingRange((0.1, 0.2, 0.4), (1.6, 1.5, 3.0), 20.0),
        watched_s=20.0, left=0.002, output=step, recorded_output=0.1 + 0.5 * step,
        tracking=kept.SlowSine(0.05, 0.1, 0.001, error, 0.2 * error, moves_from=0.02),
    )  # fmt: skip


def beyond_the_trial(reference, output) -> tuple[kept.SensitivityCheck, tuple[kept.ConditionRun, ...]]:
    """Two measurements of S and two conditions, as the closed-loop stage leaves them."""
    omega = np.linspace(1.0, 60.0, 40)
    loop = controller().response(omega) * plant().channel.nominal_response(omega)
    size = 1 / np.abs(1 + loop)
    peak, at = float(size.max()), float(omega[np.argmax(size)])
    names = ("arm as identified", "arm as identified, reference ten times smaller")
    rows = [
        kept.MeasuredPeak(
            name=name, reference_rms=0.2 / 10**number, peak=peak * (1 + off / 100), peak_std=0.002,
            peak_omega_rad_s=at, off_nominal_percent=off, off_certified_percent=off - 0.1, peak_command=12.0,
            limited_fraction=0.0, omega_rad_s=omega, magnitude=size * (1 + off / 100),
            std=np.full(omega.size, 0.002),
        )
        for number, (name, off) in enumerate(zip(names, (0.4, -12.0), strict=True))
    ]  # fmt: skip
    conditions = []
    for name, factor in (("payload 200 %", 0.9), ("push at the tip", 1.1)):
        law = LoopTrajectory(np.arange(400) * DT_S, reference, output[:, None], output, output > 9, DT_S)
        real = replace(law, output=factor * output[:, None])
        conditions.append(condition_run(name, "something <else>", reference, law, real, 0.5))
    return kept.SensitivityCheck(peak, at, 1.001 * peak, (1.0, 60.0), tuple(rows)), tuple(conditions)
