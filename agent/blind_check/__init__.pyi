from .check import BlindCheck as BlindCheck
from .report import summary_text as summary_text
