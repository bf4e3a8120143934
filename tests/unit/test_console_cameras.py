"""Cameras in the console: which there are for all pages, their pictures for those that look."""

from __future__ import annotations

import base64

from fullswarm.messages import CameraPicture
from tests.unit.console_bench import KEYS, ConsoleBench


def picture(bench: ConsoleBench, problem: str = "") -> None:
    bench.bus.publish(KEYS.camera("ceiling"), CameraPicture(camera="ceiling", jpeg=b"\xff\xd8 1", problem=problem))
    bench.run(0.2)


def test_pages_learn_of_cameras_and_only_those_that_look_get_pictures() -> None:
    bench = ConsoleBench()
    looking, session = bench.join()
    other, _ = bench.join("session-2", "bert")
    picture(bench)
    assert looking.last("cameras")["cameras"] == [{"name": "ceiling", "problem": ""}]
    assert not looking.all("picture")
    assert bench.say(session, looking, "watch", on=True)["ok"]
    picture(bench, "the camera has moved")
    assert base64.b64decode(looking.last("picture")["jpeg"]) == b"\xff\xd8 1"
    assert not other.all("picture")
    assert other.last("cameras")["cameras"][0]["problem"] == "the camera has moved"
    assert bench.say(session, looking, "watch", on=False)["ok"]
    count = len(looking.all("picture"))
    picture(bench)
    assert len(looking.all("picture")) == count


def test_who_only_looks_on_may_look_and_a_page_that_is_gone_gets_nothing() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    assert bench.say(session, page, "watch", on=True)["ok"]
    bench.gateway.leave(session, page)
    picture(bench)
    assert not page.all("picture")


def test_a_camera_that_gives_no_picture_any_more_is_marked() -> None:
    bench = ConsoleBench()
    page, _ = bench.join()
    picture(bench)
    bench.run(5.0)
    assert page.last("cameras")["cameras"] == [{"name": "ceiling", "problem": "no picture"}]
