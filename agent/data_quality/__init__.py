"""Whether logs can be used: every check of recorded data, its finding, and what to do about it."""

from agent.data_quality.channels import unsigned_torque
from agent.data_quality.checks import check_quality, contradicted, spoiled
from agent.data_quality.faults import QualityFinding
from agent.data_quality.fitted_model import fitted_doubts
