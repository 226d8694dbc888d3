"""flexlink from Python: from logs of a flexible-link arm to a certified controller.

    >>> import flexlink
    >>> from numpy.random import default_rng

Names are imported at first use, so `import flexlink` is fast. A result prints a short summary; `plot()` draws
it, `to_control()` converts it for python-control. Long computations use one BLAS thread, as the commands do.

Data        `Record`, `FrfRepeats`, `FrequencyUncertainty`, `band_limited`, `empirical_frf`
Models      `identify`, `identify_frf`, `identify_mimo`, `uncertainty`, `matrix_posterior`,
            `GobfModel`, `Poles`, `IdentOptions`, `EmbeddingOptions`, `Identification`, `Uncertainty`,
            `pole_intervals`, `error_surface`
Comparison  `compare`, `Comparison`, `arx`, `armax`, `oe`, `n4sid`: any models on one validation record
Basis       `regressor`, `basis_response`
Controllers `UncertainPlant`, `Specification`, `RationalWeight`, `synthesise`, `SynthesisOptions`, `certify`,
            `Certificate`, `Controller`, `simulate_loop`, `step_metrics`, `c_source`,
            `synthesise_jointly`, `youla_bracket`, `YoulaOptions`
Joints      `MultivariablePlant`, `ResponseBall`, `MultivariableSpecification`, `MultivariableOptions`,
            `synthesise_multivariable`, `MultivariableResult`, `certify_multivariable`,
            `MultivariableCertificate`: several sensors and actuators, after `identify_mimo`
Machines    `Rig`, `paper_link`, `effect`, `simulate`, `linear_arm`, `SampledArm`, `prbs`, `multisine`
Causes      `Case`, `Experiment`, `load_case`, `diagnose`, `Diagnosis`
Pictures    `plot`, `bode`, `nyquist`, `nichols`, `step`
Tables      `table`

`LoopRun`, `Simulation` and `SynthesisResult` are what `simulate_loop`, `simulate` and `synthesise` return.
"""

import sys

if sys.argv[0] == "-m" and "flexlink" in sys.orig_argv:
    del sys.path[0]  # of the current folder: no csv.py in it is taken for Python's own

import lazy_loader

from flexlink.own_packages import find_own_first

find_own_first()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
