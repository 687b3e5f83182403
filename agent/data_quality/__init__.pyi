from .channels import unsigned_torque as unsigned_torque
from .checks import check_quality as check_quality, spoiled as spoiled
from .finding import QualityFinding as QualityFinding
from .fitted import fitted_doubts as fitted_doubts
