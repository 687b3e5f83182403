"""Reports: one self-contained HTML page each."""

from agent.report.run_report import RunData, run_report

__all__ = ["RunData", "run_report"]
