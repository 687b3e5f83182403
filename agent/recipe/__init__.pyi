from .quantities import (
    BARE_ANGLE as BARE_ANGLE,
    BARE_LEAN as BARE_LEAN,
    BARE_PLACE as BARE_PLACE,
    BARE_REACH as BARE_REACH,
    Name as Name,
    Speed as Speed,
    Time as Time,
)
from .recipe import (
    Recipe as Recipe,
    examine_recipe as examine_recipe,
    load_recipe as load_recipe,
    recipe_schema as recipe_schema,
)
from .recipe_text import USUAL as USUAL, template as template
from .schema import (
    ESTIMATION_METHODS as ESTIMATION_METHODS,
    GateSection as GateSection,
    ViaPointsSection as ViaPointsSection,
)
