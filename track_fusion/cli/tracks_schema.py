"""The form of what `track-fusion fuse` reads: a JSON Schema, and its errors in words that name field and mend.

What a schema cannot say (symmetric, positive definite, weights that sum to 1) is checked on the arrays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator
from typing import Any

from jsonschema import Draft202012Validator, ValidationError
from jsonschema.validators import extend

from track_fusion.params import nearest
from track_fusion.tracks import ABSURD

Schema = dict[str, Any]

#: What is said when a keyword is not met; {title} is what the schema wants there.
MENDS = {
    **dict.fromkeys(("type", "minItems", "maxItems"), "must be {title}; got {got}"),
    "not": "{title}",
    "minimum": "must not be negative; got {got}",
    "exclusiveMinimum": "must exceed {limit}, or there is no covariance; got {got}",
}


class InputError(ValueError):
    """The input is wrong; the message begins with the field."""


def check(data: Any, schema: Schema) -> None:
    """Check names, types, sizes and ranges of the input; raise InputError for the first error, from the outside in."""
    for error in _Validator(schema).iter_errors(data):
        raise InputError(_told(error))


def _within(validator: Any, limit: float, value: float, schema: Schema) -> Iterator[ValidationError]:
    """Check the keyword of ours: finite, and not beyond a limit."""
    if isinstance(value, float) and not math.isfinite(value):
        yield ValidationError(f"must be finite; got {value}")
    elif abs(value) > limit:
        yield ValidationError(f"must not exceed {limit:g} in size; got {_shown(value)}")


_Validator = extend(
    Draft202012Validator,
    {"within": _within},
    type_checker=Draft202012Validator.TYPE_CHECKER.redefine("natural", lambda _, v: type(v) is int and v >= 0),
)


def _told(error: ValidationError) -> str:
    place, text, given = error.json_path, error.message, error.instance
    properties = error.schema.get("properties", {})
    if error.validator == "required":
        name = next(name for name in error.validator_value if name not in given)
        place, text = f"{place}.{name}", "is missing" + properties.get(name, {}).get("why", "")
    elif error.validator == "additionalProperties":
        name = next(name for name in given if name not in properties)
        valid = [key for key, wanted in properties.items() if "not" not in wanted]
        place, text = f"{place}.{name}", f"is unknown.{nearest(name, valid)} Valid: {', '.join(valid)}"
    elif error.validator in MENDS:
        got = str(len(given) or "an empty list") if error.validator in ("minItems", "maxItems") else _shown(given)
        text = MENDS[error.validator].format(title=error.schema.get("title"), limit=error.validator_value, got=got)
    return f"{place[2:] or 'standard input'}: {text}"


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


# The schemas. Keywords are tried in their order: a misspelt name is told before the one that is missing.


def tracks_schema(size: int | None, needs: Collection[str], rule: str, optional: Collection[str]) -> Schema:
    """Make the schema of all but the values beside "tracks"; size is the number of axes, None while that is wrong."""
    why, unused = f"; rule '{rule}' needs it", _refused(f"is nothing that rule '{rule}' uses")

    def used(forms: Schema) -> Schema:
        return {n: {**form, "why": why} if n in needs or n in optional else unused for n, form in forms.items()}

    dof = {"if": {"enum": [None, math.inf]}, "else": {**_number(math.inf), "exclusiveMinimum": 2}}
    extras = {"independent_cov": _matrix(size), "likelihood": {**_number(math.inf), "minimum": 0}}
    track = _density(size, {"dof": dof, **used(extras)}, [name for name in extras if name in needs])
    shared: Schema = dict.fromkeys(("common", "cross_cov", "target", "seed"), {})
    required = ["tracks", *(name for name in shared if name in needs)]
    name = {"type": "string", "title": "a name"}
    names = "a list of names, one an axis" if size is None else f"a list of {size} names, one an axis of tracks[0]"
    axes = {"axes": _list(names, name, size), "angular": _list("a list of names", name)}
    return _object({"tracks": _list("a list of tracks", track), **axes, **used(shared)}, required)


def shared_schema(count: int, size: int | None) -> Schema:
    """Make the schema of the values beside "tracks", for so many tracks of so many axes."""
    # The cross-covariances: null where they are known otherwise; of two tracks it may be the one matrix.
    block = {"if": {"type": "null"}, "else": _matrix(size)}
    what = f"{count} rows of {count} blocks" + (", or the one block of both tracks" if count == 2 else "")
    cross_cov = _list(what, _list(f"{count} blocks", block, count), count)
    filled = {"type": "array", "minItems": 1}
    number_first = {**filled, "prefixItems": [{**filled, "prefixItems": [{"type": "number"}]}]}
    if count == 2:
        cross_cov = {"if": number_first, "then": _matrix(size), "else": cross_cov}
    seed = {"type": "natural", "title": "an integer >= 0"}
    return {"properties": {"common": _density(size), "cross_cov": cross_cov, "target": _density(size), "seed": seed}}


def _density(size: int | None, more: Schema | None = None, required: Collection[str] = ()) -> Schema:
    vector = "a list of numbers, one an axis" if size is None else f"a list of {size} numbers, one an axis of tracks[0]"
    moments = {"mean": _list(vector, _number(), size), "cov": _matrix(size)}
    part = {"weight": {**_number(), "minimum": 0}, **moments}
    components = _list("a list of components", _object(part, list(part)))
    beside = _refused("must not be given beside 'components', whose moments it would be")
    either = {
        "if": {"required": ["components"]},
        "then": {"properties": dict.fromkeys(moments, beside)},
        "else": {"required": list(moments)},
    }
    return _object({**moments, "components": components, **(more or {})}, list(required), either)


def _object(properties: Schema, required: list[str], more: Schema | None = None) -> Schema:
    start = {"type": "object", "title": "an object in braces", "additionalProperties": False, "required": required}
    return {**start, **(more or {}), "properties": properties}


def _list(title: str, items: Schema, size: int | None = None) -> Schema:
    sizes = {"minItems": 1} if size is None else {"minItems": size, "maxItems": size}
    return {"type": "array", "title": title, **sizes, "items": items}


def _matrix(size: int | None) -> Schema:
    return _list(f"{size} rows of {size} numbers", _list(f"a row of {size} numbers", _number(ABSURD**2), size), size)


def _number(limit: float = ABSURD) -> Schema:
    return {"type": "number", "title": "a number", "within": limit}


def _refused(why: str) -> Schema:
    return {"not": {}, "title": why}
