from .candidates import Candidates as Candidates, Loop as Loop, LoopProblem as LoopProblem, via_joints as via_joints
from .criterion import (
    Criterion as Criterion,
    log_determinant as log_determinant,
    one_blas_thread as one_blas_thread,
    torque_weights as torque_weights,
)
from .loop_search import Generation as Generation, SearchResult as SearchResult, search as search
from .scoring import LoopScore as LoopScore, ranking as ranking
from .sub_region import OutOfReach as OutOfReach, check_sub_region as check_sub_region
