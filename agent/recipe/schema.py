"""The sections of a recipe file as pydantic models; values are SI after validation."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails

from agent.core import and_list
from agent.motion import FlyTrajectory, FlyType
from agent.recipe.quantities import (
    FULL_TURN,
    Count,
    Extent,
    Frequency,
    GateRatio,
    Interval,
    JointRange,
    Lean,
    Mass,
    Name,
    Orientation,
    Pose,
    Position,
    Radius,
    Range,
    Ratio,
    Reach,
    Seed,
    Speed,
    ToolPose,
    ToolPosition,
)
from drivers.texts import public_address

#: Estimators that `estimate.method` may name; `auto` lets held-out error choose.
ESTIMATION_METHODS = ("auto", "weighted", "huber", "consistent", "paper", "plain")
#: Searches that `search.method` may name.
SEARCH_METHODS = ("genetic", "random")


class RecipeSection(BaseModel):
    """A part of the recipe: an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class ToolSection(RecipeSection):
    """The tool on the flange, in the flange's frame."""

    frame: ToolPose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    mass: Annotated[Mass, Field(ge=0, le=10_000)] = 0.0
    centre_of_mass: ToolPosition | None = None


class ControllerSection(RecipeSection):
    """Address of the controller, and its driver."""

    driver: Name = "tcp"
    address: Name
    effort: Name | None = None

    @property
    def options(self) -> dict[str, str]:
        """What the driver is told besides the address: what `effort` is, where the wire leaves that open."""
        return {} if self.effort is None else {"effort": self.effort}

    @property
    def public_address(self) -> str:
        """The address without its options, for people."""
        return public_address(self.address)


class BoxBounds(RecipeSection):
    """Opposite corners, in the base frame."""

    min: Position
    max: Position

    @model_validator(mode="after")
    def _ordered(self) -> BoxBounds:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                raise ValueError(f"min must be below max on every axis; on {axis} it is {low:g} m to {high:g} m")
        return self


class KeepOutEntry(RecipeSection):
    """A box that no part of the arm may enter."""

    name: Name
    box: BoxBounds


class CellSection(RecipeSection):
    """Obstacles around the robot, and narrower joint ranges."""

    keep_out: Annotated[list[KeepOutEntry], Field(max_length=200)] = []
    joint_ranges: dict[Name, JointRange] = {}

    @field_validator("keep_out")
    @classmethod
    def _told_apart(cls, boxes: list[KeepOutEntry]) -> list[KeepOutEntry]:
        names = [entry.name for entry in boxes]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(f"each box needs a name of its own; used more than once: {', '.join(duplicates)}")
        return boxes


class FlySection(RecipeSection):
    """How the loop passes its via-points; all but `distance` are system variables of COMAU's FLY statement."""

    type: FlyType = FlyType.FLY_CART
    trajectory: FlyTrajectory = FlyTrajectory.FLY_TOL
    distance: Annotated[Reach, Field(ge=0, le=1)] = 0.02
    percent: Annotated[Ratio, Field(ge=0.01, le=1)] = 1.0
    stress: Annotated[Ratio, Field(ge=0.01, le=1)] = 0.5

    @field_validator("percent", "stress")
    @classmethod
    def _whole(cls, ratio: float) -> float:
        if abs(100.0 * ratio - round(100.0 * ratio)) > 1e-9:
            raise ValueError(f"{100.0 * ratio:g} % is not a whole percent, as the controller's INTEGER takes it")
        return ratio


class BoxSection(RecipeSection):
    """A box in the base frame; the tool stays within `cone` of `orientation` (Euler ZYZ)."""

    centre: Position
    size: Extent
    orientation: Orientation
    cone: Annotated[Lean, Field(ge=0, le=FULL_TURN / 2)] = 0.0

    @field_validator("size")
    @classmethod
    def _some_size(cls, size: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(size):
            raise ValueError('a box of no size has no room for via-points; its edges are lengths such as "500 mm"')
        return size


class PointEntry(RecipeSection):
    """The region of one via-point: pose plus or minus range."""

    pose: Pose
    range: Range


class TubeSection(RecipeSection):
    """All within `radius` of a taught path (poses joined by straight lines) and `cone` of its orientation."""

    path: Annotated[list[Pose], Field(min_length=2, max_length=1000)]
    radius: Radius
    cone: Annotated[Lean, Field(ge=0, le=FULL_TURN / 2)] = 0.0


class ViaPointsSection(RecipeSection):
    """The sub-region: exactly one of `box`, `points`, `like` and `tube`."""

    count: Annotated[Count, Field(ge=2, le=50)] | None = None
    box: BoxSection | None = None
    points: Annotated[list[PointEntry], Field(min_length=2, max_length=50)] | None = None
    like: Name | None = None
    around: Radius | None = None
    tube: TubeSection | None = None

    @field_validator("points")
    @classmethod
    def _some_range(cls, points: list[PointEntry] | None) -> list[PointEntry] | None:
        if points is not None and not any(any(point.range) for point in points):
            raise ValueError("no point has a range, so there is nothing to search; give at least one of them a range")
        return points

    @model_validator(mode="wrap")
    @classmethod
    def _alternatives(cls, data: Any, handler: Any) -> ViaPointsSection:
        # mode "wrap": a wrong value elsewhere in the section must not hide that the alternatives clash
        faults = _clashes(data) if isinstance(data, dict) else []
        try:
            section = handler(data)
        except ValidationError as error:
            if not faults:
                raise
            raise ValidationError.from_exception_data(cls.__name__, [*_details(error), *faults]) from None
        if faults:
            raise ValidationError.from_exception_data(cls.__name__, faults)
        # points are counted by themselves
        return section if section.points is None else section.model_copy(update={"count": len(section.points)})


class MotionSection(RecipeSection):
    """Speed, FLY settings and sub-region of the motion."""

    speed: Annotated[Speed, Field(ge=0.001, le=100)] = 1.0
    fly: FlySection = FlySection()
    via_points: ViaPointsSection


class SearchSection(RecipeSection):
    """The search for the via-points."""

    population: Annotated[Count, Field(ge=4, le=100_000)] = 50
    generations: Annotated[Count, Field(ge=1, le=100_000)] = 40
    seed: Seed = 1
    method: Literal[SEARCH_METHODS] = "genetic"  # type: ignore[valid-type]
    interpolator: Name | None = None


class RecordSection(RecipeSection):
    """Rate of the recording, and number of cycles."""

    rate: Annotated[Frequency, Field(ge=1, le=100_000)] = 500.0
    cycles: Annotated[Count, Field(ge=1, le=100_000)] = 100


class FilterSection(RecipeSection):
    """The Butterworth filter, run forwards and backwards."""

    order: Annotated[Count, Field(ge=1, le=16)] = 8
    cutoff: Annotated[Frequency, Field(ge=0.1)] = 30.0


class EstimateSection(RecipeSection):
    """Filter and estimator."""

    filter: FilterSection = FilterSection()
    method: Literal[ESTIMATION_METHODS] = "auto"  # type: ignore[valid-type]


class ValidateSection(RecipeSection):
    """The random motions that validate the model."""

    motions: Annotated[Count, Field(ge=1, le=10_000)] = 30
    speed: Annotated[Speed, Field(ge=0.001, le=100)] = 0.1
    seed: Seed = 2


class GateSection(RecipeSection):
    """The largest error that is accepted."""

    normalised_rmse: Annotated[GateRatio, Field(ge=1e-6, le=1)] = 0.03


class RecalibrateSection(RecipeSection):
    """Interval and parameters of a recalibration."""

    every: Annotated[Interval, Field(ge=1, le=3652 * 86_400.0)] = 604_800.0
    parameters: Literal["friction", "all"] = "friction"


class RecipeDocument(RecipeSection):
    """A whole recipe file."""

    robot: Name
    tool: ToolSection | None = None
    controller: ControllerSection
    cell: CellSection = CellSection()
    motion: MotionSection
    search: SearchSection = SearchSection()
    record: RecordSection = RecordSection()
    estimate: EstimateSection = EstimateSection()
    validate_: ValidateSection = Field(default=ValidateSection(), alias="validate")
    gate: GateSection = GateSection()
    recalibrate: RecalibrateSection = RecalibrateSection()


def _clashes(data: dict[Any, Any]) -> list[InitErrorDetails]:
    chosen = [key for key in ("box", "points", "like", "tube") if data.get(key) is not None]
    if len(chosen) != 1:
        got = and_list(chosen) or "none"
        return [_fault((), f"exactly one of box, points, like (with around) and tube is expected, not {got}", data)]
    faults = []
    counted = data.get("count") is not None
    if chosen == ["points"] and counted:
        faults.append(_fault(("count",), "points are counted by themselves; leave count out", data["count"]))
    if chosen != ["points"] and not counted:
        faults.append(_fault(("count",), f"how many via-points is required with {chosen[0]}", data))
    if (chosen == ["like"]) != (data.get("around") is not None):
        message = "how far around it is required with like" if chosen == ["like"] else "it belongs to like alone"
        faults.append(_fault(("around",), message, data))
    return faults


def _fault(location: tuple[str, ...], message: str, value: Any) -> InitErrorDetails:
    return InitErrorDetails(type="value_error", loc=location, input=value, ctx={"error": ValueError(message)})


def _details(error: ValidationError) -> list[InitErrorDetails]:
    return [
        InitErrorDetails(type=fault["type"], loc=fault["loc"], input=fault["input"], ctx=fault.get("ctx", {}))
        for fault in error.errors()
    ]
