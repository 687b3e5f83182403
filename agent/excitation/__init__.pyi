from .candidates import Candidates as Candidates, Loop as Loop, LoopProblem as LoopProblem
from .criterion import Criterion as Criterion
from .genetic import LoopScore as LoopScore, ranking as ranking
from .loop_search import search as search
from .reach import check_sub_region as check_sub_region, working_box as working_box
from .set_point_plan import (
    CHIRP as CHIRP,
    EXCITATIONS as EXCITATIONS,
    REVERSALS as REVERSALS,
    STEPS as STEPS,
    SetPointLimits as SetPointLimits,
    SetPointMotion as SetPointMotion,
    SetPointPlan as SetPointPlan,
    excitation as excitation,
    plan_set_points as plan_set_points,
)
