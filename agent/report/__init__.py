"""Reports: one self-contained HTML page each."""

from agent.report.motion_sections import MotionData, SearchData, plan_report
from agent.report.run_page import RunData, run_report
from agent.report.run_sections import RUN_SECTIONS, RunContent, further_sections

__all__ = [
    "RUN_SECTIONS",
    "MotionData",
    "RunContent",
    "RunData",
    "SearchData",
    "further_sections",
    "plan_report",
    "run_report",
]
