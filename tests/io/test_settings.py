import json
from typing import Annotated, Literal, Self

import pytest
from pydantic import Field, model_validator

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


def refused(**values: object) -> str:
    with pytest.raises(InputError) as caught:
        parse(World, {**BALL, **values})
    return str(caught.value)


def shown(value):
    """A value as YAML has it."""
    return json.dumps(value) if value is None or value is True else repr(value)


class TestTypes:
    def test_a_whole_number_stands_for_a_number_and_a_list_becomes_a_tuple(self):
        world = parse(World, {"shape": {"kind": "brick", "size": [1, 2, 3], "divisions": [4, 5]}, "share": 1})
        assert isinstance(world.shape, Brick)
        assert world.shape.size == (1.0, 2.0, 3.0)
        assert world.shape.divisions == (4, 5)

    @pytest.mark.parametrize("value", [True, "0.5", None, float("nan"), [0.5], 0.0])
    def test_an_invalid_share_is_refused(self, value):
        assert refused(share=value).startswith(f"share is {shown(value)}: it must be a number above 0")

    @pytest.mark.parametrize("value", [2.0, True, -1])
    def test_an_invalid_count_is_refused(self, value):
        assert refused(count=value) == f"count is {shown(value)}: it must be a whole number, zero or more."

    def test_a_setting_does_not_change(self):
        with pytest.raises(ValueError, match="frozen"):
            parse(World, BALL).count = 4  # type: ignore[misc]


class TestSentences:
    def test_of_a_range_with_its_unit(self):
        assert refused(damping=-1.0) == "damping is -1.0: it must be a number, zero or more, in 1/s, or null."

    def test_of_the_kind_of_group_that_was_named(self):
        message = refused(shape={"kind": "brick", "size": [1, 2]})
        assert message == "shape.size is [1, 2]: it must be three numbers, in m."

    def test_of_an_unknown_kind(self):
        assert refused(shape={"kind": "bal"}) == "shape.kind is 'bal': it must be one of ball, brick."
        assert refused(shape={}) == "shape.kind is null: it must be one of ball, brick."
        assert refused(shape=3) == "shape is 3: it must be a group of settings."

    def test_of_a_missing_key(self):
        assert refused(shape={"kind": "ball"}) == "shape.radius is missing: it must be a positive number, in m."

    def test_of_a_word(self):
        assert refused(method="newtons") == "method is 'newtons': it must be one of newton, descent."
        assert refused(is_fixed=1) == "is_fixed is 1: it must be true or false."

    def test_of_a_value_of_several_types(self):
        expected = "radii is [[1.0, 'x']]: it must be a number or a list of lists of numbers."
        assert refused(radii=[[1.0, "x"]]) == expected

    def test_of_a_relation(self):
        expected = "spans.early.low is 2: it must be below high, 1 s."
        assert refused(spans={"early": {"low": 2.0}}) == expected

    def test_of_an_unknown_key(self):
        assert refused(coumt=1) == "unknown key 'coumt', did you mean 'count'?"
        assert refused(spans={"early": {"hihg": 2.0}}) == "unknown key 'spans.early.hihg', did you mean 'high'?"
        assert "did you mean 'shape.radius'" in refused(radius=1.0)
        assert refused(zzz=1).startswith("unknown key 'zzz': a configuration has shape, spans,")

    def test_of_a_group_that_lies_in_another(self):
        with pytest.raises(InputError, match=r"^bodies\.ball\.share is 2"):
            parse(World, {**BALL, "share": 2}, "bodies.ball")


class TestContent:
    def test_equal_settings_have_one_hash(self):
        first, second = parse(World, {**BALL, "share": 1, "count": 3}), parse(World, {"count": 3, **BALL})
        assert first == second
        assert hash(first) == hash(second)
        assert hash(first.changed(count=4)) != hash(first)

    def test_plain_data_makes_the_same_settings_again(self):
        world = parse(World, {"shape": {"kind": "brick", "size": [1, 2, 3]}, "spans": {"early": {"high": 3.0}}})
        assert parse(World, world.plain()) == world

    def test_a_part_has_the_keys_of_its_class(self):
        class Part(Settings):
            count: Count
            share: Share

        assert Part.of(parse(World, BALL)) == Part(count=3, share=1.0)

    def test_changes_are_checked(self):
        with pytest.raises(InputError, match="count"):
            parse(World, BALL).changed(count=-1)

    def test_all_keys_are_listed(self):
        assert {"shape.radius", "shape.size", "spans.NAME.high", "share"} <= {*keys(World.model_json_schema())}
