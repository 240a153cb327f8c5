"""Value types that the command line parses or shows differently from tyro's defaults."""

import dataclasses
from decimal import Decimal, InvalidOperation
from types import NoneType, UnionType
from typing import Any, Union, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

VALUES = ConstructorRegistry()


def whole_number(text: str) -> int:
    """Parse a whole number, also as 20_000 or 1e4.

    Raises:
        ValueError: it is not a whole number, such as 1.5.
    """
    try:
        number = Decimal(text)
        if number.adjusted() < 400 and number == number.to_integral_value():
            return int(number)
    except (InvalidOperation, OverflowError, ValueError):
        pass
    raise ValueError(f"must be a whole number, not {text!r}")


@VALUES.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda given: whole_number(given[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@VALUES.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show T | None as T, and accept None as well."""
    inner = [kind for kind in get_args(info.type) if kind is not NoneType]
    if info.type_origin not in (Union, UnionType) or len(inner) != 1:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(inner[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs != 1:
        return None
    return dataclasses.replace(
        spec,
        instance_from_str=lambda given: None if given == ["None"] else spec.instance_from_str(given),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
        choices=None if spec.choices is None else (*spec.choices, "None"),
    )


@VALUES.primitive_rule
def _one_or_several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Parse one number as float, and several as tuple[float, ...]."""
    if info.type != float | tuple[float, ...]:
        return None

    def parsed(given: list[str]) -> float | tuple[float, ...]:
        values = tuple(map(float, given))
        return values[0] if len(values) == 1 else values

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="FLOAT [FLOAT ...]",
        instance_from_str=parsed,
        is_instance=lambda value: isinstance(value, float | tuple),
        str_from_instance=lambda value: list(map(str, value if isinstance(value, tuple) else [value])),
    )


@VALUES.primitive_rule
def _several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show the empty default of tuple[T, ...] as "none"."""
    if info.type_origin is not tuple or get_args(info.type)[1:] != (...,):
        return None
    as_list: Any = list[get_args(info.type)[0]]
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(as_list, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        spec,
        instance_from_str=lambda given: tuple(spec.instance_from_str(given)),
        is_instance=lambda value: isinstance(value, tuple) and spec.is_instance(list(value)),
        str_from_instance=lambda value: spec.str_from_instance(list(value)) or ["none"],
    )
