"""The catalogue: the fitted form of every effect of the vocabulary, one file each, and what others install."""

from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.effects.experiments import SeparatingMotion
from agent.model.effects.registry import GROUP, Catalogue, defined_in

#: Effects by name: those that the modules of this package define, then those installed.
CATALOGUE = Catalogue(defined_in(__name__, __path__))

__all__ = ["CATALOGUE", "GROUP", "Columns", "Effect", "FitContext", "SeparatingMotion"]
