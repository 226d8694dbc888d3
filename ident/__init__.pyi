from .basis.functions import (
    basis_response as basis_response,
    basis_state_space as basis_state_space,
    regressor as regressor,
)
from .basis.model import GobfModel as GobfModel, MisoModel as MisoModel
from .basis.options import IdentOptions as IdentOptions
from .basis.poles import Poles as Poles
from .basis.structure import Structure as Structure
from .data.record import Record as Record
from .data.signal_filter import band_limited as band_limited
from .frequency_fit import FrfIdentification as FrfIdentification, identify_frf as identify_frf
from .identification import Identification as Identification
from .one_input import identify as identify
from .search.error_surface import ErrorSurface as ErrorSurface, error_surface as error_surface
from .search.pole_search import SearchTrace as SearchTrace
