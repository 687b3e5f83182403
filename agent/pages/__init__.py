"""Reports: one self-contained HTML page each."""

from agent.pages.calibration.comparison import comparison_page
from agent.pages.calibration.friction import friction_section
from agent.pages.calibration.loop import ShownLoop, plan_report
from agent.pages.calibration.parameters import parameters_section
from agent.pages.calibration.prediction import torque_plot
from agent.pages.calibration.recordings import LogHealth
from agent.pages.calibration.residuals import residual_section
from agent.pages.calibration.runs import RunContent, calibration_report, recalibration_report
from agent.pages.diagnosis.page import diagnosis_report
from agent.pages.history import index_page
from agent.pages.page import About, Bar, Bars, NextStep, Page, Section, Table, render, table_html
from agent.pages.phrasing import (
    FOUR,
    chances_text,
    closes,
    diagnosis_summary,
    headline,
    in_short,
    next_text,
    place,
    summary,
    verdict_text,
    what,
)
from agent.pages.plots import SERIES, Panel, Plot, joint_series
from agent.pages.stills import still
from agent.pages.templates import asset, filled
