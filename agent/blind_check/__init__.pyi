from .exported_runs import export_runs as export_runs
from .own_check import BlindCheck as BlindCheck, score_answers as score_answers
from .report import summary_of as summary_of
from .scoring import class_of as class_of, clopper_pearson as clopper_pearson, outcome as outcome
from .worlds import world_of as world_of
