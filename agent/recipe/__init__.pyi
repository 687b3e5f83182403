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
    CellDescription as CellDescription,
    MotionPlan as MotionPlan,
    Recipe as Recipe,
    examine_recipe as examine_recipe,
    load_recipe as load_recipe,
    recipe_schema as recipe_schema,
)
from .recipe_text import template as template
from .schema import GateSection as GateSection
from .via_points import (
    ViaBox as ViaBox,
    ViaLike as ViaLike,
    ViaPointList as ViaPointList,
    ViaPointRegion as ViaPointRegion,
    ViaTube as ViaTube,
)
