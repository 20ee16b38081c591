"""The OpenAPI 3.1 description of the control API, derived from the table of requests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rtloop.configuration.file import type_adapter
from rtloop.configuration.reference_options import ReferenceOptions
from rtloop.recording.file.topics.events import MAX_NAME, OPERATOR, RESERVED_NAMES
from rtloop.service.api.bodies import MAX_BODY_BYTES
from rtloop.service.api.requests import REQUESTS, ApiRequest, Sender
from rtloop.service.changing.live import TUNABLE_SECTIONS
from rtloop.version import __version__

ERRORS = {
    409: "the state, the lock holder or the loop does not allow the request; the message states the reason, and any "
    "axes that have changed already",
    413: f"the body is longer than {MAX_BODY_BYTES} bytes",
    422: "the request is malformed, or a value is not allowed",
    503: "too many requests wait, the request takes too long, or the service is ending; send the request again later",
    504: "the loop stands still, and has taken the command or will take it (mode off, a stop): the command takes "
    "effect if the loop continues",
}
ERROR_SCHEMA = {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]}
_RESERVED = "|".join(
    "".join(f"[{letter.upper()}{letter}]" for letter in name) for name in RESERVED_NAMES if name != OPERATOR
)
NAME_PATTERN = (
    rf"^(?!(?:{_RESERVED})$)(?![0-9]{{1,9}}$)[\p{{L}}0-9]"
    rf"(?:[\p{{L}}0-9 .\-_@+']{{0,{MAX_NAME - 2}}}[\p{{L}}0-9.\-_@+'])?$"
)
"""Names that `name_problem` accepts, as a regular expression of ECMA-262, without combining marks."""
NAME_PARAMETER = {
    "name": "as",
    "in": "query",
    "description": "name of the requester",
    "schema": {"type": "string", "default": OPERATOR, "pattern": NAME_PATTERN},
}


def openapi(axes: Sequence[str]) -> dict[str, object]:
    """Return the OpenAPI description, as JSON values, of the API of a service with these axes."""
    reference = type_adapter(ReferenceOptions).json_schema(ref_template="#/components/schemas/{model}")
    components = reference.pop("$defs")
    fields = {"axis": {"enum": list(axes)}, "section": {"enum": list(TUNABLE_SECTIONS)}, "reference": reference}
    paths: dict[str, dict[str, object]] = {}
    for request in REQUESTS:
        paths.setdefault(request.path, {})[request.method.lower()] = _operation(request, fields)
    return {
        "openapi": "3.1.0",
        "info": {"title": "rtloop control API", "version": __version__},
        "paths": paths,
        "components": {"schemas": components},
    }


def _operation(request: ApiRequest, fields: Mapping[str, object]) -> dict[str, object]:
    """Return the OpenAPI operation of one request: parameters, body and responses.

    `fields` are schemas by name; each replaces the schema of the body's field of this name, if there is one.
    """
    answers: dict[str, object] = {"200": {"description": "done", "content": {request.media_type: {}}}}
    for code in request.errors:
        content = {"application/json": {"schema": ERROR_SCHEMA}}
        answers[str(code)] = {"description": ERRORS[code], "content": content}
    parameters = [] if request.sender is Sender.ANYONE else [NAME_PARAMETER]
    if request.sender is Sender.STOPPER or (request.body is not None and request.body.can_stop):
        parameters = [NAME_PARAMETER | {"schema": {"type": "string"}}]  # A stop ignores an invalid name.
    operation: dict[str, object] = {"summary": request.summary, "parameters": parameters, "responses": answers}
    if request.body is None:
        return operation
    schema = request.body.model_json_schema()
    schema["properties"] |= {name: field for name, field in fields.items() if name in schema["properties"]}
    if request.method == "GET":
        parameters += [
            {"name": name, "in": "query", "required": True, "schema": field}
            for name, field in schema["properties"].items()
        ]
    else:
        content = {"application/json": {"schema": schema}}
        operation["requestBody"] = {"required": not request.body_optional, "content": content}
    return operation
