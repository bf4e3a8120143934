"""Who is on the console: names, pages, robots; with bounds."""

from __future__ import annotations

from fullswarm.operator.console.gateway import KEPT_S
from fullswarm.operator.console.presence import LONGEST_NAME, MOST_SHOWN, ROBOTS_SHOWN
from tests.unit.console_bench import ConsoleBench, Page, health


def entered(bench: ConsoleBench, name: str, key: str) -> Page:
    page = Page()
    bench.gateway.join(key, name, page, named=True)
    return page


def test_two_pages_of_one_name_are_one_operator_with_two_pages() -> None:
    bench = ConsoleBench()
    anna = entered(bench, "anna", "session-1")
    bench.gateway.join("session-1", "anna", Page(), named=True)  # a reload that overlaps, or a second tab
    entered(bench, "anna", "session-2")
    entered(bench, "ben", "session-1")
    bench.run(0.3)
    shown = anna.last("presence")
    assert [(each["name"], each["pages"]) for each in shown["people"]] == [("anna", 3), ("ben", 1)]
    assert (shown["here"], shown["more"]) == (2, 0)


def test_it_tells_what_each_holds_and_drives_and_who_is_elsewhere() -> None:
    bench = ConsoleBench()
    bench.report(health("r1"), health("r2"))
    page = Page()
    session = bench.gateway.join("session-1", "anna", page, named=True)
    bench.leases(r1="anna", r2="berta@lab")
    bench.run(0.3)
    bench.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})
    bench.run(0.24)
    anna, berta = page.last("presence")["people"]
    assert (anna["holds"], anna["drives"], anna["role"]) == (["r1"], ["r1"], "operator")
    assert (berta["name"], berta["pages"], berta["clock"], berta["holds"]) == ("berta@lab", 0, "", ["r2"])
    bench.run(0.6)
    assert page.last("presence")["people"][0]["drives"] == [], "the stick is released"


def test_it_is_sent_when_it_changes_and_not_otherwise() -> None:
    bench = ConsoleBench()
    anna = entered(bench, "anna", "session-1")
    bench.run(0.6)
    count = len(anna.all("presence"))
    bench.run(3.0)
    assert len(anna.all("presence")) == count
    ben = Page()
    session = bench.gateway.join("session-2", "ben", ben, named=True)
    bench.run(0.3)
    assert anna.last("presence")["here"] == 2
    bench.gateway.leave(session, ben)
    bench.run(0.3)
    assert anna.last("presence")["here"] == 1


def test_a_reload_does_not_change_since_when_but_a_return_does() -> None:
    bench = ConsoleBench()
    ben, anna = Page(), entered(bench, "anna", "session-1")
    session = bench.gateway.join("session-1", "ben", ben, named=True)
    bench.run(0.3)
    since = anna.last("presence")["people"][1]["clock"]
    for pause_s, same in ((2.0, True), (KEPT_S + 2.0, False)):
        bench.gateway.leave(session, ben)
        bench.wall_s += 120.0
        bench.run(pause_s)
        assert anna.last("presence")["here"] == 1
        session = bench.gateway.join("session-1", "ben", ben, named=True)
        bench.run(0.3)
        assert (anna.last("presence")["people"][1]["clock"] == since) is same


def test_a_thousand_connections_and_holders_with_garbage_names_stay_a_short_frame() -> None:
    bench = ConsoleBench()
    anna = entered(bench, "anna", "session-1")
    for number in range(1000):
        entered(bench, f"guest{number}", "session-1")
    garbage = "\u202eevil\n\0" + "x" * 500
    bench.leases(r1=garbage, **{f"s{number}": "anna" for number in range(1000)})
    bench.run(0.6)
    shown = anna.last("presence")
    assert len(shown["people"]) == MOST_SHOWN
    assert (shown["here"], shown["more"]) == (1001, 1002 - MOST_SHOWN)
    assert (len(shown["people"][0]["holds"]), shown["people"][0]["holding"]) == (ROBOTS_SHOWN, 1000)
    for each in bench.gateway._presence.shown()["people"]:
        assert each["name"].isprintable()
        assert len(each["name"]) <= LONGEST_NAME


def test_a_garbage_name_is_shown_without_what_breaks_a_line_or_turns_it() -> None:
    bench = ConsoleBench()
    anna = entered(bench, "anna", "session-1")
    bench.leases(r1="\u202eevil\n\0<b>")
    bench.run(0.3)
    assert anna.last("presence")["people"][1]["name"] == "�evil��<b>"
