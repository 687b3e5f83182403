"""The verdict on what a search found."""

from agent.diagnosis.document import Cause, NamedEffect
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.verdict import decide_verdict


def verdict_on(selected: SelectedCauses, closure: float = 1.0) -> str:
    """Verdict where each cause of a finding closes this part of the gap."""
    equal = [tuple(NamedEffect(name, ()) for name, _ in rivals) for rivals in selected.rivals]
    causes = [Cause("stribeck", (), closure, 0.9, {"rise": 1.0}, rivals) for rivals in equal]
    return decide_verdict(selected, causes, closure).name
