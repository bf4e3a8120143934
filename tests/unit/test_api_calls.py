"""The REST operations: answers as the document says, roles, tokens, leases, bounds."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from typing import Any

import httpx
import pytest
from jsonschema import Draft202012Validator

from fullswarm.operator.console.api import access
from fullswarm.operator.console.frames import MAX_BYTES
from fullswarm.operator.console.tokens import TokenFile
from tests.unit.api_lab import GOAL, PAGE_TOKEN, WALL_S, ApiLab, problem, run, validator

CALLS: tuple[tuple[str, str, Any], ...] = (
    ("GET", "/swarm", None), ("GET", "/robots", None), ("GET", "/robots/r0", None), ("GET", "/behaviours", None),
    ("GET", "/behaviours/navigate_each_bc", None), ("GET", "/missions", None), ("GET", "/map", None),
    ("GET", "/docks", None), ("GET", "/parameters", None), ("GET", "/parameters?key=agent/*", None),
    ("POST", "/leases", {"robots": ["r0", "r1"], "seconds": 30}), ("GET", "/leases", None),
    ("POST", "/requests/check", GOAL), ("POST", "/requests", GOAL), ("GET", "/requests/{request}", None),
    ("POST", "/robots/r1/twist", {"linear_m_s": 0.2, "angular_rad_s": -0.1, "ttl_s": 0.2}),
    ("POST", "/stop", {"robots": ["r0"]}), ("POST", "/estop", {"reason": "a test"}), ("POST", "/estop/clear", {}),
    ("GET", "/log?limit=20", None), ("POST", "/leases/release", {}),
)  # fmt: skip


def test_every_operation_answers_as_the_served_document_says(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        document = (await lab.client.get("/openapi.json")).json()
        assert document["openapi"].startswith("3.1")
        for schema in document["components"]["schemas"].values():
            Draft202012Validator.check_schema(schema)
        seen, request = set(), ""
        for method, path, body in CALLS:
            found = await lab.call(method, path.format(request=request), body)
            assert found.status_code < 300, (path, found.text)
            template = path.partition("?")[0].replace("/r0", "/{robot}").replace("/r1", "/{robot}")
            template = template.replace("navigate_each_bc", "{behaviour}")
            described = document["paths"][template][method.lower()]
            seen.add(described["operationId"])
            answer = described["responses"][str(found.status_code)]["content"][found.headers["content-type"]]
            validator(document, answer["schema"]).validate(found.json())
            if body is not None:
                sent = described["requestBody"]["content"]["application/json"]["schema"]
                validator(document, sent).validate(body)
            request = found.json().get("request_id", request)
        everything = {each["operationId"] for path in document["paths"].values() for each in path.values()}
        assert everything == seen
        for wrong in ("/robots/r9", "/behaviours/none", "/requests/none", "/nothing"):
            answer = await lab.refused(404, wrong)
            validator(document, {"$ref": "#/components/schemas/Problem"}).validate(answer)

    run(tmp_path, story)


def test_parameters_of_a_behaviour_are_a_schema_that_the_core_agrees_with(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        found = await lab.ask("/behaviours/move_to_goal_bc")
        schema = Draft202012Validator(found["parameters"])
        for parameters in (
            {"goal": [1.0, 2.0]}, {"goal": [1.0, 2.0], "gain": 2.0}, {"goal": [1.0, 2.0], "gain": 99.0},
            {"goal": [1.0]}, {}, {"goal": [1.0, 2.0], "colour": 1.0}, {"goal": "there"},
        ):  # fmt: skip
            checked = await lab.ask("/requests/check", {**GOAL, "parameters": parameters})
            assert checked["accepted"] == schema.is_valid(parameters), (parameters, checked)

    run(tmp_path, story)


def test_page_lists_every_operation_and_loads_nothing(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        found = await lab.client.get("/")
        assert found.headers["content-type"].startswith("text/html")
        assert "default-src 'none'" in found.headers["content-security-policy"]
        assert not any(
            word in found.text for word in ("<script", "<style", "style=", "<img", "<link", "http://", "https://")
        )
        document = (await lab.client.get("/openapi.json")).json()
        for path, methods in document["paths"].items():
            assert all(f"{each.upper()} /api/v1{path}" in found.text for each in methods)

    run(tmp_path, story)


# -------------------------------------------------------------------- tokens
def test_only_a_token_of_a_program_that_still_counts_is_accepted(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        short = lab.file.add("short", "operator", WALL_S, days=1.0)
        for token in ("wrong", PAGE_TOKEN, lab.tokens["operator"][:-1], "x" * 10_000, "é"):
            found = await lab.client.get("/swarm", headers={b"Authorization": f"Bearer {token}".encode()})
            assert problem(found, 401)["where"] == "Authorization"
            assert found.headers["www-authenticate"].startswith("Bearer")
        basic = await lab.client.get("/swarm", headers={"Authorization": f"Basic {lab.tokens['operator']}"})
        problem(basic, 401)
        problem(await lab.client.get("/swarm"), 401)
        problem(await lab.client.get(f"/swarm?token={lab.tokens['operator']}"), 401)
        lab.tokens["short"] = short
        assert (await lab.ask("/swarm", role="short"))["you"] == {"operator": "api/short", "role": "operator"}
        lab.wall_s += 86_401.0
        await lab.refused(401, "/swarm", role="short")
        TokenFile(lab.file.path).revoke("driver")
        await lab.refused(401, "/swarm", role="driver")
        assert (await lab.call("GET", "/swarm")).status_code == 200

    run(tmp_path, story)


@pytest.mark.alone
def test_a_program_whose_token_is_revoked_loses_its_robots_and_they_stop(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold("r0", role="driver")
        await lab.ask("/requests", GOAL, role="driver")
        await lab.until_driven()
        TokenFile(lab.file.path).revoke("driver")
        assert await lab.until_stopped() < 3.0
        await lab.until(lambda: lab.holders() == {}, "its leases end")

    run(tmp_path, story)


# -------------------------------------------------------------------- roles
def test_each_role_may_do_what_it_may_on_the_page(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        for path, body in (("/leases", {"robots": ["r0"]}), ("/stop", {}), ("/estop", {}), ("/estop/clear", {}),
                           ("/requests", GOAL), ("/robots/r0/twist", {"linear_m_s": 0.1})):  # fmt: skip
            assert "observer" in (await lab.refused(403, path, body, role="observer"))["detail"]
        await lab.hold("r0", role="operator")
        assert (
            "takes no robots"
            in (await lab.refused(403, "/leases", {"robots": ["r0"], "take": True}, role="driver"))["detail"]
        )
        found = await lab.ask("/estop", {"reason": "too near"}, role="driver")
        assert (found["engaged"], found["confirmed"], len(found["receipts"])) == (True, True, 2)
        assert "operator" in (await lab.refused(403, "/estop/clear", {}, role="driver"))["detail"]
        assert all(row.health is not None and row.health.estop for row in lab.gateway.view.snapshot().robots)
        found = await lab.ask("/estop/clear", {}, role="operator")
        assert (found["engaged"], found["confirmed"]) == (False, True)

    run(tmp_path, story)


def test_a_console_that_only_shows_lets_programs_read_only(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        assert (await lab.call("GET", "/robots")).status_code == 200
        assert "read-only" in (await lab.refused(403, "/stop", {}))["detail"]

    run(tmp_path, story, read_only=True)


# -------------------------------------------------------------------- leases and requests
def test_a_robot_that_another_holds_is_refused_and_an_operator_takes_it_over(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold("r0", role="driver")
        refused = await lab.refused(409, "/leases", {"robots": ["r0", "r1"]})
        assert (refused["code"], "r0 is held by api/driver" in refused["detail"]) == ("held", True)
        assert lab.holders() == {"r0": "api/driver"}
        assert (await lab.refused(409, "/requests", GOAL))["detail"] == "r0 is held by api/driver"
        assert (await lab.refused(409, "/requests", {**GOAL, "robots": ["r1"]}))["detail"] == "you do not hold r1"
        await lab.hold("r0", take=True)
        await lab.until(lambda: lab.holders() == {"r0": "api/operator"}, "it is taken over")
        await lab.until(
            lambda: not lab.api.programs.of(lab.api.access.admit(lab.tokens["driver"])).held(), "it is lost"
        )
        assert (await lab.refused(409, "/requests", GOAL, role="driver"))["code"] == "held"

    run(tmp_path, story)


@pytest.mark.alone
def test_robots_stop_when_their_lease_ends_unless_the_program_says_otherwise(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold("r0", seconds=1.0)
        await lab.hold("r1", seconds=1.0, stop_at_end=False)
        far = {**GOAL, "robots": ["r0", "r1"], "parameters": {"goal": [40.0, 40.0]}}
        await lab.ask("/requests", far)
        await lab.until_driven("r0")
        await lab.until_driven("r1")
        assert await lab.until_stopped("r0") < 5.0
        await lab.until(lambda: lab.holders() == {}, "the leases end")
        assert lab.driven("r1")
        await lab.ask("/stop", {})
        await lab.until_stopped("r1")

    run(tmp_path, story)


def test_only_behaviours_behind_the_filter_and_no_sticks(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        bare = await lab.refused(403, "/requests", {**GOAL, "behaviour": "move_to_goal"})
        assert (bare["detail"], bare["hint"]) == ("'move_to_goal' runs without the safety filter",
                                                  "request move_to_goal_bc")  # fmt: skip
        await lab.refused(422, "/requests", {"behaviour": "drive_bc", "robots": ["r0"]})
        assert "did you mean" in (await lab.refused(404, "/requests", {**GOAL, "behaviour": "move_to_gaol_bc"}))["hint"]
        wrong = await lab.refused(422, "/requests", {**GOAL, "parameters": {"goal": [1.0, 1.0], "gain": 99.0}})
        assert (wrong["code"], "outside" in wrong["detail"]) == ("parameters", True)

    run(tmp_path, story)


def test_requests_and_stops_are_sent_under_the_tokens_name(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold("r0", role="driver")
        sent = await lab.ask("/requests", GOAL, role="driver")
        await lab.ask("/stop", {}, role="driver")
        assert (await lab.ask("/requests/" + sent["request_id"], role="driver"))["behaviour"] == "move_to_goal_bc"
        await lab.refused(404, "/requests/" + sent["request_id"])  # another program's
        lines = (await lab.ask("/log"))["lines"]
        assert any(line["by"] == "api/driver" and "Move to goal" in line["text"] for line in lines)
        assert any("api/driver" in line["text"] and line["kind"] == "stop" for line in lines)

    run(tmp_path, story)


def test_a_silent_core_is_said_and_nothing_is_sent_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.operator.console.api.acts.ANSWER_S", 0.3)

    async def story(lab: ApiLab) -> None:
        await lab.hold("r0")
        lab.whole.kill_core()
        assert (await lab.refused(503, "/requests", GOAL))["where"] == "core"
        lab.whole.start_core()
        await asyncio.sleep(0.5)  # what must not happen gets the time to
        assert not lab.driven()

    run(tmp_path, story)


# -------------------------------------------------------------------- twists
@pytest.mark.alone
def test_a_twist_ends_with_its_time_to_live(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.refused(409, "/robots/r0/twist", {"linear_m_s": 0.2})
        await lab.hold()
        began_s = lab.runtime.now_s()
        await lab.ask("/robots/r0/twist", {"linear_m_s": 0.2, "ttl_s": 1.0})
        await lab.until_driven()
        await lab.until_stopped()
        assert 0.95 < lab.runtime.now_s() - began_s < 3.0

    run(tmp_path, story)


def test_a_twist_is_what_the_robot_does(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        wanted = pytest.approx([0.2, -0.3], abs=0.02)
        async with asyncio.timeout(20.0):
            while list(lab.whole.agents["r0"].setpoints[0]) != wanted:
                await lab.ask("/robots/r0/twist", {"linear_m_s": 0.2, "angular_rad_s": -0.3, "ttl_s": 0.5})
                await asyncio.sleep(0.1)

    run(tmp_path, story)


@pytest.mark.alone
def test_twists_that_go_on_do_not_start_a_robot_that_another_operator_has_stopped(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        twist = {"linear_m_s": 0.2, "ttl_s": 1.0}
        await lab.ask("/robots/r0/twist", twist)
        await lab.until_driven()
        lab.person.stop(["r0"])
        lab.pump.wake()
        await lab.until_stopped()
        for _ in range(5):
            assert (await lab.refused(409, "/robots/r0/twist", twist))["detail"] == "stopped while driving"
            await asyncio.sleep(0.1)
            assert not lab.driven()
        await lab.ask("/robots/r0/twist", {"linear_m_s": 0.0})
        await lab.ask("/robots/r0/twist", twist)
        await lab.until_driven()
        await lab.ask("/stop", {})
        await lab.until_stopped()
        await lab.refused(409, "/robots/r0/twist", twist)
        await lab.ask("/leases/release", {})
        await lab.hold()
        await lab.ask("/robots/r0/twist", twist)
        await lab.until_driven()

    run(tmp_path, story)


def test_too_many_driven_robots_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.operator.console.api.programs.MOST_DRIVEN_EACH", 1)

    async def story(lab: ApiLab) -> None:
        await lab.hold("r0", "r1")
        await lab.ask("/robots/r0/twist", {"linear_m_s": 0.1, "ttl_s": 1.0})
        assert "too many" in (await lab.refused(409, "/robots/r1/twist", {"linear_m_s": 0.1}))["detail"]

    run(tmp_path, story)


# -------------------------------------------------------------------- bounds
def test_what_is_malformed_too_large_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        async def post(content: bytes, media: str = "application/json", path: str = "/leases") -> httpx.Response:
            return await lab.call("POST", path, content=content, headers={"Content-Type": media})

        for content in (b"", b"{", b"\xff\xfe", b"nul"):
            problem(await post(content), 400)
        for content in (
            b"[]", b"null", b"{}", b'{"robots":[]}', b'{"robots":["a b"]}', b'{"robots":["r0"],"colour":1}',
            b'{"robots":["r0"],"seconds":0}', b'{"robots":["r0"],"seconds":1e400}', b'{"robots":"r0"}', b"[" * 50_000,
        ):  # fmt: skip
            assert problem(await post(content), 422)["where"].startswith("body")
        problem(await post(b"{}", "text/plain"), 415)
        problem(await post(b"x" * (MAX_BYTES + 1)), 413)

        huge = b'{"behaviour":"move_to_goal_bc","robots":["r0"],"parameters":{"goal":99999999999999999999}}'
        assert problem(await post(huge, path="/requests"), 422)["where"] == "parameters.goal"
        form = "application/x-www-form-urlencoded"
        assert (await post(b"json=%7B%22robots%22%3A%5B%22r0%22%5D%7D", form)).status_code == 200
        problem(await post(b"a=1&b=2", form), 400)
        problem(await post(b"robots=r0", form), 422)
        problem(await lab.call("DELETE", "/leases"), 405)
        problem(await lab.call("GET", "/log?limit=0"), 422)
        problem(await lab.call("GET", "/log?limit=1&limit=2"), 422)
        problem(await lab.call("GET", "/stream"), 426)
        problem(await lab.call("GET", "/requests/a%0Ab"), 400)

    run(tmp_path, story)


def test_a_body_that_does_not_arrive_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "BODY_S", 0.2)

    async def story(lab: ApiLab) -> None:
        with socket.create_connection(("127.0.0.1", lab.port)) as line:
            line.setblocking(False)
            loop = asyncio.get_running_loop()
            head = f"POST /api/v1/stop HTTP/1.1\r\nHost: 127.0.0.1:{lab.port}\r\nContent-Type: application/json\r\n"
            head += f"Authorization: Bearer {lab.tokens['operator']}\r\nContent-Length: 10\r\n\r\n{{"
            await loop.sock_sendall(line, head.encode())
            assert b" 408 " in await loop.sock_recv(line, 4096)

    run(tmp_path, story)


@pytest.mark.parametrize("token", ["operator", "none"])
def test_a_body_without_an_end_ends_the_connection(tmp_path: Path, token: str) -> None:
    async def story(lab: ApiLab) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", lab.port)
        head = f"POST /api/v1/stop HTTP/1.1\r\nHost: 127.0.0.1:{lab.port}\r\nContent-Type: application/json\r\n"
        head += f"Authorization: Bearer {lab.tokens.get(token)}\r\nTransfer-Encoding: chunked\r\n\r\n"
        writer.write(head.encode())
        with pytest.raises(ConnectionError):  # noqa: PT012  (any of them)
            async with asyncio.timeout(5.0):
                while True:
                    writer.write(b"1000\r\n" + b" " * 0x1000 + b"\r\n")
                    await writer.drain()
        assert reader.at_eof() or reader.exception() is not None
        writer.close()

    run(tmp_path, story)


def test_calls_that_come_too_fast_are_refused_and_stops_have_their_own_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "BURST", 3.0)
    monkeypatch.setattr(access, "RATE_HZ", 0.1)

    async def story(lab: ApiLab) -> None:
        for _ in range(3):
            assert (await lab.call("GET", "/swarm")).status_code == 200
        found = await lab.call("GET", "/swarm")
        problem(found, 429)
        assert int(found.headers["retry-after"]) >= 1
        assert (await lab.call("POST", "/stop", {})).status_code == 202
        assert (await lab.call("GET", "/swarm", role="driver")).status_code == 200  # of another token

    run(tmp_path, story)


def test_a_page_of_another_origin_and_a_foreign_host_are_refused(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
            problem(await lab.call("POST", "/stop", {}, headers=headers), 403)
        assert (await lab.call("POST", "/stop", {}, headers={"Origin": lab.origin})).status_code == 202
        preflight = await lab.client.options("/stop", headers={"Origin": "http://evil.example"})
        assert "access-control-allow-origin" not in preflight.headers

    run(tmp_path, story)


def test_calls_that_wait_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "MOST_AT_ONCE", 2)
    monkeypatch.setattr("fullswarm.operator.console.api.acts.ANSWER_S", 0.5)

    async def story(lab: ApiLab) -> None:
        await lab.hold("r0")
        lab.whole.kill_core()
        found = await asyncio.gather(*(lab.call("POST", "/requests", GOAL) for _ in range(4)))
        assert sorted(each.status_code for each in found) == [429, 429, 503, 503]
        lab.whole.start_core()

    run(tmp_path, story)
