from .command import write_experiment as write_experiment, write_reference as write_reference
from .experiment import ExperimentLimits as ExperimentLimits
