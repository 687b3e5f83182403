"""Reports: one self-contained HTML page each."""

from agent.report.motion_sections import MotionData, SearchData, plan_report
from agent.report.run_report import RunData, run_report

__all__ = ["MotionData", "RunData", "SearchData", "plan_report", "run_report"]
