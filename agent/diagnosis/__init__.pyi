from .background import smooth_columns as smooth_columns
from .candidate import Candidate as Candidate
from .correction import corrected as corrected
from .dataset import Dataset as Dataset, background_of as background_of
from .drives_off import channel_zero as channel_zero
from .evidence import Evidence as Evidence
from .extension import extended_model as extended_model
from .finding import Finding as Finding, Hypothesis as Hypothesis
from .fit import Fit as Fit
from .forward import Simulated as Simulated, simulate as simulate, simulation_part as simulation_part
from .forward_windows import (
    forward_lines as forward_lines,
    forward_or_reason as forward_or_reason,
    forward_warning as forward_warning,
)
from .healthy import with_healthy_effects as with_healthy_effects
from .labels import in_torque as in_torque, torque_gap as torque_gap
from .law import LAW as LAW
from .needs import Excursions as Excursions
from .randomisation import Range as Range, ranges as ranges, ranges_text as ranges_text
from .regimes import BANDS as BANDS, band_shares as band_shares, masks as masks, motor_phase_share as motor_phase_share
from .result import Diagnosis as Diagnosis
from .search import Search as Search
from .servo_torque import with_servo_torque as with_servo_torque
from .sizes import (
    amplitude as amplitude,
    leading_parameter as leading_parameter,
    reported_parameters as reported_parameters,
    size_text as size_text,
)
from .structure import with_structure as with_structure
from .testability import smallest_sizes as smallest_sizes
from .verdict import judge as judge
from .workflow import check_effects as check_effects, diagnose as diagnose
