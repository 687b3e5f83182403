from .corrected_simulator import corrected_numbers as corrected_numbers, supported_correction as supported_correction
from .diagnosis import Diagnosis as Diagnosis
from .document import NextKind as NextKind
from .extension import extended_model as extended_model
from .forward.simulation import Simulated as Simulated, simulate as simulate, simulation_part as simulation_part
from .forward.windows import (
    forward_lines as forward_lines,
    forward_or_reason as forward_or_reason,
    forward_warning as forward_warning,
)
from .gap.drives_off import channel_zero as channel_zero
from .gap.regime_shares import (
    BANDS as BANDS,
    band_shares as band_shares,
    masks as masks,
    motor_phase_share as motor_phase_share,
)
from .hypotheses.evidence import Evidence as Evidence
from .hypotheses.healthy import with_healthy_effects as with_healthy_effects
from .hypotheses.law import LAW as LAW
from .hypotheses.noise_model import ROW_SPACING as ROW_SPACING, smooth_columns as smooth_columns
from .hypotheses.search import Search as Search
from .hypotheses.selected_causes import Hypothesis as Hypothesis, SelectedCauses as SelectedCauses
from .hypotheses.testability import smallest_sizes as smallest_sizes
from .labels import (
    could_show as could_show,
    has_torque_gap as has_torque_gap,
    shows_in_torque as shows_in_torque,
    testable_counts as testable_counts,
)
from .limits import LIMITS as LIMITS
from .position_logs.search import without_torque as without_torque
from .position_logs.separation import separations as separations
from .randomisation import Range as Range, ranges as ranges, ranges_text as ranges_text
from .rows.candidate import Candidate as Candidate, EffectKey as EffectKey
from .rows.dataset import Dataset as Dataset
from .rows.fit import Fit as Fit
from .rows.needs import MotionCoverage as MotionCoverage
from .rows.standstill import noise_level as noise_level
from .sizes import (
    amplitude as amplitude,
    leading_parameter as leading_parameter,
    reported_parameters as reported_parameters,
    size_text as size_text,
)
from .structure import with_structure as with_structure
from .workflow import check_effects as check_effects, diagnose as diagnose
