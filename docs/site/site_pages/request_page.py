"""Page of all requests of the control API, from its table and its OpenAPI description."""

from __future__ import annotations

from typing import Any

from rtloop.configuration.field_texts import texts_below
from rtloop.service.api.application import MAX_STREAMS, WATCH_HZ
from rtloop.service.api.description import ERRORS, openapi
from rtloop.service.api.requests import REQUESTS, ApiRequest
from site_pages.option_values import default_text, range_text, type_text
from site_pages.texts import anchored, escape, own_docstring, table, unit_of

INTRODUCTION = f"""# Requests

A service (`rtloop serve`) responds to HTTP on a UNIX socket. Bodies and responses are JSON. The parameter `as` of the
query is the requester's name. [The service](../service.md) explains states, lock and socket; `rtloop ctl` and
`rtloop.connect` send these requests. Every request that moves an output, or changes
the loop, needs the lock; a free lock is taken by the request.

    curl --unix-socket /run/rtloop/board.sock http://localhost/status
    curl --unix-socket /run/rtloop/board.sock 'http://localhost/setpoint?as=ada' --json '{{"axis": "x", "value": 12.5}}'

Two WebSockets stand beside the requests; together at most {MAX_STREAMS} are open.

| WebSocket | content |
|---|---|
| `/watch` | {WATCH_HZ:g} times a second the service sends state, faults, lock holder, measurement and newest signals |
| `/setpoints` | the client sends bodies of `/setpoint`; the service sends each one's response |

`GET /openapi.json` returns the OpenAPI 3.1 description of all requests with the names of the service's axes.

"""


def request_page() -> str:
    """Return the page of all requests."""
    rows = [
        (f"[`{request.method} {request.path}`](#{_anchor(request)})", escape(request.summary)) for request in REQUESTS
    ]
    codes = table(("code", "meaning"), [(f"`{code}`", text) for code, text in ERRORS.items()])
    described = openapi(["x"])["paths"]
    body = "\n\n".join(
        _request_markdown(request, described[request.path][request.method.lower()]) for request in REQUESTS
    )
    return (
        INTRODUCTION
        + table(("request", "effect"), rows)
        + '\nAn error is `{"error": "…"}` with one of these codes:\n'
        + codes
        + "\n"
        + body
    )


def _anchor(request: ApiRequest) -> str:
    """Return the anchor of a request, such as "post-setpoint"."""
    return f"{request.method.lower()}-{request.name}"


def _request_markdown(request: ApiRequest, operation: dict[str, Any]) -> str:
    """Return heading, sender, fields and status codes of one request; `operation` is its OpenAPI description."""
    codes = ", ".join(f"`{code}`" for code in operation["responses"])
    lines = [
        f"## `{request.method} {request.path}` {{ #{_anchor(request)} }}",
        "",
        escape(request.summary),
        "",
        f"- Sender: {request.sender.value}.",
        f"- Status codes: {codes}. Response: `{request.media_type}`.",
    ]
    if request.body is None:
        return "\n".join([*lines, "- No body.", ""])
    place = "Query" if request.method == "GET" else "Body, optional" if request.body_optional else "Body"
    lines += [f"- {place}: {escape(own_docstring(request.body))}", ""]
    properties = request.body.model_json_schema()["properties"]
    texts = texts_below(request.body)
    rows = []
    for name, field in request.body.model_fields.items():
        limits = range_text(properties[name])
        value = type_text(properties[name]) + (f"<br>{limits}" if limits else "")
        anchor = f"{_anchor(request)}.{name}"
        rows.append((anchored(name, anchor), value, default_text(field), unit_of(name), escape(texts.get(name, ""))))
    return "\n".join(lines) + table(("field", "value", "default", "unit", "meaning"), rows)
