from .arm import arm_along as arm_along
from .common_sections import parameters_section as parameters_section
from .comparison import comparison_page as comparison_page
from .comparison_sections import comparison_section as comparison_section
from .diagnosis_page import diagnosis_report as diagnosis_report
from .friction_curves import friction_section as friction_section
from .gap_section import diagnosis_summary as diagnosis_summary
from .index import IndexData as IndexData, index_page as index_page
from .log_sections import LogHealth as LogHealth, log_section as log_section
from .motion_sections import MotionData as MotionData, SearchData as SearchData, plan_report as plan_report
from .observation import observation_section as observation_section
from .page import About as About, NextStep as NextStep, Page as Page, Section as Section, render as render
from .phrasing import (
    FOUR as FOUR,
    closes as closes,
    headline as headline,
    in_short as in_short,
    place as place,
    summary as summary,
    verdict_text as verdict_text,
    what as what,
)
from .recalibration import recalibration_report as recalibration_report
from .residual_sections import residual_section as residual_section
from .rounds_section import chances_text as chances_text, next_text as next_text, said_by_rounds as said_by_rounds
from .run_page import RunData as RunData, run_report as run_report
from .run_sections import (
    RUN_SECTIONS as RUN_SECTIONS,
    RunContent as RunContent,
    further_sections as further_sections,
)
from .torque_section import TorqueData as TorqueData
