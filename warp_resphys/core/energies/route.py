"""The route of a tendon through a body."""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from ...io.settings import Many, NotNegative, Settings, setting
from ..mesh.place import Curve, Direction, Divisions


class Route(Settings):
    """The route of a tendon."""

    guides: Curve = setting(description="points through which it runs", unit="m")
    pieces: Divisions = setting(1, "pieces into which each straight part is divided")
    fixed_guides: Many[int] = setting((), "guides, from 0, that stay in the world")
    entry_angle: NotNegative = setting(0.0, "contact angle before the first guide", "rad")
    offsets: Annotated[Many[Direction | Curve], Field(max_length=2)] = setting(
        (), "directions of identified offsets, common or per guide"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        count, fixed = len(self.guides), {*self.fixed_guides}
        if any(first == second for first, second in pairwise(self.guides)):
            raise ValueError("guides has two in a row at one place: leave one of them out.")
        if not fixed <= {*range(count)}:
            raise ValueError(
                f"fixed_guides is {list(self.fixed_guides)}: the route has guides 0 to {count - 1}."
            )
        if len(fixed) == count:
            raise ValueError(
                "fixed_guides has all guides, so that the tendon does not pull "
                "on the body: take one out."
            )
        for offset in self.offsets:
            if isinstance(offset[0], tuple) and len(offset) != count:
                raise ValueError(
                    f"offsets has a direction for {len(offset)} guides: give three numbers, or "
                    f"three for each of its {count} guides."
                )
        return self
