from typing import Annotated, Literal, Self

import numpy as np
import pytest
from pydantic import Field, model_validator

from support.refusals import refuses
from warp_resphys.io.errors import InputError
from warp_resphys.io.setting_errors import keys
from warp_resphys.io.settings import (
    Count,
    Many,
    Natural,
    NotNegative,
    Positive,
    Settings,
    Share,
    Vector,
    parse,
    setting,
)


class Ball(Settings):
    kind: Literal["ball"]
    radius: Positive = setting(unit="m")


class Brick(Settings):
    kind: Literal["brick"]
    size: Annotated[Vector, Field(json_schema_extra={"unit": "m"})]
    divisions: Many[Natural] = ()


class Span(Settings):
    low: float = 0.0
    high: float = setting(1.0, "where it ends", unit="s")

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low is {self.low:g}: it must be below high, {self.high:g} s.")
        return self


class World(Settings):
    shape: Annotated[Ball | Brick, Field(discriminator="kind")]
    spans: dict[str, Span] = setting({}, "by name")
    share: Share = 1.0
    count: Count = 3
    damping: NotNegative | None = setting(None, unit="1/s")
    method: Literal["newton", "descent"] = "newton"
    is_fixed: bool = False
    radii: float | Many[Many[float]] = 1.0


BALL = {"shape": {"kind": "ball", "radius": 0.1}}


SENTENCES = [
    ({"damping": -1.0}, "damping is -1.0: it must be a number, zero or more, in 1/s, or null."),
    (
        {"shape": {"kind": "brick", "size": [1, 2]}},
        "shape.size is [1, 2]: it must be three numbers, in m.",
    ),
    ({"shape": {"kind": "bal"}}, "shape.kind is 'bal': it must be one of ball, brick."),
    ({"shape": {}}, "shape.kind is null: it must be one of ball, brick."),
    ({"shape": 3}, "shape is 3: it must be a group of settings."),
    ({"shape": {"kind": "ball"}}, "shape.radius is missing: it must be a positive number, in m."),
    ({"method": "newtons"}, "method is 'newtons': it must be one of newton, descent."),
    ({"is_fixed": 1}, "is_fixed is 1: it must be true or false."),
    (
        {"radii": [[1.0, "x"]]},
        "radii is [[1.0, 'x']]: it must be a number or a list of lists of numbers.",
    ),
    ({"spans": {"early": {"low": 2.0}}}, "spans.early.low is 2: it must be below high, 1 s."),
    ({"coumt": 1}, "unknown key 'coumt', did you mean 'count'?"),
    ({"spans": {"early": {"hihg": 2.0}}}, "unknown key 'spans.early.hihg', did you mean 'high'?"),
    ({"radius": 1.0}, "unknown key 'radius', did you mean 'shape.radius'?"),
    *(
        ({"share": x}, f"share is {said}: it must be a number above 0")
        for x, said in ((True, "true"), (None, "null"))
    ),
    *(
        ({"share": x}, f"share is {x!r}: it must be a number above 0")
        for x in ("0.5", float("nan"), [0.5], 0.0)
    ),
    *(
        ({"count": x}, f"count is {x!r}: it must be a whole number, zero or more.")
        for x in (2.0, -1)
    ),
    ({"count": True}, "count is true: it must be a whole number, zero or more."),
    ({"zzz": 1}, "unknown key 'zzz': a configuration has shape, spans,"),
]


@pytest.mark.parametrize(("values", "sentence"), SENTENCES)
def test_what_is_wrong_is_said_with_its_unit_and_what_to_do(values, sentence):
    with pytest.raises(InputError) as caught:
        parse(World, {**BALL, **values})
    said = str(caught.value)
    assert said.startswith(sentence) if sentence[-1] not in ".?" else said == sentence


def test_a_group_that_lies_in_another_is_named():
    refuses(
        InputError, r"^bodies\.ball\.share is 2", parse, World, {**BALL, "share": 2}, "bodies.ball"
    )


def test_a_whole_number_stands_for_a_number_and_a_list_becomes_a_tuple():
    world = parse(
        World, {"shape": {"kind": "brick", "size": [1, 2, 3], "divisions": [4, 5]}, "share": 1}
    )
    assert isinstance(world.shape, Brick)
    assert (world.shape.size, world.shape.divisions) == ((1.0, 2.0, 3.0), (4, 5))
    with pytest.raises(ValueError, match="frozen"):
        world.count = 4  # type: ignore[misc]


def test_objects_made_in_python_are_checked_and_take_arrays():
    brick = Brick(kind="brick", size=np.array([1.0, 2.0, 3.0]), divisions=np.array([4, 5]))
    assert brick == parse(Brick, {"kind": "brick", "size": [1, 2, 3], "divisions": [4, 5]})
    assert Ball(kind="ball", radius=np.float32(0.5)).radius == 0.5
    refuses(
        InputError,
        r"^Ball\.radius is -1\.0: it must be a positive number, in m\.$",
        Ball,
        kind="ball",
        radius=-1.0,
    )
    refuses(
        InputError,
        r"^unknown key 'Ball\.raduis', did you mean 'radius'",
        Ball,
        kind="ball",
        radius=1.0,
        raduis=1.0,
    )
    refuses(
        InputError,
        r"^World\.shape\.radius is 0\.0: it must be",
        World,
        shape={"kind": "ball", "radius": 0.0},
    )


class TestContent:
    def test_equal_settings_have_one_hash(self):
        first = parse(World, {**BALL, "share": 1, "count": 3})
        second = parse(World, {"count": 3, **BALL})
        assert first == second
        assert hash(first) == hash(second)
        assert hash(first.changed(count=4)) != hash(first)

    def test_plain_data_makes_the_same_settings_again(self):
        world = parse(
            World,
            {"shape": {"kind": "brick", "size": [1, 2, 3]}, "spans": {"early": {"high": 3.0}}},
        )
        assert parse(World, world.plain()) == world

    def test_a_part_has_the_keys_of_its_class(self):
        class Part(Settings):
            count: Count
            share: Share

        assert Part.of(parse(World, BALL)) == Part(count=3, share=1.0)

    def test_changes_are_checked(self):
        refuses(InputError, "count", parse(World, BALL).changed, count=-1)

    def test_all_keys_are_listed(self):
        assert {"shape.radius", "shape.size", "spans.NAME.high", "share"} <= {
            *keys(World.model_json_schema())
        }
