"""Dispatch, description and the panel's proxy derive from the table of requests."""

from __future__ import annotations

import asyncio
import re
from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.panel.web.proxy import Proxy
from rtloop.recording.file.topics.events import name_problem
from rtloop.service.api.application import application
from rtloop.service.api.description import NAME_PATTERN, openapi
from rtloop.service.api.requests import REQUESTS
from rtloop.service.lock import Lock

SERVICE: Any = SimpleNamespace(
    is_ending=False,
    configuration=SimpleNamespace(axes=[SimpleNamespace(name="x"), SimpleNamespace(name="y")]),
    lock=Lock(),
)
PATHS = openapi(["x", "y"])["paths"]


def response(method: str, path: str, query: bytes = b"") -> tuple[int, dict[str, str]]:
    """Return status and headers of the API's response to a request without a body."""
    messages: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        messages.append(message)

    scope = {"type": "http", "method": method, "path": path, "query_string": query, "headers": []}
    asyncio.run(application(SERVICE)(scope, receive, send))
    return messages[0]["status"], {name.decode(): value.decode() for name, value in messages[0]["headers"]}


def test_every_request_has_documented_answers_with_a_type():
    for request in REQUESTS:
        answers = PATHS[request.path][request.method.lower()]["responses"]
        assert set(answers) == {"200", *map(str, request.errors)}
        assert all(answer["content"] for answer in answers.values()), request.path


def test_the_description_names_the_axes_and_the_sections_that_may_change():
    schema = PATHS["/tune"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert schema["properties"]["axis"] == {"enum": ["x", "y"]}
    assert schema["properties"]["section"]["enum"] == ["controller", "limits", "interlocks", "prefilter", "model"]
    assert schema["properties"]["values"]["minProperties"] == 1


@pytest.mark.parametrize(
    "name", ["ada", "Ada Lovelace", "a", "x" * 40, "x" * 41, "", " a", "a ", "can", "Loop", "operator", "007", "cans",
             "1234567890", "a/b", "o'b.c-d_e@f+g"])  # fmt: skip
def test_the_description_allows_the_names_that_the_service_takes(name: str):
    pattern = NAME_PATTERN.replace(r"\p{L}", "A-Za-z")
    assert (re.match(pattern, name) is not None) == (name_problem(name) is None)


@pytest.mark.parametrize(
    ("name", "text"), [("/" + "x" * 39, "'/" + "x" * 39 + "';"), ("x" * 41, "x'…;"), ("ü/", "\\xfc/';")]
)
def test_a_refused_name_is_shown_up_to_its_fortieth_character(name: str, text: str):
    assert text in (name_problem(name) or "")


def test_a_method_that_is_not_allowed_gets_all_that_are():
    code, headers = response("GET", "/lock")
    assert (code, set(headers["allow"].split(", "))) == (405, {"POST", "DELETE"})


def test_the_lock_is_taken_and_released_under_the_name_of_the_request():
    assert response("POST", "/lock", b"as=ada")[0] == 200
    assert SERVICE.lock.holder["name"] == "ada"
    assert response("DELETE", "/lock", b"as=bob")[0] == 409
    assert response("DELETE", "/lock", b"as=ada")[0] == 200
    assert SERVICE.lock.holder is None


def test_the_panel_forwards_what_the_table_says():
    routes = {(method, route.path) for route in Proxy(SERVICE).routes() for method in route.methods - {"HEAD"}}  # type: ignore[attr-defined]
    expected = {(request.method, f"/api{request.path}") for request in REQUESTS if request.page_bytes is not None}
    assert routes == expected | {("GET", "/api/openapi.json")}
    assert ("POST", "/api/reload") not in routes
