"""Excitation: which loop through the sub-region tells most about the parameters."""

from agent.excitation.candidates import Candidates, Loop, LoopProblem
from agent.excitation.criterion import Criterion, log_determinant, torque_weights
from agent.excitation.scoring import LoopScore, ranking
from agent.excitation.loop_search import Generation, SearchResult, search
from agent.excitation.sub_region import OutOfReach, check_sub_region
from agent.runs.loop_store import FOLDER, StoredLoop, find_loop, keep_loop, loop_key, stored_loops

__all__ = [
    "FOLDER",
    "Candidates",
    "Criterion",
    "Generation",
    "Loop",
    "LoopProblem",
    "LoopScore",
    "OutOfReach",
    "SearchResult",
    "StoredLoop",
    "check_sub_region",
    "find_loop",
    "keep_loop",
    "log_determinant",
    "loop_key",
    "ranking",
    "search",
    "stored_loops",
    "torque_weights",
]
