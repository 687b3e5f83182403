from .calibration.comparison import comparison_page as comparison_page
from .calibration.friction import friction_section as friction_section
from .calibration.loop import ShownLoop as ShownLoop, plan_report as plan_report
from .calibration.parameters import parameters_section as parameters_section
from .calibration.prediction import torque_plot as torque_plot
from .calibration.recordings import LogHealth as LogHealth
from .calibration.residuals import residual_section as residual_section
from .calibration.runs import (
    RunContent as RunContent,
    calibration_report as calibration_report,
    recalibration_report as recalibration_report,
)
from .diagnosis.free_motion import RATIO_TITLES as RATIO_TITLES
from .diagnosis.page import diagnosis_report as diagnosis_report
from .elements import (
    About as About,
    Bar as Bar,
    Bars as Bars,
    NextStep as NextStep,
    Page as Page,
    Section as Section,
    Table as Table,
    render as render,
    table_html as table_html,
)
from .history import index_page as index_page
from .phrasing import (
    SUMMARY_KEYS as SUMMARY_KEYS,
    chances_text as chances_text,
    closes as closes,
    diagnosis_summary as diagnosis_summary,
    headline as headline,
    in_short as in_short,
    next_text as next_text,
    place as place,
    summary as summary,
    verdict_name as verdict_name,
    verdict_text as verdict_text,
)
from .plots import (
    SERIES as SERIES,
    Panel as Panel,
    Plot as Plot,
    joint_series as joint_series,
)
from .stills import still as still
from .templates import asset as asset, filled as filled
