"""`RunSettings`: the whole configuration of a run, with keys that some groups take from others."""

from collections.abc import Mapping
from typing import Any, Self

from pydantic import model_validator

from ..io.settings import Settings
from .body import TargetSettings
from .relations import check_relations
from .run_keys import RunKeys


class RunSettings(RunKeys):
    """The configuration of a run."""

    @model_validator(mode="before")
    @classmethod
    def _left_out(cls, values: Any) -> Any:
        return filled(values)

    @model_validator(mode="after")
    def _related(self) -> Self:
        check_relations(self)
        return self


def filled(values: Any) -> Any:
    """Returns the plain values of a run, with the keys
    that some groups leave out copied from other groups.

    These are ``network`` and ``trainer`` of ``simfree``, and in ``target`` and ``laboratory`` all
    keys of `TargetSettings`, with ``simulation`` as the material. Numbers and the model of a
    material may stand directly in ``target``; null takes one out.
    """
    if not isinstance(values, Mapping):
        return values
    values = dict(values)
    simfree = _mapping(values.get("simfree", {}))
    if simfree is not None and {*simfree} <= {"network", "trainer"}:
        merged: dict[str, Any] = {}
        for key in ("network", "trainer"):
            whole, changes = _mapping(values.get(key, {})), _mapping(simfree.get(key, {}))
            merged[key] = (
                simfree.get(key) if whole is None or changes is None else {**whole, **changes}
            )
        values["simfree"] = merged
    keys = TargetSettings.model_fields
    common = {
        key: values.get(key) for key, field in keys.items() if key in values or field.is_required()
    }
    for group in ("target", "laboratory"):
        part = values.get(group)
        if isinstance(part, Mapping):
            direct = {
                key: x for key, x in part.items() if key not in keys and not isinstance(x, Mapping)
            }
            known = direct if group == "target" else {}
            material = _mapping(part.get("material", {}))
            if known and material is not None:
                part = {key: value for key, value in part.items() if key not in known}
                part["material"] = {
                    key: value for key, value in {**known, **material}.items() if value is not None
                }
            values[group] = {**common, "material": values.get("simulation"), **part}
    return values


def _mapping(values: Any) -> Mapping[str, Any] | None:
    """Returns a group as a mapping; None for any other value."""
    if isinstance(values, Settings):
        return values.plain()
    return values if isinstance(values, Mapping) else None
